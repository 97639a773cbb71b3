"""PyBullet without the line about its build that it prints on standard error when imported."""

import importlib
import os
from functools import partial
from types import ModuleType
from typing import Any

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


class Client:
    """PyBullet's functions for one of its clients, without its number in every call."""

    def __init__(self, number: int) -> None:
        """Remember PyBullet's number."""
        self.number = number

    def __getattr__(self, name: str) -> Any:
        """One of PyBullet's functions; remembered, for some are called in every step."""
        bound = partial(getattr(pybullet, name), physicsClientId=self.number)
        setattr(self, name, bound)
        return bound


_IDLE: list[Client] = []
"""Clients that no world uses. To make one costs 4 to 15 ms, to empty one 2, and the bits are the
same (a test)."""


def open_client(config: PhysicsConfig) -> Client:
    """Take an empty client and give it the settings of every world: rate, solver, gravity."""
    client = _IDLE.pop() if _IDLE else Client(int(pybullet.connect(pybullet.DIRECT)))
    client.resetSimulation()
    client.setPhysicsEngineParameter(
        fixedTimeStep=1.0 / config.rate_hz,
        numSolverIterations=config.solver_iterations,
        solverResidualThreshold=config.solver_residual,
        numSubSteps=0,
        deterministicOverlappingPairs=1,
        enableFileCaching=0,
    )
    client.setGravity(0, 0, -config.gravity_m_s2)
    return client


def give_client_back(client: Client) -> None:
    """Let another world have a client; of several that nobody uses, one is kept."""
    if _IDLE:
        client.disconnect()
    else:
        _IDLE.append(client)


ENGINE = "pybullet"
ENGINE_VERSION = f"{ENGINE}-{pybullet.getAPIVersion()}"
