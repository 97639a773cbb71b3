"""Probe episodes: short scripted plans whose outcome depends on physics and on little else.

What each one shows (``docs/decisions/0015-calibration.md`` has the arithmetic):

- **push**: slowly against one side of the object, then against the next. Where it ends up is where
  the closed fingers stopped, so it shows how localisation and robot lie to each other.
- **slide**: pushed fast, then let go. It slides on by v^2 / (2 mu g): friction on the table.
- **squeeze**: gripped askew, slowly. The narrow fingers turn the object until the line between the
  two contacts lies inside both friction cones, and it jams there: the opening at which they stop
  is the friction of the pads, whatever the force. Tilting a held object would show nothing here:
  the grip holds fifty times its weight.
- **drop**: let go a few centimetres above the table.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.errors import BridgeError, UsageError
from bridge.robots.default import ARM_JOINTS, BASE_FRAME, MAX_WIDTH_M, ROBOT_NAME
from bridge.sources.standin.kinematics import (
    Kinematics,
    Leg,
    Track,
    UnreachablePoseError,
    follow_legs,
    tool_down,
    wrap_rad,
    yaw_of,
)
from bridge.sources.standin.planner import FINGERS_HALF_M
from bridge.task.plan import Plan, Stage
from bridge.task.task_file import Task

PROBES = ("push", "slide", "squeeze", "drop")
PLANNER_NAME = "standin_probes"
TOOL_M = 0.018
"""Height of the tool while it pushes: the tips are 8 mm above the table."""
HOVER_M = 0.16
GAP_M = 0.025
"""Between fingers and object when the tool comes down."""
PUSH_M = 0.045
TOUCH_M = 0.008
"""The object is moved slowly by this much before it is sped up, so that nothing hits it."""
SPRINT_M, SPRINT_S = 0.145, 0.39
SPEEDING_UP = 0.77
"""Share of the time; then on at the top speed of 1.63 x length / time = 0.60 m/s."""
SPRINT_STEP_S = 0.01
"""Between waypoints: coarser ones speed up in steps, and the object bounces off the fingers."""
BACK_M = 0.06
ASKEW_RAD = np.deg2rad(22.5)
"""Between the fingers and the object's sides. Steeper than 24 degrees the object's corners, not the
fingers', touch first, and that always jams."""
DROP_M = 0.04
REACH_M = (0.30, 0.72)
"""Distances from the robot's axis at which the object may end up."""
AREA_M = ((0.27, 0.68), (-0.34, 0.32))
"""Where on the table it may end up, x and y: what both cameras see."""
SLIDE_ROOM_M = 0.07
KEEP_OFF_M = 0.06
"""Beyond the outer circles of the object and of anything that stands on the table."""


class NoSpaceForProbeError(BridgeError):
    """From where the object lies, the probe would leave table or reach, or hit something."""

    def __init__(self, kind: str) -> None:
        """Say which one."""
        super().__init__(f"no space for the probe {kind!r} from here: put the object elsewhere.")


@dataclass(frozen=True, kw_only=True)
class _Setting:
    """What a probe is planned from."""

    task: Task
    object_id: str
    seen: Mapping[str, Float[np.ndarray, "4 4"]]

    @property
    def p_m(self) -> Float[np.ndarray, "3"]:
        return np.asarray(self.seen[self.object_id][:3, 3])

    @property
    def yaw_rad(self) -> float:
        return yaw_of(self.seen[self.object_id])

    def half_m(self, quarter: int) -> float:
        """Half the object's extent in the direction of the n-th quarter turn from its x axis."""
        return self.task.objects[self.object_id].size_m[quarter % 2] / 2


def plan_probe(
    kind: str,
    task: Task,
    seen: Mapping[str, Float[np.ndarray, "4 4"]],
    *,
    kinematics: Kinematics,
    joints_start_rad: Float[np.ndarray, "6"],
    max_joint_speed_rad_s: float,
    plan_id: str,
    start_id: str,
    turn: int = 1,
) -> Plan:
    """Plan one probe of the task's first manipulated object; the quickest of the ways there are.

    Args:
        turn: 1 or -1: to which side a squeeze is askew.
    """
    object_id = task.manipulated[0]
    if task.objects[object_id].soft is not None:
        message = f"{object_id} of task {task.name} is soft: probes are for rigid objects."
        raise UsageError(message)
    setting = _Setting(task=task, object_id=object_id, seen=seen)
    home = kinematics.T_base_tcp(joints_start_rad)
    start = Track.at_rest(home, joints_start_rad)
    tracks = []
    for legs in _WAYS[kind](setting, turn):
        back = Leg(name="home", stage=kind, T_base_tcp=home, duration_s=1.4, g=legs[-1].g)
        try:
            track = follow_legs(start, [*legs, back], kinematics, max_joint_speed_rad_s)
        except UnreachablePoseError:
            continue
        tracks.append(track)
    if not tracks:
        raise NoSpaceForProbeError(kind)
    best = min(tracks, key=lambda track: track.tau[-1].t_ns)
    start_ns, end_ns = best.bounds[kind]
    allowed = (("gripper", object_id), (object_id, "table"))
    stage = Stage(
        id=kind, text=kind, allowed_contacts=allowed, t_start_ns=start_ns, t_end_ns=end_ns
    )
    return Plan(
        id=plan_id,
        planner=PLANNER_NAME,
        policy=PLANNER_NAME,
        condition="without_replanning",
        start_id=start_id,
        robot=ROBOT_NAME,
        frame=BASE_FRAME,
        task=task.name,
        instruction=f"Probe: {kind} the {object_id}.",
        grounding_source="stand-in: true poses with seeded noise",
        joint_names=ARM_JOINTS,
        stages=(stage,),
        tau=best.tau,
    )


def _push(setting: _Setting, turn: int) -> list[list[Leg]]:
    ways = []
    for quarter in range(4):
        for side in (1, -1):
            first, second = _direction(setting, quarter), _direction(setting, quarter + side)
            moved = setting.p_m + PUSH_M * first
            end = moved + PUSH_M * second
            if not (_free(setting, moved) and _free(setting, end)):
                continue
            ways.append(
                _shove(setting, setting.p_m, quarter) + _shove(setting, moved, quarter + side)
            )
    return ways


def _shove(setting: _Setting, p_m: Float[np.ndarray, "3"], quarter: int) -> list[Leg]:
    """Down behind the object, slowly forward, back a little and up."""
    along = _direction(setting, quarter)
    touch = p_m - (setting.half_m(quarter) + FINGERS_HALF_M) * along
    behind, ahead = touch - GAP_M * along, touch + PUSH_M * along
    back = ahead - GAP_M * along
    return [
        _leg("push", "above", behind, along, 1.2, height_m=HOVER_M),
        _leg("push", "down", behind, along, 0.9),
        _leg("push", "push", ahead, along, 2.0),
        _leg("push", "wait", ahead, along, 0.3),
        _leg("push", "back", back, along, 0.6),
        _leg("push", "up", back, along, 0.8, height_m=HOVER_M),
    ]


def _slide(setting: _Setting, turn: int) -> list[list[Leg]]:
    ways = []
    for quarter in range(4):
        along = _direction(setting, quarter)
        touch = setting.p_m - (setting.half_m(quarter) + FINGERS_HALF_M) * along
        slow, fast = touch + TOUCH_M * along, touch + (TOUCH_M + SPRINT_M) * along
        pushed = setting.p_m + (TOUCH_M + SPRINT_M) * along
        if not (_free(setting, pushed) and _free(setting, pushed + SLIDE_ROOM_M * along)):
            continue
        behind, back = touch - GAP_M * along, fast - BACK_M * along
        ways.append(
            [
                _leg("slide", "above", behind, along, 1.2, height_m=HOVER_M),
                _leg("slide", "down", behind, along, 0.9),
                _leg("slide", "touch", slow, along, 1.2),
                _leg("slide", "wait", slow, along, 0.3),
                Leg(
                    name="sprint",
                    stage="slide",
                    T_base_tcp=_pushing(fast, along),
                    duration_s=SPRINT_S,
                    g=1,
                    law=_sprint,
                    step_s=SPRINT_STEP_S,
                ),
                _leg("slide", "back", back, along, 0.25),
                _leg("slide", "up", back, along, 0.8, height_m=HOVER_M),
            ]
        )
    return ways


def _sprint(s: Float[np.ndarray, " num_times"]) -> Float[np.ndarray, " num_times"]:
    """Evenly faster, then even, so that nothing is pressed together when the fingers turn back."""
    top = 1 / (1 - SPEEDING_UP / 2)
    rising, even = top * s**2 / (2 * SPEEDING_UP), top * (s - SPEEDING_UP / 2)
    return np.where(s <= SPEEDING_UP, rising, even)


def _squeeze(setting: _Setting, turn: int) -> list[list[Leg]]:
    ways = []
    for quarter in range(4):
        yaw = wrap_rad(setting.yaw_rad + quarter * np.pi / 2 + turn * ASKEW_RAD)
        low = tool_down(np.array([*setting.p_m[:2], TOOL_M]), yaw)
        high = tool_down(np.array([*setting.p_m[:2], HOVER_M]), yaw)
        wide = 2.2 * setting.half_m(quarter + 1) + 0.016
        shut = setting.half_m(quarter + 1) * 1.7
        if wide > MAX_WIDTH_M - 0.002:
            continue
        rows = (
            ("above", high, 1.5, 0, None),
            ("down", low, 0.9, 0, None),
            ("near", low, 0.4, 1, wide),
            ("squeeze", low, 2.2, 1, shut),
            ("press", low, 0.7, 1, None),
            ("open", low, 0.5, 0, None),
            ("up", high, 0.8, 0, None),
        )
        ways.append([_posed("squeeze", *row) for row in rows])
    return ways


def _drop(setting: _Setting, turn: int) -> list[list[Leg]]:
    ways = []
    for quarter in range(4):
        yaw = wrap_rad(setting.yaw_rad + quarter * np.pi / 2)
        low = tool_down(np.array([*setting.p_m[:2], TOOL_M]), yaw)
        high = tool_down(np.array([*setting.p_m[:2], HOVER_M]), yaw)
        held = tool_down(np.array([*setting.p_m[:2], TOOL_M + DROP_M]), yaw)
        rows = (
            ("above", high, 1.5, 0, None),
            ("down", low, 0.9, 0, None),
            ("close", low, 0.8, 1, None),
            ("lift", held, 0.9, 1, None),
            ("hold", held, 0.3, 1, None),
            ("open", held, 0.5, 0, None),
            ("up", high, 0.8, 0, None),
        )
        ways.append([_posed("drop", *row) for row in rows])
    return ways


_WAYS = {"push": _push, "slide": _slide, "squeeze": _squeeze, "drop": _drop}


def _posed(
    stage: str,
    name: str,
    T: Float[np.ndarray, "4 4"],
    seconds: float,
    g: int,
    width_m: float | None,
) -> Leg:
    return Leg(name=name, stage=stage, T_base_tcp=T, duration_s=seconds, g=g, width_m=width_m)


def _leg(
    stage: str,
    name: str,
    p_m: Float[np.ndarray, "3"],
    along: Float[np.ndarray, "3"],
    seconds: float,
    *,
    height_m: float = TOOL_M,
) -> Leg:
    T = _pushing(p_m, along)
    T[2, 3] = height_m
    return _posed(stage, name, T, seconds, 1, None)


def _pushing(
    p_m: Float[np.ndarray, "3"], along: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Tool down with its x axis along the push, to the side that turns the wrist less."""
    yaw = float(np.arctan2(along[1], along[0]))
    return tool_down(np.array([*p_m[:2], TOOL_M]), min(yaw, wrap_rad(yaw + np.pi), key=abs))


def _direction(setting: _Setting, quarter: int) -> Float[np.ndarray, "3"]:
    yaw = setting.yaw_rad + quarter * np.pi / 2
    return np.array([np.cos(yaw), np.sin(yaw), 0.0])


def _free(setting: _Setting, p_m: Float[np.ndarray, "3"]) -> bool:
    """Whether the object may come to lie there."""
    inside = [low <= value <= high for value, (low, high) in zip(p_m[:2], AREA_M, strict=True)]
    if not all(inside) or not REACH_M[0] <= float(np.hypot(*p_m[:2])) <= REACH_M[1]:
        return False
    own = _radius_m(setting, setting.object_id)
    return all(
        float(np.hypot(*(T[:2, 3] - p_m[:2]))) > own + _radius_m(setting, key) + KEEP_OFF_M
        for key, T in setting.seen.items()
        if key != setting.object_id
    )


def _radius_m(setting: _Setting, object_id: str) -> float:
    return float(np.hypot(*setting.task.objects[object_id].size_m[:2])) / 2
