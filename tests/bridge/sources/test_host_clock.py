"""Laws of mapping a device's clock to the host's."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.clock import NS_PER_S
from bridge.sources.device_samples import SETTLE_NS, HostClock

MS = 1_000_000


def run(
    delays_ns: list[int], *, offset_ns: int, period_ns: int = 8 * MS, ppm: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Feed samples taken every period, arriving late; return true and mapped times [ns]."""
    clock = HostClock()
    taken, mapped = [], []
    for number, delay_ns in enumerate(delays_ns):
        device_ns = number * period_ns
        true_ns = offset_ns + round(device_ns * (1 + ppm * 1e-6))
        stamp_ns = clock.map(device_ns, true_ns + delay_ns)
        if stamp_ns is not None:
            taken.append(true_ns)
            mapped.append(stamp_ns)
    return np.array(taken), np.array(mapped)


@given(
    st.lists(st.integers(0, 50 * MS), min_size=200, max_size=400),
    st.integers(0, 2 * 10**18),
)
def test_stamps_keep_their_order_and_are_never_early(delays_ns: list[int], offset_ns: int) -> None:
    taken, mapped = run(delays_ns, offset_ns=offset_ns)
    assert len(mapped) > 0
    assert (np.diff(mapped) > 0).all()
    assert (mapped >= taken).all()
    assert np.abs(np.diff(mapped) - 8 * MS).max() <= 0.05 * 8 * MS + 1


def test_one_quick_arrival_is_enough() -> None:
    rng = np.random.default_rng(1)
    delays = (2 * MS + rng.exponential(5 * MS, 2000)).astype(int).tolist()
    delays[10] = 300_000
    taken, mapped = run(delays, offset_ns=10**18)
    assert set((mapped - taken)[:100].tolist()) == {300_000}


def test_a_stall_of_ours_moves_no_stamp() -> None:
    delays = [MS] * 400
    delays[200:330] = [(330 - n) * 8 * MS for n in range(200, 330)]  # we hang for a second
    taken, mapped = run(delays, offset_ns=5)
    assert (mapped - taken == MS).all()


@pytest.mark.parametrize("ppm", [-50.0, 50.0])
def test_drifting_oscillators_cost_less_than_a_millisecond(ppm: float) -> None:
    delays = [MS] * 125 * 120  # two minutes drift 6 ms apart
    taken, mapped = run(delays, offset_ns=10**18, ppm=ppm)
    assert np.abs(mapped - taken - MS).max() < MS
    assert (np.diff(mapped) > 0).all()


def test_nothing_is_said_before_the_offset_is_known() -> None:
    taken, mapped = run([0] * 200, offset_ns=0)
    assert taken[0] >= SETTLE_NS
    assert mapped[0] == taken[0]


def test_a_counter_that_wraps_goes_on() -> None:
    wraps_ns = 4 * NS_PER_S
    clock = HostClock(wraps_ns=wraps_ns)
    stamps = [clock.map(t % wraps_ns, t + MS) for t in range(0, 13 * NS_PER_S, 33 * MS)]
    known = [stamp for stamp in stamps if stamp is not None]
    assert set(np.diff(known).tolist()) == {33 * MS}


def test_a_clock_that_starts_again_is_told_from_streams_out_of_step() -> None:
    clock = HostClock()
    for t in range(0, 2 * NS_PER_S, 10 * MS):
        clock.map(t, t)
    assert clock.map(2 * NS_PER_S - 20 * MS, 2 * NS_PER_S) is not None
    with pytest.raises(ValueError, match="backwards"):
        clock.map(5 * MS, 2 * NS_PER_S)
