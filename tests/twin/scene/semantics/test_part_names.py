import numpy as np
import pytest
import table_scene
from table_scene import Piece, iou, make_world, table

from twin.scene.semantics.part_segmentation import (
    MARGIN_CELLS,
    Parts,
    PartsConfig,
    _label_cells,
    fill_solid,
    find_parts,
    thickness_of,
)


def parts_of(pieces: list[Piece], label: str) -> tuple[np.ndarray, np.ndarray, Parts]:
    """Points of the fused instance 1, their true parts, and the parts found."""
    world = make_world([table(), *pieces], num_train=10, num_held_out=0)
    own = world.true_instances() == 1
    p = world.cloud.means_m[own].astype(np.float64)
    truth = np.array([piece.part for piece in world.pieces])[world.true_pieces()[own]]
    return p, truth, find_parts(p, label, 0.004, PartsConfig())


def mean_iou(truth: np.ndarray, parts: Parts, names: tuple[str, ...]) -> float:
    nothing = np.zeros(len(truth), dtype=bool)
    return float(np.mean([iou(parts.masks.get(n, nothing), truth == n) for n in names]))


@pytest.mark.slow
def test_a_duck_has_a_body_and_a_head() -> None:
    p, truth, parts = parts_of(table_scene.duck(1, 0.0, 0.0), "yellow toy")
    assert mean_iou(truth, parts, ("body", "head")) > 0.85
    assert parts.keypoints["head"][2] > parts.keypoints["body"][2] + 0.03
    assert parts.keypoints["head"][0] > 0.01
    np.testing.assert_allclose(parts.keypoints["top"][2], p[:, 2].max(), atol=0.004)


@pytest.mark.slow
def test_a_sloth_has_four_limbs_and_their_tips_are_keypoints() -> None:
    _, truth, parts = parts_of(table_scene.sloth(1, 0.0, 0.0), "sloth")
    assert mean_iou(truth, parts, ("body", "head", "limbs")) > 0.8
    tips = {tuple(np.sign(parts.keypoints[f"limb {k}"][:2]).astype(int)) for k in range(1, 5)}
    assert tips == {(1, 1), (1, -1), (-1, 1), (-1, -1)}
    for k in range(1, 5):
        assert np.linalg.norm(np.abs(parts.keypoints[f"limb {k}"][:2]) - [0.055, 0.062]) < 0.02


@pytest.mark.slow
def test_a_basket_has_rim_floor_walls_and_handle() -> None:
    _, truth, parts = parts_of(table_scene.basket(1, 0.0, 0.0), "basket")
    assert mean_iou(truth, parts, ("rim", "floor", "walls", "handle")) > 0.75
    np.testing.assert_allclose(parts.keypoints["opening"], [0, 0, 0.06], atol=0.006)
    np.testing.assert_allclose(parts.keypoints["floor"], [0, 0, 0.006], atol=0.006)
    assert parts.keypoints["handle"][2] > 0.11


def test_an_open_box_has_no_handle() -> None:
    _, _, parts = parts_of(table_scene.open_box(1, 0, 0, table_scene.BLUE), "blue open container")
    assert set(parts.masks) == {"rim", "floor", "walls"}
    together = np.sum(list(parts.masks.values()), axis=0)
    assert (together == 1).all()


def test_a_solid_box_called_container_gets_no_invented_cavity() -> None:
    block = table_scene.box(1, [0, 0, 0.03], [0.08, 0.08, 0.06], table_scene.RED)
    _, _, parts = parts_of([block], "open container")
    assert parts.masks == {}
    assert set(parts.keypoints) == {"centre", "top", "bottom"}


def test_every_cell_of_any_shape_belongs_to_a_part() -> None:
    """Balls with masts on them: high up nothing is thick, and there is no head to be found."""
    rng = np.random.default_rng(1)
    for _ in range(10):
        solid = np.zeros((40, 40, 28), dtype=bool)
        grid = np.moveaxis(np.indices(solid.shape), 0, -1)
        for _ in range(rng.integers(1, 5)):
            centre = [*rng.uniform(10, 30, 2), MARGIN_CELLS + rng.uniform(0, 8)]
            solid |= np.linalg.norm(grid - centre, axis=-1) < rng.uniform(2, 9)
        for _ in range(rng.integers(1, 4)):
            x, y = rng.choice(np.argwhere(solid.any(axis=2)))
            solid[x : x + 2, y : y + 2, MARGIN_CELLS : rng.integers(10, 27)] = True
        solid[:, :, :MARGIN_CELLS] = False
        parts, _ = _label_cells(solid, thickness_of(solid), PartsConfig().protrusion_ratio)
        np.testing.assert_array_equal(parts > 0, solid)


def test_parts_move_with_the_thing() -> None:
    rng = np.random.default_rng(0)
    p = rng.normal(size=(3000, 3))
    p = 0.03 * p / np.linalg.norm(p, axis=1, keepdims=True) + [0, 0, 0.03]
    shift = np.array([0.5, -0.3, 0.0])
    first, second = (find_parts(q, "toy", 0.003, PartsConfig()) for q in (p, p + shift))
    for name, place in first.keypoints.items():
        np.testing.assert_allclose(second.keypoints[name], place + shift, atol=0.004)


def test_a_ball_is_filled_to_its_volume() -> None:
    rng = np.random.default_rng(1)
    p = rng.normal(size=(6000, 3))
    p = 0.04 * p / np.linalg.norm(p, axis=1, keepdims=True) + [0, 0, 0.04]
    seen = p[p[:, 2] > 0.015]
    solid = fill_solid(seen)
    volume = solid.cells.sum() * solid.size_m**3
    # Under the unseen belly it stands on the plane: between the ball and its upright hull.
    ball = 4 / 3 * np.pi * 0.04**3
    assert 0.95 * ball < volume < 1.3 * ball
