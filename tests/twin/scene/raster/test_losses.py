"""What the fit minimises, and its gradient."""

from typing import Literal

import numpy as np
import pytest
from reference_loss import Loss

Kind = Literal["3dgs", "paper"]


@pytest.mark.parametrize("kind", ["3dgs", "paper"])
def test_the_gradient_of_the_loss_agrees_with_finite_differences(kind: Kind) -> None:
    rng = np.random.default_rng(0)
    planes = rng.uniform(0.1, 0.9, size=(5, 12, 14)).astype(np.float32)
    target = rng.uniform(size=(3, 12, 14)).astype(np.float32)
    depth = rng.uniform(0.5, 2.0, size=(12, 14)).astype(np.float32)
    depth[:4] = 0.0
    loss = Loss(kind, depth_weight=0.3, threads=1)
    direction = rng.normal(size=planes.shape).astype(np.float32)
    # |x| has a kink: keep every difference at least ten steps away from it.
    step = np.float32(1e-4)
    target += 0.01 * np.sign(target - planes[:3])
    gradient = loss(planes, target, depth)[2]
    ahead, behind = (loss(planes + s * step * direction, target, depth)[0] for s in (1, -1))
    assert (ahead - behind) / (2 * step) == pytest.approx(
        float((gradient * direction).sum()), rel=0.03, abs=3e-3
    )


def test_unmeasured_depth_does_not_count() -> None:
    rng = np.random.default_rng(0)
    planes = rng.uniform(size=(5, 8, 8)).astype(np.float32)
    _, _, gradient = Loss("paper", depth_weight=1.0, threads=1)(
        planes, planes[:3].copy(), np.zeros((8, 8), dtype=np.float32)
    )
    assert np.abs(gradient).max() == 0.0


def test_the_paper_loss_is_the_squared_error_plus_weighted_depth() -> None:
    rng = np.random.default_rng(0)
    planes = rng.uniform(size=(5, 8, 8)).astype(np.float32)
    target = rng.uniform(size=(3, 8, 8)).astype(np.float32)
    depth = np.full((8, 8), 2.0, dtype=np.float32)
    value, mse, _ = Loss("paper", depth_weight=0.5, threads=1)(planes, target, depth)
    assert mse == pytest.approx(float(np.mean((planes[:3] - target) ** 2)), rel=1e-5)
    relative = np.abs(planes[3] - planes[4] * 2.0) / 2.0
    assert value == pytest.approx(mse + 0.5 * float(relative.mean()), rel=1e-5)
