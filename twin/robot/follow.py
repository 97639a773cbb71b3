"""Joints along a path of tool poses: which branch, and how many turns.

A UR has up to eight answers to every pose. Dynamic programming takes the sequence that moves the
joints least, jumps least and, where somebody can say what touches, touches least. Where the closed
form has no answer (another arm, a singular pose, a calibrated arm) the iteration of
``twin.robot.inverse`` continues from the pose before.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from twin.robot.inverse import NUM_BRANCHES, Joints, UrInverse, solutions, solve_ik
from twin.robot.model import RobotModel

Poses = Float[np.ndarray, "num_poses 4 4"]
Clearance = Callable[
    [Float[np.ndarray, "num_postures num_joints"]], Float[np.ndarray, " num_postures"]
]
"""How far postures are from touching what they may not touch [m]; negative when they do."""

NO_BRANCH = -1
_TURN = 2 * np.pi
_HOME_WEIGHT = 0.01
"""Being near home decides only between sequences that are as good otherwise."""
_JUMP_RAD, _JUMP_RATIO, _JUMP_COST = 0.5, 2.0, 1e4
"""A joint that moves by more, and by twice what the smoothest step needs, jumps."""
_TOUCH_COST = 10.0
"""Between a step and a jump: a plan that touches says more than one that jumps to avoid it."""
_MAX_ASKED = 60
"""Postures of one way that are looked at, evenly spread: enough to choose, not to judge."""
_EXACT_M = 1e-9
"""A closed form this near to pinocchio needs no polish."""


@dataclass(frozen=True, kw_only=True)
class Followed:
    """Joints that follow a path."""

    joints_rad: Float[np.ndarray, "num_poses num_joints"]
    reached: Bool[np.ndarray, " num_poses"]
    """False from the first pose on that cannot be reached; joints there are the nearest found,
    and are repeated behind it."""


def follow_poses(
    robot: RobotModel,
    Ts_base_tcp: Poses,
    *,
    start_rad: Joints | None,  # before the first pose; None: any
    clearance: Clearance | None = None,  # asked only about postures that are wanted
) -> Followed:
    """Find joints for every pose of a path; an arm with a UR's geometry in closed form."""
    inverse = UrInverse.for_robot(robot)
    count = len(Ts_base_tcp)
    if inverse is None and start_rad is None and count:
        return _freest(robot, Ts_base_tcp, clearance)
    joints = np.zeros((count, len(robot.arm_ids)))
    branch = np.full(count, NO_BRANCH, dtype=np.int64)
    if inverse is not None and count:
        raw, valid, singular = inverse.solve(Ts_base_tcp)
        # A path that passes through a straight wrist must not leave its branch for that pose.
        known = np.flatnonzero(valid.any(axis=1) & ~singular)
        if len(known):
            tree = _Tree(inverse, raw[known], valid[known], start_rad, robot.home_rad)
            branch[known], joints[known] = tree.choose(clearance)
    exact = inverse is not None and inverse.geometry.deviation < _EXACT_M
    return _completed(robot, Ts_base_tcp, joints, branch, start_rad, exact=exact)


def _freest(robot: RobotModel, Ts_base_tcp: Poses, clearance: Clearance | None) -> Followed:
    """Iterate from several postures for the first pose, until one leads to the end freely.

    That is without a jump and without a touch; else the one that comes farthest is kept.
    """
    ways: list[tuple[tuple[int, ...], int, Followed]] = []
    unknown = np.full(len(Ts_base_tcp), NO_BRANCH, dtype=np.int64)
    nothing = np.zeros((len(Ts_base_tcp), len(robot.joints)))
    for number, first in enumerate(solutions(robot, Ts_base_tcp[0])):
        start_rad = first.joints_rad
        way = _completed(robot, Ts_base_tcp, nothing, unknown, start_rad, exact=False)
        steps = np.abs(np.diff(way.joints_rad[way.reached], axis=0))
        asked = way.joints_rad[way.reached][:: -(-len(Ts_base_tcp) // _MAX_ASKED)]
        touching = clearance is not None and len(asked) and clearance(asked) < 0
        rank = (int((~way.reached).sum()), int((steps > _JUMP_RAD).sum()), int(np.sum(touching)))
        ways.append((rank, number, way))
        if not any(rank):
            break
    return min(ways)[2]


def _completed(
    robot: RobotModel,
    Ts_base_tcp: Poses,
    joints: Float[np.ndarray, "num_poses num_joints"],
    branch: Int[np.ndarray, " num_poses"],
    start_rad: Joints | None,
    *,
    exact: bool,
) -> Followed:
    """Iterate where the closed form has no answer, or one that is not exact."""
    joints, reached = joints.copy(), np.ones(len(joints), dtype=bool)
    for index in range(len(joints)):
        if branch[index] != NO_BRANCH and exact:
            continue
        if branch[index] != NO_BRANCH:
            warm: Joints | None = joints[index]
        elif index:
            warm = joints[index - 1]
        else:
            ahead = np.flatnonzero(branch != NO_BRANCH)[:1]
            warm = joints[ahead[0]] if start_rad is None and len(ahead) else start_rad
        solution = solve_ik(robot, Ts_base_tcp[index], warm_start_rad=warm)
        joints[index] = solution.joints_rad
        if not solution.reached:
            joints[index:], reached[index:] = joints[index], False
            break
    return Followed(joints_rad=joints, reached=reached)


class _Tree:
    """All branches at all poses, and the cheapest way through them."""

    def __init__(
        self,
        inverse: UrInverse,
        raw: Float[np.ndarray, "num_poses 8 6"],
        valid: Bool[np.ndarray, "num_poses 8"],
        start_rad: Float[np.ndarray, "6"] | None,
        home_rad: Float[np.ndarray, "6"],
    ) -> None:
        self._inverse = inverse
        self._raw = raw
        self._start = start_rad
        self._steps = _step_costs(raw, valid)
        near = raw[0] - (home_rad if start_rad is None else start_rad)
        weight = _HOME_WEIGHT if start_rad is None else 1.0
        first = weight * np.square(_wrapped(near)).sum(axis=-1)
        self._first = np.where(valid[0], first, np.inf)
        self._touch = np.zeros(valid.shape)
        self._asked = np.zeros(valid.shape, dtype=bool)

    def choose(
        self, clearance: Clearance | None
    ) -> tuple[Int[np.ndarray, " num_poses"], Float[np.ndarray, "num_poses 6"]]:
        """Branch and joints of each pose; asks about clearance until the best way is known."""
        rows = np.arange(len(self._raw))
        branch, joints = self._best()
        while clearance is not None:
            new = np.flatnonzero(~self._asked[rows, branch])
            if not len(new):
                break
            self._asked[new, branch[new]] = True
            new = new[:: -(-len(new) // _MAX_ASKED)]
            touching = clearance(joints[new]) < 0
            if not touching.any():
                break
            self._touch[new[touching], branch[new[touching]]] = _TOUCH_COST
            branch, joints = self._best()
        return branch, joints

    def _best(self) -> tuple[Int[np.ndarray, " num_poses"], Float[np.ndarray, "num_poses 6"]]:
        """The cheapest way whose turns stay within the limits, of one way to each last branch."""
        count = len(self._raw)
        total = self._first + self._touch[0]
        came = np.zeros((count, NUM_BRANCHES), dtype=np.int64)
        everyone = np.arange(NUM_BRANCHES)
        for index in range(1, count):
            ways = total[:, None] + self._steps[index - 1]
            came[index] = ways.argmin(axis=0)
            total = ways[came[index], everyone] + self._touch[index]
        found: list[tuple[int, int, np.ndarray, np.ndarray]] = []
        for rank, last in enumerate(np.argsort(total, kind="stable")):
            if not np.isfinite(total[last]):
                break
            branch = np.empty(count, dtype=np.int64)
            branch[-1] = last
            for index in range(count - 1, 0, -1):
                branch[index - 1] = came[index, branch[index]]
            joints, breaks = self._turned(self._raw[np.arange(count), branch])
            found.append((breaks, rank, branch, joints))
            if breaks == 0:
                break
        return min(found)[2:]

    def _turned(
        self, raw: Float[np.ndarray, "num_poses 6"]
    ) -> tuple[Float[np.ndarray, "num_poses 6"], int]:
        """Add whole turns so that nothing winds back; counts the joints that must."""
        before = raw[0] if self._start is None else self._start
        path = np.unwrap(np.concatenate([before[None], raw]), axis=0)[1:]
        breaks = 0
        for joint in range(path.shape[1]):
            low, high = self._inverse.lower_rad[joint], self._inverse.upper_rad[joint]
            column = path[:, joint]
            fewest = np.ceil((low - column.min()) / _TURN - 1e-9)
            most = np.floor((high - column.max()) / _TURN + 1e-9)
            if fewest <= most:
                path[:, joint] = column + _TURN * np.clip(0.0, fewest, most)
            else:
                turns, breaks = 0.0, breaks + 1
                for index, value in enumerate(column.tolist()):  # wound back where it would pass
                    turns = max(turns, np.ceil((low - value) / _TURN))
                    turns = min(turns, np.floor((high - value) / _TURN))
                    path[index, joint] = value + _TURN * turns
        return path, breaks


def _step_costs(
    raw: Float[np.ndarray, "num_poses 8 6"], valid: Bool[np.ndarray, "num_poses 8"]
) -> Float[np.ndarray, "num_steps 8 8"]:
    """Cost from each branch (axis 1) to each branch of the next pose (axis 2)."""
    moves = np.abs(_wrapped(raw[1:, None, :, :] - raw[:-1, :, None, :]))
    largest = moves.max(axis=-1)
    possible = valid[:-1, :, None] & valid[1:, None, :]
    smoothest = np.where(possible, largest, np.inf).min(axis=(1, 2), keepdims=True)
    jumps = largest > np.maximum(_JUMP_RAD, _JUMP_RATIO * smoothest)
    costs = np.square(moves).sum(axis=-1) + _JUMP_COST * jumps
    return np.where(possible, costs, np.inf)


def _wrapped(angles_rad: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    return np.asarray(angles_rad - _TURN * np.rint(angles_rad / _TURN))
