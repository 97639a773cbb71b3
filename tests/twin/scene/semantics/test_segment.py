from dataclasses import replace

import numpy as np
import pytest
import table_scene
from table_scene import BLUE, GREEN, RED, World, box, duck, ellipsoid, iou, make_world, table

from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.semantics import segment as segmenter
from twin.scene.semantics.describe import scene_by_default
from twin.scene.semantics.lift import render_labels
from twin.scene.semantics.points import SurfacePoints, points_of
from twin.scene.semantics.segment import Segmentation, segment

WHITE = (0.85, 0.85, 0.85)


def segmented(pieces: list[table_scene.Piece], num: int = 8) -> tuple[World, Segmentation]:
    world = make_world(pieces, num_train=num, num_held_out=0)
    return world, segment(points_of(world.cloud))


def matched(world: World, found: Segmentation) -> dict[int, tuple[str, float]]:
    """Best label and IoU of each true instance."""
    truth = world.true_instances()
    best = {}
    for number in sorted(set(truth.tolist()) - {0}):
        scores = [iou(found.labels == k + 1, truth == number) for k in range(len(found.things))]
        top = int(np.argmax(scores))
        best[number] = (found.things[top].label, scores[top])
    return best


def test_everything_on_the_table_is_found_and_named(tabletop: World) -> None:
    found = segment(points_of(tabletop.cloud))
    best = matched(tabletop, found)
    assert {number: label for number, (label, _) in best.items()} == tabletop.names
    assert all(score > 0.85 for _, score in best.values())
    sizes = np.bincount(found.labels)[1:].tolist()
    assert len(sizes) == len(found.things) == 4
    assert sizes == sorted(sizes, reverse=True)


def test_the_fused_scene_gives_masks_of_every_frame(tabletop: World) -> None:
    rasteriser = Rasteriser(RasterConfig(threads=1))
    viewpoints = [shot.viewpoint for shot in tabletop.train]
    scene = scene_by_default(tabletop.cloud, viewpoints, rasteriser)
    names = {item.label: item.name.split(", ")[1:] for item in scene.instances}
    assert names["red cube"] == ["red cube", "4 x 4 x 4 cm"]
    assert names["yellow thing"][0] == "yellow"  # a shape nobody knows is not called one
    shot = tabletop.held_out[0]
    ids = render_labels(rasteriser, tabletop.cloud, scene.labels, shot.viewpoint)
    for index, item in enumerate(scene.instances, start=1):
        number = next(k for k, name in tabletop.names.items() if name == item.label)
        assert iou(ids == index, shot.instance == number) > 0.8


@pytest.mark.slow
def test_ducks_that_touch_are_two_and_keep_their_heads() -> None:
    world, found = segmented([table(), *duck(1, 0.0, 0.036, 0.3), *duck(2, 0.0, -0.036, 2.8)])
    best = matched(world, found)
    assert len(found.things) == 2
    assert all(score > 0.85 and label == "yellow thing" for label, score in best.values())


STACKED = [
    box(1, [0, 0, 0.025], [0.05, 0.05, 0.05], BLUE),
    box(2, [0, 0, 0.07], [0.04, 0.04, 0.04], RED),
    box(3, [0.051, 0, 0.02], [0.05, 0.05, 0.04], GREEN),
]
BALL_IN_BOX = [
    *table_scene.open_box(1, 0, 0, BLUE),
    ellipsoid(2, [0, 0, 0.03], [0.024] * 3, RED),
]
CUBES_IN_BIN = [
    *table_scene.open_box(1, 0, 0, BLUE),
    box(2, [0.03, 0.02, 0.028], [0.04, 0.04, 0.044], RED),
    box(3, [-0.03, -0.02, 0.028], [0.04, 0.04, 0.044], table_scene.YELLOW),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pieces", "num", "labels", "least"),
    [
        (STACKED, 8, ["blue", "red", "green"], 0.8),
        (BALL_IN_BOX, 10, ["blue open container", "red ball"], 0.75),
        (CUBES_IN_BIN, 8, ["blue", "red", "yellow"], 0.9),
    ],
)
def test_what_stands_on_in_or_beside_another_thing_is_its_own(
    pieces: list[table_scene.Piece], num: int, labels: list[str], least: float
) -> None:
    world, found = segmented([table(), *pieces], num)
    best = matched(world, found)
    assert len(found.things) == len(labels)
    for (label, score), wanted in zip(best.values(), labels, strict=True):
        assert label.startswith(wanted)
        assert score > least


def test_every_fifth_frame_shows_the_same_things_as_all() -> None:
    papers = box(1, [0.02, 0, 0.01], [0.22, 0.20, 0.02], WHITE)
    mug = box(2, [-0.123, 0.03, 0.04], [0.05, 0.05, 0.08], WHITE)
    world = make_world([table(), papers, mug], num_held_out=0, noise_m=0.003)
    for cloud in (world.cloud, table_scene.fused(world.train[::5])):
        found = segment(points_of(cloud))
        assert len(found.things) == 2
        assert all(score > 0.8 for _, score in matched(replace(world, cloud=cloud), found).values())


def test_without_a_level_plane_it_says_what_is_missing() -> None:
    rng = np.random.default_rng(0)
    cloud = make_world([table()], num_train=3, num_held_out=0).cloud
    ball = points_of(cloud)
    p = rng.normal(size=(len(ball), 3))
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    found = segment(type(ball)(p_m=5.0 * p, normals=p, colors=ball.colors))
    assert found.things == ()
    assert "needs a table in view, or things" in found.remark


def test_the_answer_does_not_depend_on_where_the_table_stands(tabletop: World) -> None:
    points = points_of(tabletop.cloud)
    angle = 0.7
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]]
    )
    moved = type(points)(
        p_m=points.p_m @ turn.T + [1.5, -0.4, 0.8],
        normals=points.normals @ turn.T,
        colors=points.colors,
    )
    first, second = (segment(item) for item in (points, moved))
    assert [t.label for t in first.things] == [t.label for t in second.things]
    assert (first.labels == second.labels).mean() > 0.99


def test_relief_of_the_table_is_no_thing_and_a_flat_card_is_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(2)
    xy = rng.uniform(-0.3, 0.3, (40_000, 2))
    bump = np.exp(-np.sum((xy - [0.1, 0.1]) ** 2, axis=1) / (2 * 0.03**2))
    ridge = np.exp(-((xy[:, 0] + 0.15) ** 2) / (2 * 0.02**2)) * (np.abs(xy[:, 1]) < 0.1)
    card = (np.abs(xy[:, 0] - 0.15) < 0.04) & (np.abs(xy[:, 1] + 0.15) < 0.03)
    z = np.where(card, 0.010, 0.012 * bump + 0.011 * ridge) + rng.normal(0, 0.0005, len(xy))
    wood = np.array([0.72, 0.56, 0.38]) + rng.normal(0, 0.04, (len(xy), 3))
    points = SurfacePoints(
        p_m=np.column_stack([xy, z]),
        normals=np.tile([0.0, 0.0, 1.0], (len(xy), 1)),
        colors=np.clip(np.where(card[:, None], [0.8, 0.1, 0.1], wood), 0, 1),
    )
    found = segment(points)
    assert [thing.label.split()[0] for thing in found.things] == ["red"]
    assert iou(found.labels == 1, card) > 0.9
    monkeypatch.setattr(segmenter, "RELIEF_SCORE", 0.0)
    everything = segment(points)
    assert len(everything.things) == 3
