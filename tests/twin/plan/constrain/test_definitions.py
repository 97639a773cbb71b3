"""Each kind of constraint against its definition in docs/planning.md, written out anew in NumPy.

Ten states each, half of them near where the kind holds, so that both answers come up; and laws of
every kind: sign, unit, derivative, invariance, both libraries.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest
from block_scene import BESIDE, EXAMPLES, START, around, blocks, blocks_task, state

from bridge.errors import UsageError
from bridge.task.relations import RELATIONS
from twin.plan.constrain.bodies import box_of
from twin.plan.constrain.constraint import Constraint
from twin.plan.constrain.kinds import compile_constraint
from twin.plan.constrain.schema import KINDS
from twin.plan.problem import State
from twin.plan.shapes import shapes_of
from twin.scene.shape.sdf import SdfGrid
from twin.scene.shape.static import StaticSdf

SIZE = {"cube": (0.04, 0.04, 0.04), "brick": (0.12, 0.06, 0.05), "post": (0.05, 0.05, 0.2)}
SIZE["box"] = (0.162, 0.162, 0.056)
WALL, INNER = 0.006, np.array([0.15, 0.15, 0.05])
"""Of the box, whose frame lies in the middle of its underside; the others' are in their middles."""
Poses = dict[str, np.ndarray]


def corners(T: np.ndarray, name: str) -> np.ndarray:
    """Of the box around an object, in the base frame."""
    half = np.array(SIZE[name]) / 2
    lift = [0.0, 0.0, half[2]] if name == "box" else [0.0, 0.0, 0.0]
    local = np.array(list(product((-1, 1), repeat=3))) * half + lift
    return local @ T[:3, :3].T + T[:3, 3]


def at(T: np.ndarray, *p: float) -> np.ndarray:
    return T[:3, :3] @ p + T[:3, 3]


def middle(T: np.ndarray, name: str) -> np.ndarray:
    return corners(T, name).mean(axis=0)


def angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


def within(value: float, low: float, high: float) -> float:
    return max(low - value, value - high)


def gap_from_above(a: np.ndarray, b: np.ndarray) -> float:
    """Between two rectangles: by their sides where they overlap, else by their edges."""
    a, b = a[:, :2], b[:, :2]
    apart = []
    for points in (a, b):
        centred = points - points.mean(axis=0)
        for other in centred[1:]:
            way = other - centred[0]
            if np.linalg.norm(way) > 1e-9:
                n = np.array([-way[1], way[0]]) / np.linalg.norm(way)
                gap = max((a @ n).min() - (b @ n).max(), (b @ n).min() - (a @ n).max())
                apart.append(gap)
    if max(apart) <= 0:
        return max(apart)
    share = np.linspace(0, 1, 401)[:, None]
    outlines = []
    for points in (a, b):
        order = np.argsort(np.arctan2(*(points - points.mean(axis=0)).T[::-1]))
        ring = np.concatenate([points[order], points[order][:1]])
        outlines.append(np.concatenate([p + share * (q - p) for p, q in pairwise(ring)]))
    return float(np.linalg.norm(outlines[0][:, None] - outlines[1][None], axis=2).min())


def on(T: Poses, obj: str, top_m: float) -> float:
    return abs(corners(T[obj], obj)[:, 2].min() - top_m) - 0.008


def on_brick(T: Poses) -> float:
    """Its lowest point at the height of the brick's highest, its middle over the uppermost face."""
    brick = corners(T["brick"], "brick")
    p = middle(T["cube"], "cube")
    p[2] = brick[:, 2].max()
    local = np.abs(T["brick"][:3, :3].T @ (p - T["brick"][:3, 3])) - np.array(SIZE["brick"]) / 2
    local[np.argmax(np.abs(T["brick"][2, :3]))] = -np.inf
    return max(on(T, "cube", brick[:, 2].max()), float(local.max()))


def in_box(T: Poses) -> float:
    local = T["box"][:3, :3].T @ (T["cube"][:3, 3] - T["box"][:3, 3])
    return float((np.abs(local - [0, 0, WALL + INNER[2] / 2]) - INNER / 2).max())


def beside(T: Poses, side: tuple[float, float] | None = None) -> float:
    cube, brick = corners(T["cube"], "cube"), corners(T["brick"], "brick")
    lows, highs = np.array([(p[:, 2].min(), p[:, 2].max()) for p in (cube, brick)]).T
    found = max(within(gap_from_above(cube, brick), 0.0, 0.08), lows.max() - highs.min())
    if side is None:
        return found
    way = (cube.mean(axis=0) - brick.mean(axis=0))[:2]
    turned = angle(way, np.array(side)) - np.radians(45)
    return max(found, turned * 0.01 / np.radians(10))


LINE = np.linspace(-0.5, 0.5, 21)
SHELL = np.array([p for p in product(LINE, repeat=3) if max(map(abs, p)) == 0.5])
"""Dense points of the faces of a cube of size 1."""


def least(points: np.ndarray, half: np.ndarray) -> float:
    """Signed distance of points to a box around the origin, or of their places to a rectangle."""
    away = np.abs(points) - half
    outside = np.linalg.norm(np.maximum(away, 0), axis=1) + np.minimum(away.max(axis=1), 0)
    return float(outside.min())


def clear_of_box(T: Poses) -> float:
    """Points of the cube against the box's floor and walls, and the other way round."""
    walls = [((0, 0, WALL / 2), (*SIZE["box"][:2], WALL))]
    for axis, sign in product((0, 1), (-1, 1)):
        size, place = [*SIZE["box"]], [0.0, 0.0, SIZE["box"][2] / 2]
        size[axis], place[axis] = WALL, sign * (SIZE["box"][axis] - WALL) / 2
        walls.append((tuple(place), tuple(size)))
    T_cube = np.linalg.inv(T["box"]) @ T["cube"]
    cube = SHELL * 0.04 @ T_cube[:3, :3].T + T_cube[:3, 3]
    found = []
    for place, size in walls:
        found.append(least(cube - place, np.array(size) / 2))
        wall = (SHELL * size + place - T_cube[:3, 3]) @ T_cube[:3, :3]
        found.append(least(wall, np.full(3, 0.02)))
    return 0.02 - min(found)


def over_box(T: Poses) -> float:
    p = SHELL * 0.04 @ T["cube"][:3, :3].T + T["cube"][:3, 3] - T["box"][:3, 3]
    return 0.01 - least((p @ T["box"][:3, :3])[:, :2], np.full(2, 0.081))


def tilt(R: np.ndarray, *, is_cube: bool) -> float:
    axes = [sign * R[:, k] for k in range(3) for sign in (1, -1)] if is_cube else [R[:, 2]]
    return min(angle(axis, np.array([0, 0, 1.0])) for axis in axes) - np.radians(10)


def from_start(T: Poses) -> np.ndarray:
    return np.asarray(T["cube"][:3, 3] - START.Ts_base_object["cube"][0][:3, 3])


def opened(T: Poses) -> float:
    a, b = at(T["cube"], 0, 0, -0.02), at(T["box"], 0, 0, 0.056)
    return max(abs((a - b)[2] - 0.02) - 0.01, float(np.linalg.norm((a - b)[:2])) - 0.03)


DEFINITIONS: dict[str, Callable[[Poses], float]] = {
    "distance": lambda T: abs(np.linalg.norm(T["tcp"][:3, 3] - T["cube"][:3, 3]) - 0.2) - 0.01,
    "distance at least": lambda T: 0.1 - np.linalg.norm(T["cube"][:3, 3] - (0.5, 0.1, 0.1)),
    "above": opened,
    "on": on_brick,
    "on table": lambda T: on(T, "cube", 0.0),
    "inside": in_box,
    "outside": lambda T: -gap_from_above(corners(T["cube"], "cube"), corners(T["box"], "box")),
    "beside": beside,
    "beside left": lambda T: beside(T, (0.0, 1.0)),
    "align": lambda T: angle(T["tcp"][:3, 2], np.array([0, 0, -1.0])) - np.radians(10),
    "align bodies": lambda T: angle(-T["cube"][:3, 1], T["post"][:3, 0]) - 0.3,
    "upright": lambda T: tilt(T["brick"][:3, :3], is_cube=False),
    "upright cube": lambda T: tilt(T["cube"][:3, :3], is_cube=True),
    "clearance": clear_of_box,
    "clearance table": lambda T: 0.02 - corners(T["cube"], "cube")[:, 2].min(),
    "keepout over": over_box,
    "height": lambda T: 0.04 - at(T["cube"], 0, 0, -0.02)[2],
    "height of a body": lambda T: corners(T["cube"], "cube")[:, 2].min() - 0.03,
    "moved": lambda T: 0.05 - from_start(T)[1],
    "moved to": lambda T: np.linalg.norm(T["cube"][:2, 3] - (0.45, 0.0)) - 0.03,
    "moved by": lambda T: np.linalg.norm(from_start(T)[:2] - (0.0, 0.16)) - 0.03,
}
SAMPLED_M = {"clearance": 0.0045, "keepout over": 0.0045, "beside": 2e-4, "beside left": 2e-4}
SAMPLED_M["outside"] = 2e-4
"""How far two formulas that go through points may be apart."""


def poses_of(states: State, index: int) -> Poses:
    Ts = {key: T[min(index, len(T) - 1)] for key, T in states.Ts_base_object.items()}
    return {**Ts, "tcp": states.T_base_tcp[index]}


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_kind_measures_what_its_definition_says(name: str) -> None:
    record, good, bad = EXAMPLES[name]
    problem = replace(blocks(), shapes=shapes_of(None, blocks_task()))
    constraint = compile_constraint(record, problem)
    rng = np.random.default_rng(11)
    for states in (around(good, 5, rng, far_m=0.03, turn_rad=0.2), around(bad, 5, rng)):
        f = constraint.violation(states)
        wanted = [DEFINITIONS[name](poses_of(states, index)) for index in range(5)]
        np.testing.assert_allclose(f, wanted, atol=SAMPLED_M.get(name, 1e-9))


def test_a_scene_is_kept_clear_of_as_far_as_its_grid_says() -> None:
    values = np.broadcast_to((0.02 * np.arange(40) - 0.25).astype("f4"), (60, 60, 40)).copy()
    grid = SdfGrid(values_m=values, origin_m=np.array([0.0, -0.6, -0.2]), voxel_m=0.02)
    scene = replace(blocks().scene, static_sdf=StaticSdf(conservative=grid, observed=grid))
    record = {"kind": "clearance", "object": "cube", "against": "scene", "min": 0.03}
    constraint = compile_constraint(record, replace(blocks(), scene=scene))
    states = around(BESIDE, 10, np.random.default_rng(12))
    for index, f in enumerate(constraint.violation(states)):
        lowest = corners(poses_of(states, index)["cube"], "cube")[:, 2].min()
        assert f == pytest.approx(0.03 - (lowest - 0.05), abs=1e-6)


def test_a_speed_is_the_way_over_the_time_at_its_fastest() -> None:
    constraint = compile_constraint(
        {"kind": "speed", "max": 0.25, "a": {"object": "cube"}}, blocks()
    )
    rng = np.random.default_rng(13)
    for _ in range(10):
        ways = around(START, 6, rng)
        times_s = np.cumsum(rng.uniform(0.1, 0.5, 6))
        p = ways.Ts_base_object["cube"][:, :3, 3]
        fastest = max(
            np.linalg.norm(p[k + 1] - p[k]) / (times_s[k + 1] - times_s[k]) for k in range(5)
        )
        assert constraint.worst_along(ways, times_s) == pytest.approx(fastest - 0.25)


OTHERS = {"speed", "between", "aligned"}
"""Asked of a path; of three bodies; and tested below."""


def made(name: str) -> Constraint:
    return compile_constraint(EXAMPLES[name][0], blocks())


def test_every_kind_has_an_example() -> None:
    assert {record["kind"] for record, _, _ in EXAMPLES.values()} | OTHERS == set(KINDS)


@pytest.mark.parametrize("name", EXAMPLES)
def test_f_is_at_most_zero_where_it_holds_and_above_zero_where_not(name: str) -> None:
    record, good, bad = EXAMPLES[name]
    constraint = compile_constraint(record, blocks())
    assert constraint.violation(good) <= 0, constraint.explain(good)
    assert constraint.violation(bad) > 0, constraint.explain(bad)
    assert "holds" in constraint.explain(good)
    assert "is violated" in constraint.explain(bad)
    assert "missed by" in constraint.explain(bad)


@pytest.mark.parametrize("name", EXAMPLES)
def test_along_a_path_the_worst_step_counts(name: str) -> None:
    constraint, steps = made(name), around(START, 5, np.random.default_rng(7))
    worst = constraint.worst_along(steps, np.arange(5.0))
    assert worst == constraint.violation(steps).max()


def test_what_was_not_localised_cannot_be_planned_with() -> None:
    scene = blocks().scene
    left = {key: T for key, T in scene.Ts_base_object.items() if key != "box"}
    lost = replace(scene, Ts_base_object=left, reasons={"box": "hidden by the arm"})
    problem = replace(blocks(), scene=lost)
    for name in ("inside", "above", "keepout over"):
        with pytest.raises(UsageError, match=r"box was not localised \(hidden by the arm\)"):
            compile_constraint(EXAMPLES[name][0], problem)
    compile_constraint(EXAMPLES["on"][0], problem)


def test_a_scene_that_was_not_rebuilt_has_no_distances() -> None:
    record = {"kind": "clearance", "object": "cube", "against": "scene", "min": 0.02}
    with pytest.raises(UsageError, match="there is no rebuilt scene"):
        compile_constraint(record, blocks())


def test_a_state_that_is_no_number_does_not_hold() -> None:
    for name in EXAMPLES:
        lost = {key: np.full((4, 4), np.nan) for key in ("cube", "brick", "tcp")}
        assert not made(name).violation(state(**lost))[0] <= 0, name


def test_a_margin_is_told_as_within_and_by_how_much_it_was_missed() -> None:
    record, good, bad = EXAMPLES["inside"]
    constraint = compile_constraint({**record, "margin_m": 0.03}, blocks())
    assert constraint.wanted(bad) == "the middle of cube at least 30 mm within the cavity of box"
    told = constraint.explain(good)
    assert "is 24 mm within the cavity of box (wanted at least 30 mm within the" in told
    assert told.endswith(", missed by 6 mm)")
    assert "is 268.3 mm beyond the cavity of box (wanted" in constraint.explain(bad)


def test_aligned_is_align_with_the_axis_or_its_opposite() -> None:
    spec = {"object": "brick", "reference": "post", "axis": "y", "reference_axis": "y"}
    states = around(START, 200, np.random.default_rng(8))
    record = {"kind": "align", "a": {"object": "brick", "axis": "y"}, "tolerance_rad": 0.17}
    ways = [{**record, "b": {"object": "post", "axis": axis}} for axis in ("y", "-y")]
    boxes = {key: box_of(states, key, blocks()) for key in ("brick", "post")}
    (wanted,) = RELATIONS["aligned"](spec, boxes)
    f = np.min([compile_constraint(way, blocks()).violation(states) for way in ways], axis=0)
    np.testing.assert_allclose(f, wanted.excess, atol=1e-9)
    same = compile_constraint({"kind": "aligned", **spec}, blocks()).violation(states)
    np.testing.assert_array_equal(same, wanted.excess)
    assert 0.02 < (f <= 0).mean() < 0.98
