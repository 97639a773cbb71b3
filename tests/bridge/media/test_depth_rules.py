"""Laws of turning stored depth into millimetres: which values are kept, which become nothing."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from bridge.media.depth import ROTATED_ENCODING, to_millimetres

VALUES = np.arange(65536, dtype=np.uint16).reshape(256, 256)


def test_millimetres_are_kept_up_to_the_largest_that_fits() -> None:
    np.testing.assert_array_equal(to_millimetres(VALUES, unit_m=1e-3), VALUES)


@given(st.floats(1e-4, 1e-2))
def test_what_does_not_fit_sixteen_bits_is_no_measurement(unit_m: float) -> None:
    exact = [round(int(value) * unit_m * 1e3) for value in (1, 6553, 40000, 65535)]
    stored = np.array([[1, 6553, 40000, 65535]], dtype=np.uint16)
    found = to_millimetres(stored, unit_m=unit_m)
    assert np.abs(found - np.where(np.array(exact) > 65535, 0, exact)).max() <= 1


def test_rotated_bits_are_turned_back_by_three() -> None:
    """Python's whole numbers say what a rotation of sixteen bits is."""
    rotated = [((value >> 13) | (value << 3)) & 0xFFFF for value in range(65536)]
    stored = np.array(rotated, dtype=np.uint16).reshape(256, 256)
    found = to_millimetres(stored, unit_m=1e-3, encoding=ROTATED_ENCODING)
    np.testing.assert_array_equal(found, VALUES)


@given(st.sets(st.integers(0, 65535), max_size=5))
def test_invalid_codes_become_nothing_and_nothing_else_does(codes: set[int]) -> None:
    found = to_millimetres(VALUES, unit_m=1e-3, invalid_values=sorted(codes))
    assert set(VALUES[found == 0].tolist()) == codes | {0}
