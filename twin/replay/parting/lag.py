"""The constant by which the tool of one telling lags behind that of another."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from twin.replay.parting.trace import Trace

STEP_NS = 66_666_668
"""Between the instants at which tools are compared: four steps of the physics."""
LAGS_S = np.arange(-0.2, 0.601, 0.01)


def lag_s(first: Trace, second: Trace) -> float:
    """By how much the second tool comes later than the first: least mean distance [s]."""
    end = min(first.end_ns, second.end_ns)
    times = np.arange(0, max(end, 1), STEP_NS)
    here = _positions(first, times)
    costs = [
        float(np.linalg.norm(_positions(second, times + round(lag * 1e9)) - here, axis=1).mean())
        for lag in LAGS_S
    ]
    best = min(costs)
    # A tool that hardly moves fits any lag: of equal ones the smallest.
    near = [lag for lag, cost in zip(LAGS_S, costs, strict=True) if cost <= best + 1e-5]
    return round(float(min(near, key=abs)), 3)


def _positions(
    trace: Trace, times_ns: Int[np.ndarray, " num_times"]
) -> Float[np.ndarray, "num_times 3"]:
    columns = [np.interp(times_ns, trace.tool.stamps_ns, column) for column in trace.tool.p_m.T]
    return np.stack(columns, axis=1)


def without_lag(trace: Trace, lag: float) -> Trace:
    """The same trace with a lag [s] taken out."""
    shift = round(lag * 1e9)
    return replace(
        trace,
        tool=trace.tool.shifted(-shift),
        width_times_ns=trace.width_times_ns - shift,
        objects={name: track.shifted(-shift) for name, track in trace.objects.items()},
        touches={
            name: None if touch is None else (touch[0] - shift, touch[1] - shift)
            for name, touch in trace.touches.items()
        },
        end_ns=trace.end_ns - shift,
    )
