"""A real push: where the twin's cube ends, beside a motion-captured one and published simulators.

The protocol is docs/real_number.md, whose tables this prints. Needs the Kinova reality-gap data
under GST_SHARED_DATA. Argument: a run folder (default: one under GST_BENCH_WORK); what is there
already is not made again, so delete ``scene/calibration.json`` to identify friction anew.
"""

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, median
from typing import Any

import numpy as np
from measure import ROOT, Target, report_targets

from bridge.episode.reader import Episode
from bridge.episode.streams import object_pose_topics, pose_track
from evaluator.errors import UndefinedStatisticError
from evaluator.statistics.intervals import median_interval

DATA = Path(os.environ.get("GST_SHARED_DATA", ROOT.parent / "shared" / "data"))
KINOVA = DATA / "robot_realitygap_kinova_real_vs_sim"
TWIN = "twin-pybullet"
RULE = "no physics: mean of the identifying runs"
EXECUTED = f"{TWIN} executed calibrated"
PLANNED_TOOL = f"{TWIN} planned calibrated"


def gst(*words: str) -> None:
    """Run a command of this project."""
    subprocess.run([Path(sys.executable).with_name("robot-gst"), *words], check=True)


def make(run: Path) -> None:
    """Import, replay at nominal friction, identify friction, replay again, evaluate."""
    calibration = run / "scene" / "calibration.json"
    script = ROOT / "datasets" / "kinova" / "make_episodes.py"
    subprocess.run([sys.executable, script, KINOVA, run], check=True)
    if not calibration.is_file():
        gst("replay", str(run), "--workers", "1")
        gst("calibrate", str(run), "--physics")
    gst("replay", str(run), "--workers", "1")
    gst("evaluate", str(run))


def errors_of(
    results: Mapping[str, Any], task: str, body: str, column: str, runs: Sequence[str] = ()
) -> dict[str, dict[str, float]]:
    """Error of each recorded run, or of some, by engine [mm]."""
    found: dict[str, dict[str, float]] = {}
    for table in results["tables"]:
        if not table["id"].startswith("runs_of_end_points"):
            continue
        for values in table["rows"]:
            row = dict(zip(table["columns"], values, strict=True))
            name = str(row["recorded run"])
            if row["body"] == body and name.startswith(f"{task}_") and name in (runs or [name]):
                found.setdefault(row["engine"], {})[name] = row[column]
    return found


def without_physics(
    run: Path, fitted: Sequence[str], held_out: Sequence[str]
) -> dict[str, dict[str, float]]:
    """What saying the mean of the identifying runs gives: end and displacement errors [mm]."""
    cubes = {}
    for name in (*fitted, *held_out):
        episode = Episode.open(run / "episodes" / f"{name}.mcap")
        cubes[name] = 1e3 * pose_track(episode, object_pose_topics(episode)["cube"]).p_m
    ends = {name: p[-1] for name, p in cubes.items()}
    ways = {name: p[-1] - p[0] for name, p in cubes.items()}
    return {
        what: {
            name: float(np.linalg.norm(each[name] - np.mean([each[f] for f in fitted], axis=0)))
            for name in held_out
        }
        for what, each in (("end", ends), ("way", ways))
    }


def summary(values: Sequence[float]) -> str:
    """Median with its interval."""
    try:
        interval = median_interval(values)
    except UndefinedStatisticError:
        return f"{median(values):.1f}"
    return f"{median(values):.1f} [{interval.low:.1f}, {interval.high:.1f}]"


def print_table(
    results: Mapping[str, Any],
    held_out: Sequence[str],
    rule: Mapping[str, Mapping[str, float]],
    tools: Mapping[str, Mapping[str, float]],
) -> None:
    """Print every engine's medians over held-out runs, best first; the tool's means and worst."""
    ends = errors_of(results, "cubeexp", "cube", "end-point error (mm)")
    ways = errors_of(results, "cubeexp", "cube", "displacement error (mm)")
    ends[RULE], ways[RULE] = dict(rule["end"]), dict(rule["way"])
    print(f"| cube, {len(held_out)} held-out runs | end point (mm) | displacement (mm) |")
    print("|---|---|---|")
    for engine in sorted(ends, key=lambda name: median([ends[name][run] for run in held_out])):
        cells = (summary([errors[engine][run] for run in held_out]) for errors in (ends, ways))
        print(f"| {engine} | {' | '.join(cells)} |")
    print("\n| tool, Experiment 1, held out | mean (mm) | worst (mm) |\n|---|---|---|")
    for engine in sorted(tools, key=lambda name: mean(tools[name].values())):
        values = tools[engine].values()
        print(f"| {engine} | {mean(values):.2f} | {max(values):.2f} |")


def main() -> None:
    """Make the run where needed, print its tables, and store how far the targets were met."""
    if not KINOVA.is_dir():
        print(f"skipped: {KINOVA} is not here (set GST_SHARED_DATA)")
        return
    work = Path(os.environ.get("GST_BENCH_WORK", ROOT / "benchmarks" / "work"))
    run = Path(sys.argv[1]) if len(sys.argv) > 1 else work / "real_push"
    make(run)
    results = json.loads((run / "results" / "results.json").read_text())
    calibration = json.loads((run / "scene" / "calibration.json").read_text())
    physics, motion = calibration["physics"], calibration["motion"]
    held_out = physics["held_out"]["episodes"]
    rule = without_physics(run, physics["fitted_to"], held_out)
    others = motion["held_out"]["episodes"]
    found = errors_of(results, "single", "tool", "end-point error (mm)", others)
    print_table(results, held_out, rule, found)
    ends = errors_of(results, "cubeexp", "cube", "end-point error (mm)")
    medians = {name: median([each[run] for run in held_out]) for name, each in ends.items()}
    best = min((value, name) for name, value in medians.items() if not name.startswith(TWIN))
    tools = {name: mean(each.values()) for name, each in found.items()}
    tool = min((value, name) for name, value in tools.items() if not name.startswith(TWIN))
    report_targets(
        "replay_real_push",
        [
            Target(
                what="cube, median end point, held out",
                measured=medians[EXECUTED],
                limit=6.0,
                unit="mm",
            ),
            Target(
                what="the same, against the best simulator",
                measured=medians[EXECUTED],
                limit=best[0],
                unit="mm",
                reference=best[1],
            ),
            Target(
                what="tool of Experiment 1, schedule, held out",
                measured=tools[PLANNED_TOOL],
                limit=min(6.0, tool[0]),
                unit="mm",
                reference=f"{tool[1]} {tool[0]:.2f} mm",
            ),
        ],
        note=f"{len(held_out)} held-out runs; simulators as published, driven by the schedule",
        medians_mm=medians,
        without_physics_mm=median(rule["end"].values()),
        tool_mm=tools,
        physics={name: physics[name] for name in ("parameters", "held_out", "fitted")},
    )


if __name__ == "__main__":
    main()
