"""Where planned in the twin, executed in the twin and recorded diverge first, and why.

Three trajectories of one execution are laid over each other, two at a time. The recorded tool lags
behind the command by the latency of the controller: that constant is found first, reported, and
taken out. Then four quantities are followed until they differ by more than a limit: the tool's
pose, the width of the gripper, the objects' positions, and when the fingers touch what.

What diverges first decides the attribution of a pair; what diverges later may follow from it and
carries the same name:

- tool pose: tracking;
- gripper width, at rest, while neither side touches anything: tracking; while something is held:
  perception against the recording (the fingers hold another part of it than was localised), contact
  inside the twin (both began with the same poses);
- fingers touch earlier or later, or only on one side: perception against the recording, contact
  inside the twin;
- fingers lose it earlier or later: contact;
- object position: contact;
- nothing but a success predicate: predicate.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from bridge.geometry import se3
from bridge.geometry.signals import LAGS_S, lag_of_least_cost
from bridge.task.record import check_record
from twin.replay.trace import Trace

TOOL_M, TOOL_RAD = 0.01, 0.05
"""Limits beyond which planned, executed and recorded are apart: tool position [m] and rotation
[rad], after the lag between the two is taken out."""
WIDTH_M = 0.004
"""Width of the gripper [m]."""
OBJECT_M = 0.02
"""Position of an object; the recorded one is localised to a few millimetres [m]."""
CONTACT_S = 0.25
"""When fingers begin or cease to touch an object [s]."""

LAG_STEP_NS = 66_666_668
"""Between the instants at which tools are compared: four steps of the physics."""


def lag_s(first: Trace, second: Trace) -> float:
    """By how much the second tool comes later [s], by least mean distance; negative: earlier."""
    end = min(first.end_ns, second.end_ns)
    times = np.arange(0, max(end, 1), LAG_STEP_NS)
    here = _positions(first, times)
    costs = [
        float(np.linalg.norm(_positions(second, times + round(lag * 1e9)) - here, axis=1).mean())
        for lag in LAGS_S
    ]
    return lag_of_least_cost(np.array(costs))


def _positions(
    trace: Trace, times_ns: Int[np.ndarray, " num_times"]
) -> Float[np.ndarray, "num_times 3"]:
    columns = [np.interp(times_ns, trace.tool.stamps_ns, column) for column in trace.tool.p_m.T]
    return np.stack(columns, axis=1)


def without_lag(trace: Trace, lag: float) -> Trace:
    """The same trace with a lag taken out [s]; negative where it comes early."""
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


SCHEMA_VERSION = 1
STEP_NS = 16_666_667
HELD_STEPS = 3
"""A difference counts when it lasts for so many steps: one sample may be noise."""
FALL_STEPS = 15
"""Objects are apart when they stay so for a quarter of a second."""
REST_M_S = 0.02
"""A gripper slower than this rests."""
REST_STEPS = 12
"""So many steps before and after it moves are left out: two grippers start 0.2 s apart."""
SIDES = ("planned", "executed", "recorded")
ORDER = ("tool_position", "tool_rotation", "gripper_width", "contact", "object_position")
UNITS = {"tool_rotation": "rad", "contact": "s"}


@dataclass(frozen=True, kw_only=True)
class DivergedQuantity:
    """One quantity in which two trajectories differ, from its first instant on."""

    between: tuple[str, str]
    quantity: str
    first_t_ns: int
    size: float
    """Largest difference from then on."""
    limit: float
    unit: str
    attribution: str
    detail: str
    body: str = ""


def diverge(
    plan_id: str,
    traces: Sequence[Trace],
    *,
    findings: Mapping[str, Mapping[tuple[str, str], bool | None]] | None = None,
) -> dict[str, Any]:
    """Compare every two trajectories, what each predicate (kind, object) said only if all agree.

    The gst divergence v1 record, checked against its schema: ``lag_s`` is how far the recorded tool
    lags behind the planned one, ``first`` the earliest of ``quantities``; of several at one
    instant, the one nearest to the cause.
    """
    quantities: list[DivergedQuantity] = []
    lags: dict[tuple[str, str], float] = {}
    ordered = sorted(traces, key=lambda trace: SIDES.index(trace.side))
    for one, other in combinations(ordered, 2):
        pair = (one.side, other.side)
        lags[pair] = lag_s(one, other)
        found = sorted(_quantities(one, without_lag(other, lags[pair])), key=_rank)
        if found:
            found = [replace(each, attribution=found[0].attribution) for each in found]
        else:
            found = list(_predicates(pair, findings or {}, max(one.end_ns, other.end_ns)))
        quantities += found
    first = min(quantities, key=_rank, default=None)
    record = {
        "schema_version": SCHEMA_VERSION,
        "plan_id": plan_id,
        "lag_s": lags.get(("planned", "recorded")),
        "first": None if first is None else _plain(first),
        "quantities": [_plain(one) for one in quantities],
    }
    check_record(record, name="divergence")
    return record


def _quantities(first: Trace, second: Trace) -> Iterator[DivergedQuantity]:
    times = np.arange(0, max(min(first.end_ns, second.end_ns), 1), STEP_NS)
    pair = (first.side, second.side)
    one, two = first.tool.at(times), second.tool.at(times)
    shifted = np.linalg.norm(one.p_m - two.p_m, axis=1)
    turned = se3.rotation_angle_rad(
        np.swapaxes(one.transforms()[:, :3, :3], 1, 2) @ two.transforms()[:, :3, :3]
    )
    widths = _resting_difference(first, second, times)
    recorded = "recorded" in pair
    held = _held(first, times) | _held(second, times)
    for quantity, values, limit in (
        ("tool_position", shifted, TOOL_M),
        ("tool_rotation", turned, TOOL_RAD),
        ("gripper_width", widths, WIDTH_M),
    ):
        index = _first_above(values, limit)
        if index is None:
            continue
        cause = "tracking"
        if quantity == "gripper_width" and held[index]:
            cause = "perception" if recorded else "contact"
        yield _quantity(pair, quantity, int(times[index]), values[index:].max(), limit, cause)
    yield from _touches(first, second)
    yield from _objects(first, second)


def _resting_difference(
    first: Trace, second: Trace, times_ns: Int[np.ndarray, " num_times"]
) -> Float[np.ndarray, " num_times"]:
    """Difference of the widths while neither gripper moves; 0 while one does.

    How fast a gripper closes is seen in when it touches; what it holds, in where it stops.
    """
    one, two = (np.interp(times_ns, t.width_times_ns, t.width_m) for t in (first, second))
    moving = np.zeros(len(times_ns), dtype=bool)
    for width in (one, two):
        fast = np.abs(np.diff(width, prepend=width[:1])) > REST_M_S * STEP_NS * 1e-9
        around = np.convolve(fast.astype(np.int64), np.ones(2 * REST_STEPS + 1), mode="same")
        moving |= around[: len(times_ns)] > 0
    return np.where(moving, 0.0, np.abs(one - two))


def _held(trace: Trace, times_ns: Int[np.ndarray, " num_times"]) -> Bool[np.ndarray, " num_times"]:
    held = np.zeros(len(times_ns), dtype=bool)
    for touch in trace.touches.values():
        if touch is not None:
            held |= (times_ns >= touch[0]) & (times_ns <= touch[1])
    return held


def _first_above(
    values: Float[np.ndarray, " num_steps"], limit: float, steps: int = HELD_STEPS
) -> int | None:
    """Where values first stay above a limit for so many steps."""
    above = (values > limit).astype(np.int64)
    if len(above) < steps:
        return None
    lasting = np.convolve(above, np.ones(steps, dtype=np.int64), mode="valid")
    found = np.flatnonzero(lasting == steps)
    return int(found[0]) if len(found) else None


def _touches(first: Trace, second: Trace) -> Iterator[DivergedQuantity]:
    pair = (first.side, second.side)
    whose = "perception" if "recorded" in pair else "contact"
    for name in sorted(set(first.touches) & set(second.touches)):
        one, two = first.touches[name], second.touches[name]
        if one is None and two is None:
            continue
        if one is None or two is None:
            touch = one or two or (0, 0)
            lasted_s = (touch[1] - touch[0]) * 1e-9
            alone = _quantity(pair, "contact", touch[0], lasted_s, CONTACT_S, whose)
            detail = f"only {_where(pair[one is None])} do the fingers touch {name}"
            yield replace(alone, body=name, detail=detail)
            continue
        for end, cause, word in ((0, whose, "touched"), (1, "contact", "let go of")):
            gap_s = abs(one[end] - two[end]) * 1e-9
            if gap_s > CONTACT_S:
                earlier = pair[0] if one[end] < two[end] else pair[1]
                yield replace(
                    _quantity(pair, "contact", min(one[end], two[end]), gap_s, CONTACT_S, cause),
                    body=name,
                    detail=f"{name} is {word} {gap_s:.2f} s earlier {_where(earlier)}",
                )
                break


def _objects(first: Trace, second: Trace) -> Iterator[DivergedQuantity]:
    """Positions, at the instants that the side with fewer of them knows."""
    pair = (first.side, second.side)
    for name in sorted(set(first.objects) & set(second.objects)):
        one, two = first.objects[name], second.objects[name]
        times = min(one, two, key=len).stamps_ns
        shifted = np.linalg.norm(one.at(times).p_m - two.at(times).p_m, axis=1)
        # A recording looks twice; of two replays, one drops a moment later than the other.
        index = _first_above(shifted, OBJECT_M, 1 if len(times) < FALL_STEPS else FALL_STEPS)
        if index is not None:
            size = float(shifted[index:].max())
            yield replace(
                _quantity(pair, "object_position", int(times[index]), size, OBJECT_M, "contact"),
                body=name,
                detail=f"{name} lies {size * 1e3:.0f} mm apart, {pair[0]} against {pair[1]}",
            )


def _predicates(
    pair: tuple[str, str],
    findings: Mapping[str, Mapping[tuple[str, str], bool | None]],
    end_ns: int,
) -> Iterator[DivergedQuantity]:
    one, two = findings.get(pair[0], {}), findings.get(pair[1], {})
    for kind, name in sorted(set(one) & set(two)):
        values = (one[kind, name], two[kind, name])
        if None in values or values[0] == values[1]:
            continue
        yield replace(
            _quantity(pair, "predicate", end_ns, 1.0, 0.0, "predicate"),
            body=name,
            detail=f"{kind} of {name or 'the execution'} holds only "
            f"{_where(pair[0] if values[0] else pair[1])}, all states within their limits",
        )


def _quantity(
    pair: tuple[str, str], quantity: str, t_ns: int, size: float, limit: float, cause: str
) -> DivergedQuantity:
    unit = UNITS.get(quantity, "" if quantity == "predicate" else "m")
    shown = f"{size * 1e3:.0f} mm" if unit == "m" else f"{size:.2f} {unit}".rstrip()
    words = quantity.replace("_", " ")
    return DivergedQuantity(
        between=pair,
        quantity=quantity,
        first_t_ns=max(t_ns, 0),
        size=float(size),
        limit=limit,
        unit=unit,
        attribution=cause,
        detail=f"{words} differs by up to {shown}, {pair[0]} against {pair[1]}",
    )


def _where(side: str) -> str:
    return "in the recording" if side == "recorded" else f"as {side} in the twin"


def _rank(found: DivergedQuantity) -> tuple[int, int]:
    quantity = found.quantity
    return found.first_t_ns, ORDER.index(quantity) if quantity in ORDER else len(ORDER)


def _plain(found: DivergedQuantity) -> dict[str, Any]:
    return {**asdict(found), "between": list(found.between)}
