"""PyBullet without the line about its build that it prints on standard error when imported."""

import importlib
import os
from types import ModuleType

from twin.physics.config import PhysicsConfig


def _import_quietly() -> ModuleType:
    saved = os.dup(2)
    silence = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(silence, 2)
        return importlib.import_module("pybullet")
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(silence)


pybullet = _import_quietly()

_IDLE: list[int] = []
"""Clients that no world uses. To make one costs 4 to 15 ms, to empty one 2, and the bits are the
same (a test)."""


def open_client(config: PhysicsConfig) -> int:
    """Take an empty client and give it the settings of every world: rate, solver, gravity."""
    client = _IDLE.pop() if _IDLE else int(pybullet.connect(pybullet.DIRECT))
    pybullet.resetSimulation(physicsClientId=client)
    pybullet.setPhysicsEngineParameter(
        fixedTimeStep=1.0 / config.rate_hz,
        numSolverIterations=config.solver_iterations,
        solverResidualThreshold=config.solver_residual,
        numSubSteps=0,
        deterministicOverlappingPairs=1,
        enableFileCaching=0,
        physicsClientId=client,
    )
    pybullet.setGravity(0, 0, -config.gravity_m_s2, physicsClientId=client)
    return client


def give_client_back(client: int) -> None:
    """Let another world have a client; of several that nobody uses, one is kept."""
    if _IDLE:
        pybullet.disconnect(physicsClientId=client)
    else:
        _IDLE.append(client)


ENGINE = "pybullet"
ENGINE_VERSION = f"{ENGINE}-{pybullet.getAPIVersion()}"
