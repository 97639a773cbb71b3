"""Which of several failures a factor of the verdict names."""

from hypothesis import given
from hypothesis import strategies as st

from bridge.task.causes import Cause
from twin.replay.failure import Failure, factor_from


@given(st.lists(st.integers(0, 10**10), min_size=1, max_size=6, unique=True))
def test_a_factor_names_the_earliest_failure_in_whatever_order_they_were_found(
    times_ns: list[int],
) -> None:
    causes = dict(zip(times_ns, Cause, strict=False))
    failures = [
        Failure(t_ns=t, cause=cause, detail="", bodies=(str(t),)) for t, cause in causes.items()
    ]
    factor = factor_from(failures, undecided="open, too")
    first = sorted(times_ns)[0]
    assert (factor.value, factor.first_t_ns) == (False, first)
    assert (factor.cause, factor.bodies) == (causes[first], (str(first),))


def test_without_a_failure_a_factor_is_true_or_open() -> None:
    assert factor_from([]).value is True
    assert factor_from([], undecided="why").value is None
