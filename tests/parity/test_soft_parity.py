"""The soft bodies' kernels against NumPy: one substep, tetrahedron by tetrahedron."""

import numpy as np
import pytest

from bridge.task.meshes.lattice import volumes_m3
from twin.physics.soft_solver import SoftSolver

SUBSTEP_S = 1.0 / 2400
YOUNG, POISSON = 6e4, 0.2
MU = YOUNG / (2 * (1 + POISSON))
LAME = YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
LAMBDA = LAME + MU
METRIC = 2 * MU + 1.5 * LAME
COUPLING = 2.0
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
FIVE = np.array([[0, 3, 5, 6], [1, 0, 3, 5], [2, 0, 3, 6], [4, 0, 5, 6], [7, 3, 5, 6]])


def block() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two cubes of 14 mm side by side: nodes, tetrahedra, masses."""
    nodes = np.concatenate([CUBE, CUBE + np.array([1.0, 0.0, 0.0])])
    tets = np.concatenate([FIVE, 8 + (7 - FIVE)])
    used, index = np.unique(np.round(nodes[tets].reshape(-1, 3), 6), axis=0, return_inverse=True)
    nodes, tets = 0.014 * used, index.reshape(-1, 4)
    wrong = volumes_m3(nodes, tets) < 0
    tets[wrong] = tets[wrong][:, [1, 0, 2, 3]]
    return nodes, tets.astype(np.int32), np.linspace(2e-4, 6e-4, len(nodes))


def material_stress(F: np.ndarray) -> np.ndarray:
    cofactor = np.linalg.det(F) * np.linalg.inv(F).T
    return np.asarray(MU * F + LAMBDA * (np.linalg.det(F) - 1 - MU / LAMBDA) * cofactor)


class Reference:
    """One body without contacts, in double precision."""

    def __init__(self, nodes: np.ndarray, tets: np.ndarray, masses: np.ndarray) -> None:
        """At rest."""
        self.x, self.v = nodes.copy(), np.zeros_like(nodes)
        self.w, self.tets = 1.0 / masses, tets
        self.stress = np.zeros((len(tets), 3, 3))
        edges = np.swapaxes(nodes[tets[:, 1:]] - nodes[tets[:, :1]], 1, 2)
        inverse = np.linalg.inv(edges)
        self.b = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
        self.volume = np.linalg.det(edges) / 6

    def substep(self, order: list[int], gravity: float) -> None:
        h2 = SUBSTEP_S**2
        self.v[:, 2] -= gravity * SUBSTEP_S
        predicted = self.x + self.v * SUBSTEP_S
        x = predicted.copy()
        for t in order:
            self._move(x, t, self.stress[t])
        for t in order:
            ids, b = self.tets[t], self.b[t]
            F = x[ids].T @ b
            N = (b.T * self.w[ids]) @ b
            step = np.linalg.inv(np.eye(3) + METRIC * h2 * self.volume[t] * N)
            change = (material_stress(F) - self.stress[t]) @ step
            cofactor = np.linalg.det(F) * np.linalg.inv(F)
            stiff = METRIC + 0.5 * LAMBDA * ((cofactor**2).sum() - 3)
            shrink = min(1.0, METRIC / stiff)
            self._move(x, t, change * shrink)
            kept = min(1.0, COUPLING / (1 / np.linalg.eigvalsh(step)[0] - 1))
            self.stress[t] = (self.stress[t] + change * shrink) * kept * shrink
        self.v += (x - predicted) / SUBSTEP_S
        self.x = x

    def _move(self, x: np.ndarray, t: int, stress: np.ndarray) -> None:
        ids = self.tets[t]
        step = SUBSTEP_S**2 * self.volume[t]
        x[ids] -= self.w[ids, None] * step * (self.b[t] @ stress.T)


def native(isa: str, nodes: np.ndarray, tets: np.ndarray, masses: np.ndarray) -> SoftSolver:
    solver = SoftSolver(SUBSTEP_S, 1, 9.81, isa)
    none = np.zeros((0, 2), dtype=np.int32), np.zeros((0, 3), dtype=np.int32)
    solver.add_body(nodes, nodes, tets, masses, *none, YOUNG, POISSON, 0.0, 0.0, 0.5, 0.014)
    return solver


@pytest.mark.parity
@pytest.mark.parametrize("isa", ["base", "auto"])
def test_substeps_agree_with_numpy(isa: str) -> None:
    nodes, tets, masses = block()
    solver, reference = native(isa, nodes, tets, masses), Reference(nodes, tets, masses)
    v = np.random.default_rng(1).normal(0, 0.5, nodes.shape)
    solver.set_velocities(0, v)
    reference.v = v.copy()
    assert solver.num_substeps() == 1
    order = [t for t in solver.order(0) if t >= 0]
    assert sorted(order) == list(range(len(tets)))
    for _ in range(20):
        solver.step(np.zeros(0, dtype=np.int32), np.zeros((0, 7)))
        reference.substep(order, 9.81)
        # Single precision: 1e-7 of 0.03 m, and what twenty substeps make of it.
        np.testing.assert_allclose(solver.nodes(0), reference.x, atol=2e-7)
    np.testing.assert_allclose(solver.velocities(0), reference.v, atol=2e-3)


@pytest.mark.parity
def test_every_instruction_set_gives_the_same_bits() -> None:
    nodes, tets, masses = block()
    found = []
    for isa in ("base", "auto"):
        solver = native(isa, nodes, tets, masses)
        solver.set_velocities(0, np.random.default_rng(2).normal(0, 2.0, nodes.shape))
        for _ in range(200):
            solver.step(np.zeros(0, dtype=np.int32), np.zeros((0, 7)))
        found.append(solver.nodes(0).tobytes() + solver.velocities(0).tobytes())
    assert found[0] == found[1]


def test_an_unknown_instruction_set_is_refused() -> None:
    with pytest.raises(ValueError, match="auto, base or v3"):
        SoftSolver(0.01, 1, 9.81, "v9")
