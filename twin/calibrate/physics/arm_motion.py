"""The arm of imported recordings, from how its tool moved: see ``twin.calibrate.motion``.

Of the runs of each task in the order of their numbers the first, third, fifth ... identify, all
tasks together; the others are held out and say whether *planned* comes nearer.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from statistics import median
from typing import Any

import numpy as np

from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.terminal import Output
from twin.calibrate.config import CalibrateConfig
from twin.calibrate.motion import Motion, find_motion
from twin.calibrate.physics.push_fit import calibrate_pushes, describe_pushes, recordings, split
from twin.calibrate.physics.pushes import Push, UnusablePushError, arm_of, described, seen_of
from twin.calibrate.weights import calibrate_weights, describe_weights
from twin.replay.rebuilt_scene import MASSES
from twin.scene.store.calibration import write_part

PART = "motion"
"""Of ``calibration.json``."""


def calibrate_motion(run: RunFolder) -> tuple[dict[str, Any], str]:
    """Fit half of a run's recordings, score the others, write it; record and calibration's id."""
    pushes, skipped = recordings(run)
    if len({(push.motion.robot, push.motion.hand_link) for push in pushes}) != 1:
        raise UnusablePushError(
            f"{run.path} holds no imported recordings, or those of several arms."
        )
    tasks = sorted({push.task for push in pushes})
    first = {task: split([p.episode for p in pushes if p.task == task])[0] for task in tasks}
    fitted = [name for names in first.values() for name in names]
    seen = [seen_of(push) for push in pushes if push.episode in fitted]
    found = find_motion(arm_of(pushes[0]), seen, described(pushes[0]).T_frame_base)
    delays = {task: median(found.delays_s[name] for name in first[task]) for task in tasks}
    rows = {
        push.episode: (
            end_point_m(push, described(push)),
            end_point_m(push, replace(found.motion, delay_s=delays[push.task])),
        )
        for push in pushes
        if push.episode not in fitted
    }
    nominal, calibrated = np.array(list(rows.values())).reshape(-1, 2).T
    record: dict[str, Any] = {
        **found.motion.to_record(),
        "delay_s": delays,
        "promoted": bool(rows) and bool(calibrated.mean() < nominal.mean()),
        "parameters": found.parameters,
        "rms_m": found.rms_m,
        "fitted_to": fitted,
        "held_out": {
            "episodes": list(rows),
            "nominal_m": nominal.tolist(),
            "calibrated_m": calibrated.tolist(),
        },
        "sources": {push.episode: push.sha256 for push in pushes},
        "skipped": skipped,
    }
    return write_part(run, PART, record)


def end_point_m(push: Push, motion: Motion) -> float:
    """How far from the recorded tool the planned one is at the end of the recording."""
    told = seen_of(push)
    last = told.joints_at(told.seen_s[-1:], motion.delay_s)
    T = motion.Ts_frame_hand(arm_of(push), last)[0] @ motion.T_hand_tool
    return float(np.linalg.norm(T[:3, 3] - push.tool.p_m[-1]))


def motion_for(record: Mapping[str, Any] | None, task: str) -> Motion | None:
    """What a calibration knows of an arm in a task; None where held-out runs did not confirm it."""
    if not record or not record["promoted"] or task not in record["delay_s"]:
        return None
    return Motion.from_record(record, float(record["delay_s"][task]))


def describe_motion(record: Mapping[str, Any], calibration_id: str) -> str:
    """Say in a line per number what the motion showed and what not."""
    held = record["held_out"]
    used = "planned replays use it" if record["promoted"] else "nothing uses it"
    lines = [f"motion: {len(record['fitted_to'])} recordings; calibration {calibration_id}; {used}"]
    for name, item in record["parameters"].items():
        word = f"not determined: {item['why']}" if item["why"] else "determined"
        lines.append(
            f"  {name:<32} {item['value']:>9.4f} [{item['low']:.4f}, {item['high']:.4f}] "
            f"{item['unit']:<6} {word}"
        )
    for name in ("nominal", "calibrated") if held["episodes"] else ():
        mm = 1e3 * np.array(held[f"{name}_m"])
        told = f"(mean of {len(mm)}; worst {mm.max():.1f})"
        lines.append(f"  held out, {name}: the planned tool ends {mm.mean():.1f} mm off {told}")
    return "\n".join([*lines, *(f"  {name}: {why}" for name, why in record["skipped"].items())])


def calibrate_physics(
    run: RunFolder, config: CalibrateConfig, output: Output
) -> tuple[dict[str, Any], str]:
    """Find the arm's motion, its pushes' friction and what it weighed, where a run has them."""
    parts: dict[str, tuple[Callable[[], tuple[Any, str]], Callable[[Any, str], str]]] = {
        PART: (lambda: calibrate_motion(run), describe_motion),
        "physics": (lambda: calibrate_pushes(run, config, output), describe_pushes),
        MASSES: (lambda: calibrate_weights(run), describe_weights),
    }
    record, words = dict[str, Any](), []
    for name, (calibrate, describe) in parts.items():
        try:
            record[name], record["calibration_id"] = calibrate()
            words.append(describe(record[name], record["calibration_id"]))
        except (UsageError, UnusablePushError) as error:
            words.append(f"{name}: {error}")
    if not record:
        raise UnusablePushError(" ".join(words))
    return record, "\n".join(words)
