"""Keep a calibration of physics, and say it in a table."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bridge.episode import provenance
from twin.calibrate.physics.case import Case
from twin.calibrate.physics.delay import Delay
from twin.calibrate.physics.fit import Estimate, Fit
from twin.calibrate.physics.incline import pybullet_friction
from twin.calibrate.physics.parameters import (
    BIAS,
    FINGER_FRICTION,
    GRIP_FORCE,
    MASS_SCALE,
    SURFACE_FRICTION,
)
from twin.physics.config import PhysicsConfig
from twin.physics.engine import ENGINE_VERSION

FIELDS = {
    FINGER_FRICTION: "finger_friction",
    SURFACE_FRICTION: "surface_friction",
    GRIP_FORCE: "grip_force_N",
}
"""Parameters that are fields of ``PhysicsConfig``; the frictions after division by the objects'."""
LOG_95 = 2 * 1.96


def physics_record(
    found: Fit,
    cases: Sequence[Case],
    config: PhysicsConfig,
    delay: Delay | None,
    skipped: Mapping[str, str],
) -> dict[str, Any]:
    """The ``physics`` part of ``calibration.json``.

    ``identified`` has the fields of ``PhysicsConfig`` that replays take over, empty when nothing
    was promoted.
    """
    by_name = {item.parameter.name: item for item in found.estimates}
    record = {
        "promoted": found.promoted,
        "why": found.why,
        "engine": ENGINE_VERSION,
        "identified": _identified(by_name, config) if found.promoted else {},
        "pose_bias": _others(by_name, BIAS, promoted=found.promoted),
        "masses": _others(by_name, (MASS_SCALE,), promoted=found.promoted),
        "parameters": {name: _parameter(item) for name, item in by_name.items()},
        "command_delay_s": _delay(delay),
        "effective_friction": _effective(by_name, config) if found.promoted else {},
        "held_out": {
            "episodes": [cases[index].episode for index in found.split.held_out],
            "nominal": found.nominal.to_record(),
            "calibrated": found.calibrated.to_record(),
        },
        "errors": found.calibrated_score.beliefs.most_likely(),
        "sources": {case.episode: {"kind": case.kind, "sha256": case.sha256} for case in cases},
        "skipped": dict(skipped),
        "num_evaluations": found.num_evaluations,
    }
    # No times in here: the same inputs give the same id.
    return {**record, "id": provenance.hash_settings(record)}


def _identified(by_name: Mapping[str, Estimate], config: PhysicsConfig) -> dict[str, Any]:
    fields = {}
    for name, field in FIELDS.items():
        item = by_name.get(name)
        if item is None or not item.identified:
            continue
        unit = 1.0 if name == GRIP_FORCE else config.object_friction
        fields[field] = {
            "value": item.value / unit,
            "low": item.low / unit,
            "high": item.high / unit,
            "sigma_log": float(np.log(item.high / item.low)) / LOG_95,
        }
    return fields


def _others(
    by_name: Mapping[str, Estimate], names: Sequence[str], *, promoted: bool
) -> dict[str, Any]:
    return {
        name: {"value": item.value, "low": item.low, "high": item.high}
        for name in names
        if promoted and (item := by_name.get(name)) is not None and item.identified
    }


def _parameter(item: Estimate) -> dict[str, Any]:
    return {
        "about": item.parameter.about,
        "unit": item.parameter.unit,
        "nominal": item.parameter.nominal,
        "value": item.value,
        "best": item.best,
        "low": item.low,
        "high": item.high,
        "identified": item.identified,
        "why": item.why,
        "share_of_prior": item.sigma_share,
    }


def _delay(delay: Delay | None) -> dict[str, Any]:
    if delay is None:
        return {"identified": False, "why": "fewer than 3 executed plans with joints of their own"}
    return {
        "identified": True,
        "value": delay.value_s,
        "low": delay.low_s,
        "high": delay.high_s,
        "num_episodes": delay.num_episodes,
        "why": "recorded joints laid over the commanded ones",
    }


def _effective(by_name: Mapping[str, Estimate], config: PhysicsConfig) -> dict[str, float]:
    """What the engine makes of the found coefficients, by the incline test."""
    own = config.object_friction
    return {
        name: pybullet_friction(own, by_name[name].value / own, config)
        for name in (FINGER_FRICTION, SURFACE_FRICTION)
        if name in by_name and by_name[name].identified
    }


def describe_physics(record: Mapping[str, Any], calibration_id: str) -> str:
    """Say in a line per parameter what was found."""
    lines = [f"physics: {record['why']}; calibration {calibration_id}, {record['engine']}"]
    for name, item in record["parameters"].items():
        word = "identified" if item["identified"] else "not identified"
        lines.append(
            f"  {name:<22} {item['value']:>8.4g} [{item['low']:.4g}, {item['high']:.4g}] "
            f"{item['unit']:<3} {word}: {item['why']}"
        )
    delay = record["command_delay_s"]
    told = (
        f"{delay['value']:>8.4g} [{delay['low']:.4g}, {delay['high']:.4g}] s   identified"
        if delay["identified"]
        else "         not identified"
    )
    lines.append(f"  {'command_delay_s':<22} {told}: {delay['why']}")
    errors = record["errors"]
    own = ", ".join(f"{kind} {size * 1e3:.2g} mm" for kind, size in errors["pose_m"].items())
    lines.append(
        f"  likeliest errors: {errors['noise_share']:.0%} of what localisation states changes from "
        f"pose to pose; the twin's own: {own or 'no pose'}"
    )
    held = record["held_out"]
    for label in ("nominal", "calibrated"):
        item = held[label]
        median = item["settled_error_median_m"]
        error = "no pose" if median is None else f"settled poses off by {median * 1e3:.1f} mm"
        lines.append(
            f"  held out, {label}: {error} (median of {item['num_poses']}), "
            f"log-likelihood {item['log_likelihood']:.1f}"
        )
    return "\n".join(lines)
