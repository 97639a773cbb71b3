"""What two pads hold: as much as friction gives, whatever the shape of the pads' edges."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from twin.physics.soft import SoftModel
from twin.physics.soft_solver import SoftSolver, add_body, box_piece

PERIOD_S = 1 / 240
PAD_M = (0.022, 0.014, 0.022)
TALL_M = (0.022, 0.014, 0.4)
WIDE_M = (0.2, 0.014, 0.022)
CLOSING, RESTING = 60, 30
Boxes = Callable[..., SoftModel]


def at(x: float, y: float, z: float) -> np.ndarray:
    return np.array([x, y, z, 0, 0, 0, 1.0])


@dataclass(frozen=True, kw_only=True)
class Held:
    """What became of a toy between two pads when the table under it went away."""

    fell_m: float
    pressed_N: float
    """By each pad, at the end."""
    carried_N: float
    """By both pads, at the end."""


def let_hang(
    model: SoftModel,
    *,
    friction: float,
    gravity: float,
    squeeze_m: float,
    pad_m: tuple[float, float, float] = PAD_M,
    hang_s: float = 0.25,
) -> Held:
    """Close two pads on a toy that lies on a smooth table, and take the table away."""
    _, width, height = model.size_m
    solver = SoftSolver(PERIOD_S, 10, gravity)
    pieces = [box_piece(np.array(size), np.eye(4)) for size in (pad_m, pad_m, (2.0, 2.0, 0.4))]
    mu = (friction, friction, 0.0)
    z, apart = height / 2, (width + pad_m[1]) / 2 + 0.001
    places = [at(0, apart, z), at(0, -apart, z), at(0, 0, -0.2)]
    ids = [
        solver.add_collider(p.planes, p.corners_m, place, f, 0.0, np.ones(3))
        for p, place, f in zip(pieces, places, mu, strict=True)
    ]
    T = np.eye(4)
    T[2, 3] = z
    index, _ = add_body(solver, model, T, young_pa=model.young_pa, friction=1.0)
    before = np.nan
    for step in range(CLOSING + RESTING + round(hang_s / PERIOD_S)):
        y = apart - (squeeze_m + 0.001) * min(1.0, (step + 1) / CLOSING)
        down = 0.4 * max(0, step - CLOSING - RESTING) * PERIOD_S
        if step == CLOSING + RESTING:
            before = solver.nodes(index)[:, 2].mean()
        solver.step(
            np.array(ids, dtype=np.int32),
            np.array([at(0, y, z), at(0, -y, z), at(0, 0, -0.2 - down)]),
        )
    pushes = solver.pushes()[ids[:2], :3] / PERIOD_S
    return Held(
        fell_m=float(before - solver.nodes(index)[:, 2].mean()),
        pressed_N=float(np.abs(pushes[:, 1]).mean()),
        carried_N=float(-pushes[:, 2].sum()),
    )


@pytest.mark.parametrize("friction", [0.3, 0.8])
@pytest.mark.parametrize("pad_m", [PAD_M, WIDE_M, TALL_M], ids=["finger", "wide", "tall"])
def test_a_toy_slips_when_it_weighs_more_than_friction_gives(
    box_of_cells: Boxes, friction: float, pad_m: tuple[float, float, float]
) -> None:
    model = box_of_cells((6, 3, 3), mass_kg=0.06)
    how = {"friction": friction, "squeeze_m": 0.003, "pad_m": pad_m}
    light = let_hang(model, gravity=1.0, **how)
    most = 2 * friction * light.pressed_N / model.mass_kg
    held, slips = (let_hang(model, gravity=share * most, **how) for share in (0.9, 1.1))
    assert held.fell_m < 0.01
    assert held.carried_N == pytest.approx(0.9 * most * model.mass_kg, rel=0.05)
    assert slips.fell_m > 0.05


def test_what_bulges_above_a_finger_does_not_hang_on_its_edge(box_of_cells: Boxes) -> None:
    model = box_of_cells((6, 3, 3), mass_kg=0.06)
    assert let_hang(model, friction=0.0, gravity=9.81, squeeze_m=0.0015).fell_m > 0.05


def test_a_toy_that_slides_is_held_back_by_friction_alone(box_of_cells: Boxes) -> None:
    model = box_of_cells((6, 3, 3), mass_kg=0.06)
    light = let_hang(model, friction=0.5, gravity=1.0, squeeze_m=0.003, pad_m=TALL_M)
    most = 2 * 0.5 * light.pressed_N / model.mass_kg
    slides = let_hang(
        model, friction=0.5, gravity=1.3 * most, squeeze_m=0.003, pad_m=TALL_M, hang_s=0.1
    )
    assert slides.carried_N == pytest.approx(2 * 0.5 * slides.pressed_N, rel=0.05)
