"""The settings of a replay with what a calibration found: values, and how sure it is of them."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from twin.replay.config import ReplayConfig
from twin.replay.place import physics_for, physics_of
from twin.scene.calibration import Calibration


def calibrated(config: ReplayConfig, calibration: Calibration | None) -> ReplayConfig:
    """Use calibrated physics, but for the fields that the user set to something of their own.

    Samples then vary what was identified by as much as the calibration leaves open.
    """
    if calibration is None:
        return config
    physics = physics_for(config.physics, calibration)
    taken = {
        name
        for name, value in physics_of(calibration.record).items()
        if getattr(physics, name) == value
    }
    spreads = tuple(
        (name, spread) for name, spread in spreads_of(calibration).items() if name in taken
    )
    return replace(config, physics=physics, variation=replace(config.variation, calibrated=spreads))


def spreads_of(calibration: Calibration) -> dict[str, float]:
    """Standard deviation of the logarithm per identified field of ``PhysicsConfig``, by name."""
    part = calibration.record.get("physics")
    identified = part.get("identified") if isinstance(part, Mapping) else None
    if not isinstance(identified, Mapping):
        return {}
    found = {
        name: item.get("sigma_log")
        for name, item in sorted(identified.items())
        if isinstance(item, Mapping)
    }
    return {
        name: float(value)
        for name, value in found.items()
        if isinstance(value, int | float) and np.isfinite(value) and value >= 0
    }
