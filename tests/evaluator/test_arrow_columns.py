"""Columns hold what was put in, agree with pyarrow's own ways, and never load pandas."""

from array import array
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from own_process import printed

from evaluator.arrow_columns import ANSWER, NUMBER, TEXT, WHOLE, arrays_of, column_of, values_of

_SCALARS = {
    TEXT: st.text(max_size=5),
    WHOLE: st.integers(-(2**63), 2**63 - 1),
    NUMBER: st.floats(allow_nan=False),
    ANSWER: st.booleans(),
}


@st.composite
def columns(draw: st.DrawFn) -> tuple[pa.DataType, list[Any]]:
    """Return a type and values of it; some are missing."""
    scalar = draw(st.sampled_from(list(_SCALARS)))
    values = _SCALARS[scalar] | st.none()
    if draw(st.booleans()):
        lists = st.lists(values, max_size=4).map(tuple) | st.none()
        return pa.list_(scalar), draw(st.lists(lists, max_size=9))
    return scalar, draw(st.lists(values, max_size=20))


@given(columns(), st.integers(0, 20), st.integers(0, 20))
def test_a_column_is_what_pyarrow_makes_and_comes_back_whole_and_in_pieces(
    column: tuple[pa.DataType, list[Any]], one: int, other: int
) -> None:
    kind, values = column
    array = column_of(values, kind)
    array.validate(full=True)
    assert array.equals(pa.array(values, kind))
    first, last = sorted((one, other))
    pieces = pa.chunked_array([array[:first], array[first:last], array[last:]], kind)
    assert values_of(pieces) == values
    assert values_of(pa.chunked_array([pa.array(values, kind)])) == values


@given(
    st.lists(st.none() | st.lists(st.floats(allow_nan=False), max_size=4), max_size=9),
    st.integers(0, 9),
)
def test_arrays_of_numbers_come_back_packed(lists: list[list[float] | None], cut: int) -> None:
    packed = [None if values is None else array("d", values) for values in lists]
    column = column_of(packed, pa.list_(NUMBER))
    assert column.equals(column_of(lists, pa.list_(NUMBER)))
    assert arrays_of(pa.chunked_array([column[:cut], column[cut:]])) == packed


def test_a_hole_in_an_array_is_refused() -> None:
    column = column_of([(1.0, None)], pa.list_(NUMBER))
    with pytest.raises(ValueError, match="missing"):
        arrays_of(pa.chunked_array([column]))


@pytest.mark.parametrize(
    ("values", "kind", "error"),
    [
        ([1.5], WHOLE, TypeError),
        (["1"], NUMBER, TypeError),
        ([1], TEXT, TypeError),
        ([True], WHOLE, TypeError),
        ([1], ANSWER, TypeError),
        ([2**63], WHOLE, OverflowError),
        (["\ud800"], TEXT, ValueError),
        ([("a", 1)], pa.list_(TEXT), TypeError),
    ],
)
def test_what_a_type_does_not_hold_is_refused_never_bent(
    values: list[Any], kind: pa.DataType, error: type[Exception]
) -> None:
    with pytest.raises(error):
        column_of(values, kind)


def test_neither_direction_loads_pandas() -> None:
    code = (
        "import sys, pyarrow as pa; "
        "from evaluator.arrow_columns import column_of, values_of, TEXT, NUMBER; "
        "found = [values_of(pa.chunked_array([column_of(v, k)])) for v, k in "
        "(([1.0, None], NUMBER), (['a', None], TEXT), ([(1.0,), None], pa.list_(NUMBER)))]; "
        "print('pandas' in sys.modules, len(found))"
    )
    assert printed(code) == "False 3"
