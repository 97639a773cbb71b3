import numpy as np
import pytest
import table_scene
from table_scene import Piece, iou, make_world, table

from twin.scene.semantics.part_segmentation import (
    Parts,
    PartsConfig,
    find_parts,
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


def test_parts_move_with_the_thing() -> None:
    rng = np.random.default_rng(0)
    p = rng.normal(size=(3000, 3))
    p = 0.03 * p / np.linalg.norm(p, axis=1, keepdims=True) + [0, 0, 0.03]
    shift = np.array([0.5, -0.3, 0.0])
    first, second = (find_parts(q, "toy", 0.003, PartsConfig()) for q in (p, p + shift))
    for name, place in first.keypoints.items():
        np.testing.assert_allclose(second.keypoints[name], place + shift, atol=0.004)
