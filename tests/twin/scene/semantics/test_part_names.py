import numpy as np
import pytest
import table_scene
from table_scene import Piece, iou, make_world, table

from twin.scene.semantics.shape_descriptors import find_parts


def parts_of(pieces: list[Piece]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The true parts of the points of the fused instance 1, and the parts found."""
    world = make_world([table(), *pieces], num_train=10, num_held_out=0)
    own = world.true_instances() == 1
    p = world.cloud.means_m[own].astype(np.float64)
    truth = np.array([piece.part for piece in world.pieces])[world.true_pieces()[own]]
    return truth, find_parts(p, 0.004)


def mean_iou(truth: np.ndarray, parts: dict[str, np.ndarray], names: tuple[str, ...]) -> float:
    nothing = np.zeros(len(truth), dtype=bool)
    return float(np.mean([iou(parts.get(n, nothing), truth == n) for n in names]))


@pytest.mark.slow
def test_a_basket_has_rim_floor_walls_and_handle() -> None:
    truth, parts = parts_of(table_scene.basket(1, 0.0, 0.0))
    assert mean_iou(truth, parts, ("rim", "floor", "walls", "handle")) > 0.75


def test_an_open_box_has_no_handle() -> None:
    _, parts = parts_of(table_scene.open_box(1, 0, 0, table_scene.BLUE))
    assert set(parts) == {"rim", "floor", "walls"}
    assert (np.sum(list(parts.values()), axis=0) == 1).all()


def test_a_solid_box_gets_no_invented_cavity() -> None:
    _, parts = parts_of([table_scene.box(1, [0, 0, 0.03], [0.08, 0.08, 0.06], table_scene.RED)])
    assert parts == {}
