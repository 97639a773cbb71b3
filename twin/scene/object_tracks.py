"""Where the objects of an episode were at any instant: as localised, and carried in between.

A trial is localised while nothing is executed. In between the joints and the fingers say what
happened: an object between the fingers when they stop closing goes with the tool until they open,
as cameras saw it in the hand on the way, else as it lay before. What is let go elsewhere than it is
found fell there, in the time that gravity takes. One that was never held was pushed while the hand
was near, or else changes place when that is known.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.reader import Episode
from bridge.geometry import se3
from bridge.task.task_file import ObjectModel, Task
from twin.robot.model import RobotModel, load_robot
from twin.robot.posture import PostureTrack
from twin.scene.localise.held import Grip, executions_ns, grips_between, reach_m
from twin.scene.shape.known import turned_alike

FELL_M = 0.05
"""An object found this far from where it was let go did not stay there."""
MOVED_M = 0.005
"""Less than this is the scatter of localisation."""
STEP_NS = 40_000_000
GRAVITY_M_S2 = 9.81
TIPS = 3.0
"""What lands aside tips over an edge first, from near its balance: so many times as long."""


@dataclass(frozen=True, kw_only=True)
class _Span:
    """From here on its pose changes evenly, or it stands."""

    start_ns: int
    end_ns: int
    T_start: Float[np.ndarray, "4 4"]
    T_end: Float[np.ndarray, "4 4"]
    """The same one: it stands."""
    in_hand: bool = False
    """Poses are ``T_tcp_object``, else ``T_base_object``."""
    power: int = 1
    """2: it falls ever faster."""

    @property
    def stands(self) -> bool:
        """Whether it does not move in the base frame."""
        return self.T_start is self.T_end and not self.in_hand

    def pose(self, stamp_ns: int) -> Float[np.ndarray, "4 4"]:
        """Where it is then."""
        if self.T_start is self.T_end:
            return self.T_end
        share = (stamp_ns - self.start_ns) / max(self.end_ns - self.start_ns, 1)
        share = float(np.clip(share, 0.0, 1.0)) ** self.power
        (R_a, p_a), (R_b, p_b) = ((T[:3, :3], T[:3, 3]) for T in (self.T_start, self.T_end))
        turn = se3.vector_from_rotation(R_a.T @ R_b)
        R = R_a @ se3.rotation_from_vector(share * turn)
        return se3.from_rotation(R, p_a + share * (p_b - p_a))


def _rest(start_ns: int, T_base_object: Float[np.ndarray, "4 4"]) -> _Span:
    return _Span(start_ns=start_ns, end_ns=start_ns, T_start=T_base_object, T_end=T_base_object)


@dataclass(frozen=True, kw_only=True)
class ObjectTracks:
    """Poses of objects over source time, in the frame in which cameras see them."""

    spans: Mapping[str, Sequence[_Span]] = field(default_factory=dict)
    """By object, in the order of time; the first also grasps before it."""
    absent: frozenset[str] = frozenset()
    """Objects that nobody found: they are not drawn."""
    notes: tuple[str, ...] = ()
    """What nobody saw and what was assumed instead."""

    def first(self) -> dict[str, Float[np.ndarray, "4 4"]] | None:
        """Where objects were before anything moved; None where nobody localised them."""
        return self.at(0, None) if self.spans or self.absent else None

    def at(
        self, stamp_ns: int, T_base_tcp: Float[np.ndarray, "4 4"] | None
    ) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Poses ``T_base_object`` at one instant; without ``T_base_tcp`` what is carried stays."""
        found = {}
        for name, spans in self.spans.items():
            begun = [span for span in spans if span.start_ns <= stamp_ns]
            span = begun[-1] if begun else spans[0]
            if span.in_hand and T_base_tcp is not None:
                found[name] = T_base_tcp @ span.pose(stamp_ns)
            elif span.in_hand:
                found[name] = [item.T_end for item in begun if item.stands][-1]
            else:
                found[name] = span.pose(stamp_ns)
        return found


def localised_tracks(
    episode: Episode,
    localised: Sequence[Mapping[str, Any]],
    task: Task,
    postures: PostureTrack | None,
) -> ObjectTracks:
    """Where a recorded episode's objects were: localised, and carried in between."""
    return carried_tracks(localised, executions_ns(episode), task, postures)


def carried_tracks(
    localised: Sequence[Mapping[str, Any]],
    executions_ns: Mapping[str, tuple[int, int]],
    task: Task,
    track: PostureTrack | None,
) -> ObjectTracks:
    """Join what was localised before and after executions by what the hand did meanwhile.

    Args:
        localised: The gst localisation v1 records of one episode, each with its ``phase`` and the
            ``plan_id`` after whose execution it grasps.
        track: Joints and fingers; None where nobody recorded them: objects then change place at
            the end of an execution.
    """
    robot = None if track is None else load_robot(track.urdf)
    spans: dict[str, list[_Span]] = {}
    notes, absent = [], set()
    for name, model in task.objects.items():
        seen = _seen(name, localised)
        if not seen:
            notes.append(f"{name} was not localised: not drawn")
            absent.add(name)
            continue
        spans[name] = [_rest(0, next(iter(seen.values())))]
        for plan_id, (start_ns, end_ns) in sorted(executions_ns.items(), key=lambda i: i[1]):
            grips = (
                grips_between(track, robot, start_ns, end_ns)
                if track is not None and robot is not None and not model.fixed
                else []
            )
            T, held = spans[name][-1].T_end, _held(name, plan_id, localised)
            carried = _carried(model, T, grips, held)
            after = seen.get(plan_id)
            ways = carried or [_while_near(model, T, after, track, robot, (start_ns, end_ns))]
            added, note = _moved(model, ways, after, held=bool(carried))
            spans[name] += added
            notes += [f"{name} {note}"] if note else []
    return ObjectTracks(spans=spans, absent=frozenset(absent), notes=tuple(notes))


def _while_near(
    model: ObjectModel,
    T: Float[np.ndarray, "4 4"],
    after: Float[np.ndarray, "4 4"] | None,
    track: PostureTrack | None,
    robot: RobotModel | None,
    span_ns: tuple[int, int],
) -> _Span:
    """From when the hand came to where an object lay to when it left where it lies.

    Where it never was there, it left the object, which went on by itself, as long as it would tip.
    """
    at_end = _rest(span_ns[1], T)
    if after is None or track is None or robot is None:
        return at_end
    if np.linalg.norm(after[:3, 3] - T[:3, 3]) <= MOVED_M:
        return at_end
    stamps = range(*span_ns, STEP_NS)
    tool_m = [robot.T_base_tcp(track.at(ns).joints_rad)[:3, 3] for ns in stamps]
    away_m = [np.linalg.norm(tool_m - each[:3, 3], axis=1) for each in (T, after)]
    old, new = (np.flatnonzero(each < reach_m(model)) for each in away_m)
    if not len(old):
        return at_end
    if len(new) and new[-1] > old[0]:
        return replace(at_end, start_ns=stamps[old[0]], end_ns=stamps[new[-1]])
    left_ns, alone_ns = stamps[old[-1]], round(TIPS * _fall_ns(after[:3, 3] - T[:3, 3]))
    return replace(at_end, start_ns=left_ns, end_ns=left_ns + alone_ns)


def _seen(
    name: str, localised: Sequence[Mapping[str, Any]]
) -> dict[str | None, Float[np.ndarray, "4 4"]]:
    """Poses by the plan after which they were found; None: before the first. In that order."""
    own = [record for record in localised if record["object"] == name and record["found"]]
    return {each.get("plan_id"): se3.pose_from_record(each["T_base_object"]) for each in own}


def _held(
    name: str, plan_id: str, localised: Sequence[Mapping[str, Any]]
) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Poses ``T_tcp_object`` as cameras saw them in an execution, by the start of the grip."""
    own = [each for each in localised if (each["object"], each.get("plan_id")) == (name, plan_id)]
    entries = [entry for record in own for entry in record.get("in_hand", [])]
    return {each["grip_ns"]: se3.pose_from_record(each["T_tcp_object"]) for each in entries}


def _carried(
    model: ObjectModel,
    T_base_object: Float[np.ndarray, "4 4"],
    grips: Sequence[Grip],
    held: Mapping[int, Float[np.ndarray, "4 4"]],
) -> list[_Span]:
    """Pushed by closing fingers, carried, and left where they opened; each from there again."""
    T, spans = T_base_object, []
    for grip in grips:
        T_hand = se3.invert(grip.T_base_tcp_start) @ T
        if grip.start_ns in held:
            T_hand = turned_alike(held[grip.start_ns], T_hand, model)
        if np.linalg.norm(T_hand[:3, 3]) < reach_m(model):
            start_ns, taken = grip.start_ns, grip.T_base_tcp_start @ T_hand
            spans += [
                _Span(start_ns=grip.closing_ns, end_ns=start_ns, T_start=T, T_end=taken),
                _Span(
                    in_hand=True,
                    start_ns=start_ns,
                    end_ns=grip.end_ns,
                    T_start=T_hand,
                    T_end=T_hand,
                ),
                _rest(grip.end_ns, grip.T_base_tcp_end @ T_hand),
            ]
            T = spans[-1].T_end
    return spans


def _moved(
    model: ObjectModel,
    spans: Sequence[_Span],
    after: Float[np.ndarray, "4 4"] | None,
    *,
    held: bool,
) -> tuple[list[_Span], str]:
    """What one execution did to an object, and what had to be assumed.

    Args:
        spans: By the joints; the last one is where it lies then, or while it may be pushed.
    """
    *before, rest = spans
    if after is None and held and model.soft is not None:  # toys are dropped
        T = rest.T_end.copy()
        T[2, 3] = min(T[2, 3], before[0].T_start[2, 3])
        note = "was not found after an execution: drawn below where it was let go"
        return [*before, *_fallen(rest.start_ns, rest.T_end, T)], note
    if after is None:
        where = "where the hand put it" if held else "where it was"
        return [*before, rest], f"was not found after an execution: left {where}"
    away_m = float(np.linalg.norm(after[:3, 3] - rest.T_end[:3, 3]))
    if held:
        fell = _fallen(rest.start_ns, rest.T_end, turned_alike(after, rest.T_end, model))
        note = f"lay {away_m * 100:.0f} cm from where it was let go: drawn there from then on"
        return [*before, *fell], note if away_m >= FELL_M else ""
    if away_m <= MOVED_M:
        return [], ""
    note = f"was moved by {away_m * 100:.0f} cm without being held: drawn there afterwards"
    return [replace(rest, T_end=after), _rest(rest.end_ns, after)], note


def _fall_ns(way_m: Float[np.ndarray, "3"]) -> float:
    """How long a free fall takes over a distance."""
    return 1e9 * float(np.sqrt(2 * np.linalg.norm(way_m) / GRAVITY_M_S2))


def _fallen(
    start_ns: int, T_start: Float[np.ndarray, "4 4"], T_end: Float[np.ndarray, "4 4"]
) -> list[_Span]:
    """From one place to another, as long as a free fall takes over that distance, or tipping."""
    way_m = T_start[:3, 3] - T_end[:3, 3]
    fall_ns = _fall_ns(way_m)
    if np.linalg.norm(way_m[:2]) > FELL_M / 2:
        fall_ns *= TIPS
    end_ns = start_ns + round(fall_ns)
    fall = _Span(start_ns=start_ns, end_ns=end_ns, T_start=T_start, T_end=T_end, power=2)
    return [fall, _rest(end_ns, T_end)]
