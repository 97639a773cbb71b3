"""Antipodal pairs against geometry, and the share of drawn poses at which a grasp misses."""

import numpy as np
import pytest
from scipy.stats import norm

from bridge.geometry import se3
from bridge.task.meshes.catalogue import toy_mesh
from bridge.task.task_file import ObjectModel
from twin.plan.grasp.margin import SHIFTS_M, WAYS, Doubt, Lines, margins, reaches_along
from twin.plan.grasp.pairs import SampledSurface, antipodal_pairs, pairs_along, thinned
from twin.plan.problem import Shape
from twin.scene.shape.known import shape_mesh
from twin.scene.shape.reconstruct import shape_of_mesh

SIZE = (0.06, 0.03, 0.04)
CONE_RAD = 0.4636


def box(error_m: float = 0.0) -> Shape:
    model = ObjectModel(id="it", shape="box", size_m=SIZE, color_srgb=(0, 0, 0))
    vertices, triangles = shape_mesh(model)
    return Shape(vertices_m=vertices, triangles=triangles, source="test", error_m=error_m)


def scanned_duck() -> Shape:
    """As views have it: rough, by voxels of 1.5 mm."""
    toy = toy_mesh("duck", (0.07, 0.05, 0.06))
    found = shape_of_mesh(toy.vertices_m, toy.triangles)
    vertices_m = found.vertices_m + np.random.default_rng(0).normal(0, 3e-4, found.vertices_m.shape)
    return Shape(vertices_m=vertices_m, triangles=found.faces, source="test", error_m=0.0015)


def test_straight_through_a_box_is_as_long_as_its_side() -> None:
    surface = SampledSurface(box())
    points, triangles = surface.points(200, 0)
    normals = surface.normals[triangles]
    pairs = pairs_along(surface, points, normals, -normals)
    along = np.abs(pairs.axes).argmax(axis=1)
    assert len(pairs.widths_m) == 200
    np.testing.assert_allclose(pairs.widths_m, np.array(SIZE)[along], atol=2e-6)
    np.testing.assert_allclose(pairs.cosines, 1.0, atol=1e-6)
    middles = np.take_along_axis(pairs.middles_m, along[:, None], axis=1)
    np.testing.assert_allclose(middles, 0.0, atol=2e-6)


def test_both_ends_of_all_pairs_lie_on_the_surface() -> None:
    pairs = antipodal_pairs(
        SampledSurface(box()), count=300, cone_rad=CONE_RAD, hint_m=(0.0, 0.0, 0.0), seed=1
    )
    half = np.array(SIZE) / 2
    for end in (pairs.first_m, pairs.first_m + pairs.axes * pairs.widths_m[:, None]):
        off = np.abs(np.abs(end) - half).min(axis=1)
        assert off.max() < 2e-5
        assert (np.abs(end) <= half + 2e-5).all()


def test_a_line_within_both_cones_crosses_a_box_between_facing_sides_only() -> None:
    pairs = antipodal_pairs(
        SampledSurface(box()), count=300, cone_rad=CONE_RAD, hint_m=None, seed=2
    )
    holds = pairs.chosen(pairs.cosines >= np.cos(CONE_RAD))
    # the shortest way between facing sides, lengthened by the tilt at most
    along = np.abs(holds.axes).argmax(axis=1)
    side = np.array(SIZE)[along]
    assert (holds.widths_m >= side - 2e-5).all()
    assert (holds.widths_m <= side / np.cos(CONE_RAD) + 2e-5).all()
    assert 0 < len(holds.widths_m) < len(pairs.widths_m)


def test_the_hinted_line_is_among_the_pairs() -> None:
    hint = (0.013, 0.0, 0.004)
    pairs = antipodal_pairs(SampledSurface(box()), count=1, cone_rad=CONE_RAD, hint_m=hint, seed=3)
    away = np.linalg.norm(pairs.middles_m - hint, axis=1) + np.abs(np.abs(pairs.axes[:, 1]) - 1)
    assert away.min() < 1e-5


@pytest.mark.parametrize("hint", [(0.2, 0.0, 0.0), (0.0, 0.0, -0.3)])
def test_a_hint_beside_the_object_adds_nothing(hint: tuple[float, float, float]) -> None:
    surface = SampledSurface(box())
    with_hint, without = (
        antipodal_pairs(surface, count=20, cone_rad=CONE_RAD, hint_m=h, seed=3)
        for h in (hint, None)
    )
    np.testing.assert_array_equal(with_hint.first_m, without.first_m)


def test_normals_of_a_scan_are_those_of_the_thing() -> None:
    shape = scanned_duck()
    points, triangles = SampledSurface(shape).points(400, 0)
    exact = Shape(**{**vars(shape), "error_m": 0.0})
    rough, averaged = (SampledSurface(each).normals[triangles] for each in (exact, shape))
    toy = toy_mesh("duck", (0.07, 0.05, 0.06))
    step = 1e-4
    gradient = np.stack(
        [toy.solid(points + step * e) - toy.solid(points - step * e) for e in np.eye(3)], axis=1
    )
    true = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    off = [np.degrees(np.arccos(np.clip((n * true).sum(axis=1), -1, 1))) for n in (rough, averaged)]
    assert np.median(off[1]) < 8.0
    assert np.percentile(off[1], 90) < np.percentile(off[0], 90)


def test_thinning_keeps_one_of_what_is_alike() -> None:
    pairs = antipodal_pairs(
        SampledSurface(box()), count=300, cone_rad=CONE_RAD, hint_m=None, seed=4
    )
    twice = pairs.chosen(np.tile(np.arange(len(pairs.widths_m)), 2))
    once = thinned(pairs, cell_m=0.006, cell_rad=0.2)
    assert len(thinned(twice, cell_m=0.006, cell_rad=0.2)) == len(once) < len(pairs.widths_m)


FAR = 1.0


def surface() -> SampledSurface:
    model = ObjectModel(id="it", shape="box", size_m=SIZE, color_srgb=(0, 0, 0))
    vertices, triangles = shape_mesh(model)
    return SampledSurface(Shape(vertices_m=vertices, triangles=triangles, source="test"))


def line_at(x_m: float, z_m: float) -> Lines:
    """Across the box, the hand from above."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = x_m, 0.0, z_m
    return Lines(
        Ts_object_tcp=T[None],
        middles_m=T[None, :3, 3],
        widths_m=np.array([SIZE[1]]),
        cosines=np.ones(1),
    )


def covariance() -> np.ndarray:
    spread = np.random.default_rng(6).normal(size=(6, 6)) * [0.003, 0.002, 0.001, 0.02, 0.02, 0.08]
    return spread.T @ spread


def doubt(cov: np.ndarray, other_m: float = 0.0) -> Doubt:
    return Doubt(covariance=cov, other_m=other_m, robot_m=0.0, middle_m=0.0)


def test_a_line_can_be_shifted_up_to_the_edge() -> None:
    for x_m in (0.0, 0.012, -0.02):
        for sign in (-1.0, 1.0):
            found = reaches_along(surface(), line_at(x_m, 0.0), 0, sign, 0.46)[0]
            edge = min(SIZE[0] / 2 - sign * x_m, SHIFTS_M[-1])
            assert edge - 0.0051 <= found <= edge + 1e-9


def test_the_margin_is_the_chance_of_missing_along_one_way() -> None:
    rng = np.random.default_rng(7)
    cov, lines = covariance(), line_at(0.021, 0.006)
    T = np.eye(4)
    T[:3, :3] = se3.rotation_from_vector(np.array([0.0, 0.0, 0.7]))
    slack = np.full((1, len(WAYS)), FAR)
    slack[0, WAYS.index("along")] = 0.009
    found = margins(slack, lines, T, doubt(cov))[0]
    drawn = rng.multivariate_normal(np.zeros(6), cov, 200_000)
    arm, x = T[:3, :3] @ lines.middles_m[0], T[:3, :3] @ lines.Ts_object_tcp[0, :3, 0]
    off = (drawn[:, :3] + np.cross(drawn[:, 3:], arm)) @ x
    assert abs(norm.cdf(-found) - (off > 0.009).mean()) < 0.003


def test_chances_of_several_ways_add_up() -> None:
    slack = np.full((1, len(WAYS)), FAR)
    lines = line_at(0.0, 0.0)
    given = doubt(np.diag([1e-6] * 6))
    each = []
    for way in ("across", "shallow"):
        one = np.full((1, len(WAYS)), FAR)
        one[0, WAYS.index(way)] = slack[0, WAYS.index(way)] = 0.0021
        each.append(norm.cdf(-margins(one, lines, np.eye(4), given)[0]))
    both = norm.cdf(-margins(slack, lines, np.eye(4), given)[0])
    np.testing.assert_allclose(both, sum(each), rtol=1e-6)


def test_turning_base_and_covariance_changes_nothing() -> None:
    lines, cov = line_at(0.017, 0.008), covariance()
    slack = np.random.default_rng(8).uniform(0.004, 0.02, (1, len(WAYS)))
    before = margins(slack, lines, np.eye(4), doubt(cov, 0.001))
    R = se3.rotation_from_vector(np.array([0.3, -0.2, 1.1]))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, (0.4, -0.2, 0.1)
    both = np.zeros((6, 6))
    both[:3, :3] = both[3:, 3:] = R
    after = margins(slack, lines, T, doubt(both @ cov @ both.T, 0.001))
    np.testing.assert_allclose(after, before, rtol=1e-9)


def test_what_is_sure_bears_more() -> None:
    lines, slack = line_at(0.0, 0.0), np.full((1, len(WAYS)), 0.01)
    bear = [
        margins(slack, lines, np.eye(4), doubt(covariance() * scale, 0.001))[0]
        for scale in (0.1, 1.0, 10.0)
    ]
    assert bear[0] > bear[1] > bear[2]


def test_what_cannot_miss_has_a_margin_that_is_a_number() -> None:
    slack = np.full((2, len(WAYS)), FAR)
    slack[1] = -FAR
    lines = line_at(0.0, 0.0)
    two = Lines(**{name: np.repeat(value, 2, axis=0) for name, value in vars(lines).items()})
    found = margins(slack, two, np.eye(4), doubt(np.zeros((6, 6))))
    assert not np.isnan(found).any()
    assert found[0] > 30 > -30 > found[1]
