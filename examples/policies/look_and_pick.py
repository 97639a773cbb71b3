r"""Ten graded policies that look through the wrist camera, pick the red cube, and put it somewhere.

They look from above, look again from near, grasp, look for where to put the cube, and release it
there. Camera and colours are those of the stand-in cell. The study of docs/policies.md, in this
folder, with all ten where two are named:

    robot-gst trials runs/study --task cube_into_box cube_on_block cube_beside_cube --trials 20 \
        --seed 71203 --map look_and_pick.toml --policies exact=look_and_pick:exact \
        miss_20=look_and_pick:miss_20
    robot-gst rebuild runs/study
    robot-gst rollout runs/study --map look_and_pick.toml --policy look_and_pick:exact --name exact
    robot-gst evaluate runs/study/rollouts.csv
"""

from collections.abc import Iterator
from functools import partial

import numpy as np
from scipy import ndimage

STEP_S, SPEED_M_S, TURN_RAD_S, OPEN_M = 0.1, 0.22, 0.8, 0.085
FX, CX, CY = 246.0, 160.0, 120.0
C, S = np.cos(0.06), np.sin(0.06)
R_TCP_CAMERA = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]) @ [[1, 0, 0], [0, C, -S], [0, S, C]]
P_TCP_CAMERA = np.array([-0.09, 0.0, -0.12])
COLORS = {"red": (0, 1, 2), "green": (1, 0, 2), "blue": (2, 0, 1)}
PLACES = {
    "box": ("blue", 0.05, 0.045),
    "block": ("green", 0.05, 0.072),
    "left": ("blue", 0.04, 0.022),
}
"""By a word of the instruction: colour, height of the top, height of the tool at release [m]."""


class LookAndPick:
    """What it asks for: poses of the tool and widths, a chunk for each movement."""

    def __init__(
        self, miss_m: float = 0.0, carry_m: float = 0.16, drop_m: float = 0.0, looks: int = 2
    ) -> None:
        """How well it does it.

        Args:
            miss_m: How far its grasp is off, which depends on where the cube lies.
            carry_m: Height at which the cube is carried.
            drop_m: How much higher it is released.
            looks: How often it looks before it grasps or releases.
        """
        self.metadata = {"name": "look_and_pick", "miss_m": miss_m, "carry_m": carry_m}
        self.metadata |= {"drop_m": drop_m, "looks": looks}
        self._miss_m, self._carry_m, self._drop_m, self._looks = miss_m, carry_m, drop_m, looks

    def reset(self) -> None:
        """Begin anew."""
        self._does = self._act()

    def infer(self, observation: dict[str, np.ndarray]) -> np.ndarray | dict[str, bool]:
        """The next movement, or that it is done."""
        self._seen = observation
        return next(self._does)

    def _act(self) -> Iterator[np.ndarray | dict[str, bool]]:
        self._p, self._yaw, self._width = np.array(self._seen["tool"][:3], float), 0.0, OPEN_M
        word = next(word for word in PLACES if f" {word}" in str(self._seen["prompt"]))
        color, top_m, release_m = PLACES[word]
        cube, yaw = yield from self._look("red", 0.04, np.array([0.49, -0.15]))
        wave = (np.cos(60 * cube[0] + 25 * cube[1]), np.sin(35 * cube[0] - 50 * cube[1]))
        cube = cube + self._miss_m * np.array(wave)
        yield self._move([*cube, 0.12], yaw)
        yield self._move([*cube, 0.02], yaw)
        yield self._grip(0.0)
        yield self._move([*cube, self._carry_m])
        place, _ = yield from self._look(color, top_m, np.array([0.50, 0.16]))
        yaw = 0.0
        if word == "left":
            place, yaw = np.array([place[0], self._far_y + 0.04]), np.copysign(np.pi / 2, self._yaw)
        yield self._move([*place, max(release_m + 0.08, self._carry_m)], yaw)
        yield self._move([*place, release_m + self._drop_m], yaw)
        yield self._grip(OPEN_M)
        yield self._move([*place, release_m + 0.12], yaw)
        while True:
            yield {"done": True}

    def _look(self, color: str, top_m: float, at: np.ndarray) -> Iterator[np.ndarray]:
        """Hold the camera over a place until something of a colour was found there."""
        for height_m in (0.34, 0.20)[: self._looks]:
            yield self._move([at[0] - 0.09, at[1], max(height_m, self._carry_m)], 0.0)
            points = self._points(color, top_m)
            turns = np.linspace(-np.pi / 4, np.pi / 4, 90, endpoint=False)
            found = [rectangle(points, turn) for turn in turns]
            _, at, yaw = min(found, key=lambda item: item[0])
            self._far_y = float(np.quantile(points[:, 1], 0.995))
        return at, yaw

    def _points(self, color: str, top_m: float) -> np.ndarray:
        """Where the largest patch of a colour lies, were it on a plane [m]."""
        picture = self._seen["wrist"].astype(float)
        own, *others = (picture[..., channel] for channel in COLORS[color])
        labels, count = ndimage.label((own > 50) & (own > 1.5 * np.maximum(*others)))
        if not count:
            raise LookupError(f"nothing {color} is seen")
        sizes = np.bincount(labels.ravel())[1:]
        rows, columns = np.nonzero(labels == 1 + sizes.argmax())
        rays = np.stack([columns + 0.5 - CX, rows + 0.5 - CY, np.full(len(rows), FX)], axis=1)
        p, q = np.array(self._seen["tool"][:3], float), np.array(self._seen["tool"][3:], float)
        R = rotation(q)
        rays, eye = rays @ (R @ R_TCP_CAMERA).T, p + R @ P_TCP_CAMERA
        return (eye + rays * ((top_m - eye[2]) / rays[:, 2:]))[:, :2]

    def _move(self, to_m: list[float], yaw: float | None = None) -> np.ndarray:
        """A straight line that begins and ends at rest."""
        yaw = self._yaw if yaw is None else yaw
        way, turn = np.array(to_m) - self._p, yaw - self._yaw
        seconds = 1.9 * max(np.linalg.norm(way) / SPEED_M_S, abs(turn) / TURN_RAD_S, 0.3)
        s = np.linspace(0, 1, int(np.ceil(seconds / STEP_S)) + 1)[1:]
        s = s**3 * (10 - 15 * s + 6 * s**2)
        rows = [self._row(self._p + share * way, self._yaw + share * turn) for share in s]
        self._p, self._yaw = np.array(to_m), yaw
        return np.array(rows)

    def _grip(self, width_m: float) -> np.ndarray:
        self._width = width_m
        return np.array([self._row(self._p, self._yaw)] * 9)

    def _row(self, p: np.ndarray, yaw: float) -> np.ndarray:
        """Tool down; at yaw 0 the fingers close along the base's y axis."""
        c, s = np.cos(yaw / 2), np.sin(yaw / 2)
        return np.array([*p, 0.0, s, -c, 0.0, self._width])


def rectangle(points: np.ndarray, turn_rad: float) -> tuple[float, np.ndarray, float]:
    """Area, centre and turn of the box around points."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    R = np.array([[c, -s], [s, c]])
    low, high = np.quantile(points @ R, [0.005, 0.995], axis=0)
    return float(np.prod(high - low)), R @ (low + high) / 2, turn_rad


def rotation(q_wxyz: np.ndarray) -> np.ndarray:
    """Matrix of a unit quaternion."""
    w, v = q_wxyz[0], q_wxyz[1:]
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * K + 2 * K @ K


exact = LookAndPick
glance = partial(LookAndPick, looks=1)
low = partial(LookAndPick, carry_m=0.05)
high = partial(LookAndPick, drop_m=0.08)
miss_12, miss_20, miss_24 = (partial(LookAndPick, miss_m=m) for m in (0.012, 0.020, 0.024))
miss_28, miss_32, miss_40 = (partial(LookAndPick, miss_m=m) for m in (0.028, 0.032, 0.040))
