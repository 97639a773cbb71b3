"""``robot-gst calibrate RUN --physics``: fit contact, write the record and its table."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bridge.episode import provenance
from bridge.episode.run_folder import RunFolder
from bridge.process_pool import default_size
from bridge.terminal import Output
from twin.calibrate.config import CalibrateConfig
from twin.calibrate.physics.cases import Case, read_cases
from twin.calibrate.physics.emulator import cloud_size
from twin.calibrate.physics.fit import Estimate, Fit, fit
from twin.calibrate.physics.parameters import (
    BIAS,
    FINGER_FRICTION,
    GRIP_FORCE,
    MASS_SCALE,
    SURFACE_FRICTION,
    rigid_parameters,
)
from twin.calibrate.physics.push_fit import (
    METHOD,
    calibrate_pushes,
    describe_pushes,
    has_motions,
)
from twin.calibrate.physics.simulate import Evaluator
from twin.physics.config import PhysicsConfig
from twin.physics.engine import ENGINE_VERSION
from twin.scene.store.calibration import write_physics

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
    skipped: Mapping[str, str],
) -> dict[str, Any]:
    """The ``physics`` part of ``calibration.json``.

    ``identified`` has the fields of ``PhysicsConfig`` that replays take over, empty when nothing
    was promoted.

    Args:
        cases: What it was fitted to, in the order its split refers to.
        config: Nominal physics; identified frictions are shares of its ``object_friction``.
        skipped: Why episodes were not used, by id.
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
        "held_out": {
            "episodes": [cases[index].episode for index in found.split.held_out],
            "nominal": found.nominal.to_record(),
            "calibrated": found.calibrated.to_record(),
        },
        "errors": found.calibrated_score.posterior.most_likely(),
        "sources": {case.episode: {"kind": case.kind, "sha256": case.sha256} for case in cases},
        "skipped": dict(skipped),
        "num_evaluations": found.num_evaluations,
    }
    if found.cut_short:
        record["cut_short"] = found.cut_short
    # Where no limit struck, no times are in here: the same inputs give the same id.
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


def describe_physics(record: Mapping[str, Any], calibration_id: str) -> str:
    """Say in a line per parameter what was found."""
    if record.get("method") == METHOD:
        return describe_pushes(record, calibration_id)
    lines = [f"physics: {record['why']}; calibration {calibration_id}, {record['engine']}"]
    if "cut_short" in record:
        lines.append(
            f"  cut short: {record['cut_short']}; on another machine the numbers may be others. "
            "Give --budget more."
        )
    for name, item in record["parameters"].items():
        word = "identified" if item["identified"] else "not identified"
        lines.append(
            f"  {name:<22} {item['value']:>8.4g} [{item['low']:.4g}, {item['high']:.4g}] "
            f"{item['unit']:<3} {word}: {item['why']}"
        )
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


def calibrate_physics(
    run: RunFolder, config: CalibrateConfig, output: Output
) -> tuple[Mapping[str, Any], str]:
    """Find out about physics from a run's probes and trials, and write ``calibration.json``.

    A run of imported pushes without plans is fitted on a grid, see ``push_fit``.

    Args:
        run: Whose probes and trials are read, and in whose scene folder the calibration goes.

    Returns:
        The physics record that was made now, and the id of the calibration that holds now.

    Raises:
        NothingToCalibrateError: No probe or trial can be used.
    """
    if has_motions(run):
        return calibrate_pushes(run, config, output)
    cases, skipped = read_cases(run, output)
    physics = PhysicsConfig()
    parameters = rigid_parameters(physics)
    total = config.evaluations + 2 * cloud_size(len(parameters))
    output.say(
        f"{len(cases)} episodes: "
        + ", ".join(
            f"{sum(case.kind == kind for case in cases)} {kind}"
            for kind in sorted({case.kind for case in cases})
        )
    )
    workers = config.workers or default_size()
    with (
        Evaluator(cases, parameters, physics, workers=workers) as evaluator,
        output.progress("physics", total) as advance,
    ):
        found = fit(
            evaluator,
            parameters,
            config,
            advance=lambda done, note: advance(min(done, total), note),
        )
    record = physics_record(found, cases, physics, skipped)
    return record, str(write_physics(run, record)["calibration_id"])
