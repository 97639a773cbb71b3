"""Where the objects of an episode were at any instant: as localised, and carried in between.

A trial is localised while nothing is executed. In between nobody looks, but the joints and the
fingers say what happened: an object between the fingers when they stop closing goes with the tool
until they open. Closing, they push a box until it fits between the pads, as far apart as recorded.
What localisation and joints disagree about is spread evenly over the carry, so that nothing jumps
where it is put down; but for its height: what was let go above where it is found fell there. An
object that is found far from where it was let go fell as well; one that was never held was moved by
something else, and changes place when that is known.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from bridge.episode import streams
from bridge.episode.executions import executed_events
from bridge.episode.reader import Episode
from bridge.geometry import se3
from bridge.task.task_file import ObjectModel, Task
from twin.robot.model import RobotModel, load_robot
from twin.robot.posture import PostureTrack
from twin.scene.shape.known import turned_alike

BETWEEN_M = 0.03
"""An object this near to the tool, beside half its largest side, is between the fingers."""
PLATEAU_M = 0.003
"""Fingers that are this near to the least opening of a grasp grasp what is between them."""
FELL_M = 0.05
"""An object found this far from where it was let go did not stay there."""
MOVED_M = 0.005
"""Less than this is the scatter of localisation."""
EMPTY_M = 0.002
"""Fingers that close to less have nothing between them."""
GRAVITY_M_S2 = 9.81
PAD_M = 0.0015
"""So much more or less than the recorded opening a box between the pads may measure."""
_TURNS_RAD = np.radians(sorted(np.arange(-45.0, 45.5, 0.5), key=abs))


@dataclass(frozen=True, kw_only=True)
class Grip:
    """A stretch of time in which the fingers were closed around something."""

    closing_ns: int
    """From here on they came nearer to each other than half way."""
    start_ns: int
    end_ns: int
    width_m: float
    """Between the pads when they stopped."""
    T_base_tcp_start: Float[np.ndarray, "4 4"]
    T_base_tcp_end: Float[np.ndarray, "4 4"]


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
        return self.T_start is self.T_end

    def pose(self, stamp_ns: int) -> Float[np.ndarray, "4 4"]:
        """Where it is then."""
        if self.stands:
            return self.T_end
        share = (stamp_ns - self.start_ns) / max(self.end_ns - self.start_ns, 1)
        return _between(self.T_start, self.T_end, float(np.clip(share, 0.0, 1.0)) ** self.power)


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
        """Poses ``T_base_object`` at one instant.

        Args:
            T_base_tcp: Of the tool then; None where no joints are known: what is carried then
                stays where it was taken.
        """
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
    localised: Sequence[Mapping[str, object]],
    task: Task,
    postures: PostureTrack | None,
) -> ObjectTracks:
    """Where a recorded episode's objects were: localised, and carried in between."""
    events = executed_events(episode)
    plan_ids = {
        str(event["plan_id"])
        for event in events
        if event["type"] == "execution_ended" and event.get("plan_id") is not None
    }
    executions = {}
    for plan_id in plan_ids:
        start_ns, end_ns = streams.execution_ns(events, plan_id)
        if start_ns is not None and end_ns is not None:
            executions[plan_id] = (start_ns, end_ns)
    return carried_tracks(localised, executions, task, postures)


def carried_tracks(
    localised: Sequence[Mapping[str, object]],
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
            after = seen.get(plan_id)
            added, note = _moved(model, spans[name], grips, after, end_ns)
            spans[name] += added
            notes += [f"{name} {note}"] if note else []
    return ObjectTracks(spans=spans, absent=frozenset(absent), notes=tuple(notes))


def grips_between(track: PostureTrack, robot: RobotModel, start_ns: int, end_ns: int) -> list[Grip]:
    """When the fingers stood closed around something, by their recorded opening."""
    widths = track.widths
    if widths is None:
        return []
    inside = (widths.stamps_ns >= start_ns) & (widths.stamps_ns <= end_ns)
    stamps, width_m = widths.stamps_ns[inside], widths.position[inside, 0]
    if len(stamps) == 0 or np.ptp(width_m) < PLATEAU_M:
        return []
    is_closed = width_m < (width_m.min() + width_m.max()) / 2
    edges = np.flatnonzero(np.diff(is_closed.astype(np.int8), prepend=0, append=0))
    grips = []
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        least_m = float(width_m[first:last].min())
        held = first + np.flatnonzero(width_m[first:last] <= least_m + PLATEAU_M)
        if least_m < EMPTY_M:
            continue
        t0, t1 = int(stamps[held[0]]), int(stamps[held[-1]])
        T0, T1 = (robot.T_base_tcp(track.at(t).joints_rad) for t in (t0, t1))
        grips.append(
            Grip(
                closing_ns=int(stamps[first]),
                start_ns=t0,
                end_ns=t1,
                width_m=float(width_m[held[0]]),
                T_base_tcp_start=T0,
                T_base_tcp_end=T1,
            )
        )
    return grips


def _seen(
    name: str, localised: Sequence[Mapping[str, object]]
) -> dict[str | None, Float[np.ndarray, "4 4"]]:
    """Poses by the plan after which they were found; None: before the first. In that order."""
    own = [record for record in localised if record["object"] == name and record["found"]]
    return {
        None if record.get("plan_id") is None else str(record["plan_id"]): se3.pose_from_record(
            record["T_base_object"]
        )
        for record in own
    }


def _moved(
    model: ObjectModel,
    before: Sequence[_Span],
    grips: Sequence[Grip],
    after: Float[np.ndarray, "4 4"] | None,
    end_ns: int,
) -> tuple[list[_Span], str]:
    """What one execution did to an object, and what had to be assumed."""
    T = before[-1].T_end
    grasps = _grasps(model, T, grips)
    added = [span for grasp in grasps[:-1] for span in _carried(grasp, grasp.T_base_put)]
    if grasps:
        T = _put(model, grasps[-1], after)
        added += _carried(grasps[-1], T)
    if after is None:
        note = (
            "was not found after an execution: left where the hand put it"
            if grasps
            else "was not found after an execution: left where it was"
        )
        return added, note
    away_m = float(np.linalg.norm(after[:3, 3] - T[:3, 3]))
    if away_m <= MOVED_M:
        return added, ""
    note = (
        f"lay {away_m * 100:.0f} cm from where it was let go: drawn there from then on"
        if grasps
        else f"was moved by {away_m * 100:.0f} cm without being held: drawn there afterwards"
    )
    if not grasps:
        return [_rest(end_ns, after)], note
    return [*added[:-2], *_fallen(grasps[-1].grip.end_ns, T, after)], note


@dataclass(frozen=True, kw_only=True)
class _Grasp:
    """A grip that had the object between the fingers."""

    grip: Grip
    T_base_lay: Float[np.ndarray, "4 4"]
    """Pose of the object before the fingers closed."""
    T_tcp_object: Float[np.ndarray, "4 4"]
    """Its pose in the hand when they had closed."""

    @property
    def T_base_put(self) -> Float[np.ndarray, "4 4"]:
        """Pose of the object when they opened, if it did not slip."""
        return np.asarray(self.grip.T_base_tcp_end @ self.T_tcp_object)


def _grasps(
    model: ObjectModel, T_base_object: Float[np.ndarray, "4 4"], grips: Sequence[Grip]
) -> list[_Grasp]:
    """Those grips that had this object between the fingers, each from where the last one put it."""
    reach_m = BETWEEN_M + max(model.size_m) / 2
    T, grasps = T_base_object, []
    for grip in grips:
        T_tcp_lay = se3.invert(grip.T_base_tcp_start) @ T
        if np.linalg.norm(T_tcp_lay[:3, 3]) >= reach_m:
            continue
        in_hand = _between_pads(model, T_tcp_lay, grip.width_m)
        grasps.append(_Grasp(grip=grip, T_base_lay=T, T_tcp_object=in_hand))
        T = grasps[-1].T_base_put
    return grasps


def _put(
    model: ObjectModel, grasp: _Grasp, after: Float[np.ndarray, "4 4"] | None
) -> Float[np.ndarray, "4 4"]:
    """Pose ``T_base_object`` when the fingers opened: as found later, if it is near enough."""
    if after is None:
        return grasp.T_base_put
    found = turned_alike(after, grasp.T_base_put, model)
    is_there = np.linalg.norm(found[:3, 3] - grasp.T_base_put[:3, 3]) < FELL_M
    return found if is_there else grasp.T_base_put


def _carried(grasp: _Grasp, T_base_put: Float[np.ndarray, "4 4"]) -> list[_Span]:
    """Pushed by the closing fingers, carried, let go, and fallen as low as it is found then."""
    grip, T_let_go = grasp.grip, T_base_put.copy()
    T_let_go[2, 3] = max(T_base_put[2, 3], grasp.T_base_put[2, 3])
    return [
        _Span(
            start_ns=grip.closing_ns,
            end_ns=grip.start_ns,
            T_start=grasp.T_base_lay,
            T_end=grip.T_base_tcp_start @ grasp.T_tcp_object,
        ),
        _Span(
            in_hand=True,
            start_ns=grip.start_ns,
            end_ns=grip.end_ns,
            T_start=grasp.T_tcp_object,
            T_end=se3.invert(grip.T_base_tcp_end) @ T_let_go,
        ),
        *_fallen(grip.end_ns, T_let_go, T_base_put),
    ]


def _fallen(
    start_ns: int, T_start: Float[np.ndarray, "4 4"], T_end: Float[np.ndarray, "4 4"]
) -> list[_Span]:
    """From one place to another, as long as a free fall takes."""
    fall_m = max(float(T_start[2, 3] - T_end[2, 3]), 0.0)
    end_ns = start_ns + round(1e9 * float(np.sqrt(2 * fall_m / GRAVITY_M_S2)))
    fall = _Span(start_ns=start_ns, end_ns=end_ns, T_start=T_start, T_end=T_end, power=2)
    return [fall, _rest(end_ns, T_end)]


def _between_pads(
    model: ObjectModel, T_tcp_object: Float[np.ndarray, "4 4"], width_m: float
) -> Float[np.ndarray, "4 4"]:
    """Push a box as closing fingers do: between the pads, turned until it fits their distance.

    The pads stand across the tool's y axis, equally far from it. A box that fits at no turn was
    tilted in a way that nobody saw: it is put midway as it lay. The sides of any other shape are
    not known as well: it stays where it was.
    """
    if model.shape != "box":
        return T_tcp_object
    T = T_tcp_object.copy()
    T[1, 3] = 0.0  # a box has its origin at its centre
    turns = (se3.rotation_from_vector(np.array([0.0, 0.0, turn])) for turn in _TURNS_RAD)
    for R in (turn @ T_tcp_object[:3, :3] for turn in turns):  # the least one that fits
        if abs(np.abs(R[1]) @ np.array(model.size_m) - width_m) <= PAD_M:
            T[:3, :3] = R
            break
    return T


def _between(
    T_a: Float[np.ndarray, "4 4"], T_b: Float[np.ndarray, "4 4"], share: float
) -> Float[np.ndarray, "4 4"]:
    turn = se3.vector_from_rotation(T_a[:3, :3].T @ T_b[:3, :3])
    T = T_a.copy()
    T[:3, :3] = T_a[:3, :3] @ se3.rotation_from_vector(share * turn)
    T[:3, 3] += share * (T_b[:3, 3] - T_a[:3, 3])
    return T
