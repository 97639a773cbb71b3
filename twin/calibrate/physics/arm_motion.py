"""The arm of imported recordings, from how its tool moved: see ``twin.calibrate.motion``.

Of the runs of each task in the order of their numbers the first, third, fifth ... identify, all
tasks together; the others are held out and say whether *planned* comes nearer.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from statistics import median
from typing import Any

import numpy as np

from bridge.episode import provenance
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.terminal import Output
from twin.calibrate.config import CalibrateConfig
from twin.calibrate.motion import Found, Motion, find_motion
from twin.calibrate.physics.push_fit import calibrate_pushes, describe_pushes, recordings, split
from twin.calibrate.physics.pushes import (
    Push,
    T_world_base,
    UnusablePushError,
    arm_of,
    described,
    seen_of,
)
from twin.scene.store.calibration import write_part

PART = "motion"
"""Of ``calibration.json``."""


def motion_of_pushes(pushes: Sequence[Push]) -> Found:
    """Fit one arm to recordings of it."""
    first = pushes[0]
    return find_motion(arm_of(first), [seen_of(p) for p in pushes], T_world_base(first.motion))


def calibrate_motion(run: RunFolder) -> tuple[dict[str, Any], str]:
    """Find the arm's motion from half of a run's recordings, score it on the others, write it.

    Returns:
        The record, and the id of the calibration that holds now.
    """
    pushes, skipped = recordings(run)
    if len({(push.motion.robot, push.motion.hand_link) for push in pushes}) != 1:
        message = f"{run.path} holds no imported recording of one arm alone."
        raise UnusablePushError(message)
    tasks = {push.task: [p for p in pushes if p.task == push.task] for push in pushes}
    parts = {task: split([p.episode for p in those]) for task, those in tasks.items()}
    fitted = [name for first, _ in parts.values() for name in first]
    found = motion_of_pushes([push for push in pushes if push.episode in fitted])
    delays = {
        task: median(found.delays_s[name] for name in first) for task, (first, _) in parts.items()
    }
    held_out = [push for push in pushes if push.episode not in fitted]
    errors = {
        name: {
            push.episode: end_point_m(
                push, replace(found.motion, delay_s=delays[push.task]) if name else None
            )
            for push in held_out
        }
        for name in ("", "calibrated")
    }
    means = {name: float(np.mean(list(each.values()))) for name, each in errors.items()}
    record: dict[str, Any] = {
        **found.motion.to_record(),
        "delay_s": delays,
        "promoted": bool(held_out) and means["calibrated"] < means[""],
        "parameters": {name: asdict(item) for name, item in found.parameters.items()},
        "delays_s": dict(found.delays_s),
        "rms_m": found.rms_m,
        "rms_rad": found.rms_rad,
        "fitted_to": fitted,
        "held_out": {"nominal_m": errors[""], "calibrated_m": errors["calibrated"]},
        "sources": {push.episode: push.sha256 for push in pushes},
        "skipped": skipped,
    }
    record["id"] = provenance.hash_settings(record)
    return record, str(write_part(run, PART, record)["calibration_id"])


def end_point_m(push: Push, motion: Motion | None) -> float:
    """How far from the recorded tool the planned one ends."""
    known, told = motion or described(push), seen_of(push)
    last = told.joints_at(told.seen_s[-1:], known.delay_s)
    T = known.Ts_frame_hand(arm_of(push), last)[0] @ known.T_hand_tool
    return float(np.linalg.norm(T[:3, 3] - push.tool.p_m[-1]))


def motion_for(record: Mapping[str, Any] | None, task: str) -> Motion | None:
    """What a calibration knows of an arm in a task; None where held-out runs did not confirm it."""
    if not record or not record["promoted"] or task not in record["delay_s"]:
        return None
    return Motion.from_record({**record, "delay_s": record["delay_s"][task]})


def describe_motion(record: Mapping[str, Any], calibration_id: str) -> str:
    """Say in a line per number what the motion showed and what not."""
    held = record["held_out"]
    lines = [
        f"motion: {len(record['fitted_to'])} recordings identify, "
        f"{len(held['nominal_m'])} are held out; calibration {calibration_id}"
    ]
    for name, item in record["parameters"].items():
        scale, unit = (1e3, "mm") if item["unit"] == "m" else (1.0, item["unit"])
        value, low, high = (scale * item[key] for key in ("value", "low", "high"))
        word = f"not determined: {item['why']}" if item["why"] else "determined"
        lines.append(f"  {name:<32} {value:>9.4g} [{low:.4g}, {high:.4g}] {unit:<7} {word}")
    for name in ("nominal", "calibrated"):
        values = [1e3 * value for value in held[f"{name}_m"].values()]
        if values:
            lines.append(
                f"  held out, {name}: the planned tool ends {np.mean(values):.1f} mm off (mean of "
                f"{len(values)}; worst {max(values):.1f})"
            )
    lines.append("  planned replays use it" if record["promoted"] else "  nothing uses it")
    return "\n".join([*lines, *(f"  {name}: {why}" for name, why in record["skipped"].items())])


def calibrate_imported(
    run: RunFolder, config: CalibrateConfig, output: Output
) -> tuple[dict[str, Any], str]:
    """Find the arm's motion and the friction of its pushes, as far as a run holds them.

    Returns:
        What was found by ``motion`` and ``physics``, and the same in words.
    """
    record: dict[str, Any] = {}
    words, reasons, calibration_id = [], [], ""
    try:
        record[PART], calibration_id = calibrate_motion(run)
        words.append(describe_motion(record[PART], calibration_id))
    except (UsageError, UnusablePushError) as error:
        reasons.append(f"motion: {error}")
    try:
        record["physics"], calibration_id = calibrate_pushes(run, config, output)
        words.append(describe_pushes(record["physics"], calibration_id))
    except UnusablePushError as error:
        reasons.append(f"friction: {error}")
    if not record:
        raise UnusablePushError(" ".join(reasons))
    return {**record, "calibration_id": calibration_id}, "\n".join([*words, *reasons])
