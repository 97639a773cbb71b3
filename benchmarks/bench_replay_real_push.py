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
    """Import, replay at nominal friction, calibrate, replay again."""
    calibration = run / "scene" / "calibration.json"
    script = ROOT / "datasets" / "kinova" / "make_episodes.py"
    subprocess.run([sys.executable, script, KINOVA, run], check=True)
    if not calibration.is_file():
        gst("replay", str(run), "--workers", "1")
        gst("calibrate", str(run), "--physics")
    gst("replay", str(run), "--workers", "1")


Ends = Mapping[str, Mapping[str, tuple[float, float]]]
"""By engine and recorded run: how far end and displacement are off [mm]."""


def errors_of(run: Path, task: str, body: str, names: Sequence[str]) -> Ends:
    """Compare the ends of a body with those of some recorded runs; of several files the mean."""
    tracks, found = {}, {}
    for name in names:
        tracks[name] = _ends(Episode.open(run / "episodes" / f"{name}.mcap"), body)
    for path in sorted((run / "derived").glob(f"{task}*.mcap"), key=lambda p: p.stat().st_mtime):
        episode = Episode.open(path)
        derived, (start, end) = episode.derived, _ends(episode, body)
        engine = derived.engine
        if engine == TWIN:
            engine += f" {derived.trajectory}" + " calibrated" * (
                derived.calibration_id is not None
            )
        source = derived.source_episode
        for name in tracks.keys() & ({source} if source else tracks.keys()):
            off = end - tracks[name][1]
            pair = (np.linalg.norm(off), np.linalg.norm(off - start + tracks[name][0]))
            rows = found.setdefault(engine, {}).setdefault(name, [])
            rows[:] = [pair] if source else [*rows, pair]  # the newest replay counts
    return {
        engine: {name: tuple(np.mean(rows, axis=0).tolist()) for name, rows in each.items()}
        for engine, each in found.items()
    }


def _ends(episode: Episode, body: str) -> tuple[np.ndarray, np.ndarray]:
    topic = object_pose_topics(episode)[body] if body != "tool" else "/kinova/tcp/pose"
    p_mm = 1e3 * pose_track(episode, topic).p_m
    return p_mm[0], p_mm[-1]


def without_physics(
    run: Path, fitted: Sequence[str], held_out: Sequence[str]
) -> dict[str, tuple[float, float]]:
    """What saying the mean of the identifying runs gives: end and displacement errors [mm]."""
    names = (*fitted, *held_out)
    ends = {n: _ends(Episode.open(run / "episodes" / f"{n}.mcap"), "cube") for n in names}
    both = {name: np.stack([end, end - start]) for name, (start, end) in ends.items()}
    mean_mm = np.mean([both[name] for name in fitted], axis=0)
    return {n: tuple(np.linalg.norm(both[n] - mean_mm, axis=1).tolist()) for n in held_out}


def summary(values: Sequence[float]) -> str:
    """Median with its interval."""
    try:
        interval = median_interval(values)
    except UndefinedStatisticError:
        return f"{median(values):.1f}"
    return f"{median(values):.1f} [{interval.low:.1f}, {interval.high:.1f}]"


def print_table(cubes: Ends, tools: Ends) -> None:
    """Print every engine's medians over held-out runs, best first; the tool's means and worst."""
    print("| cube, held out | end point (mm) | displacement (mm) |\n|---|---|---|")
    for engine in sorted(cubes, key=lambda name: median(e for e, _ in cubes[name].values())):
        cells = (summary(column) for column in zip(*cubes[engine].values(), strict=True))
        print(f"| {engine} | {' | '.join(cells)} |")
    print(
        "\n| tool, Experiment 1, held out | mean (mm) | worst | displacement |\n|---|---|---|---|"
    )
    for engine in sorted(tools, key=lambda name: mean(e for e, _ in tools[name].values())):
        ends, ways = zip(*tools[engine].values(), strict=True)
        print(f"| {engine} | {mean(ends):.2f} | {max(ends):.2f} | {mean(ways):.2f} |")


def main() -> None:
    """Make the run where needed, print its tables, and store how far the targets were met."""
    if not KINOVA.is_dir():
        print(f"skipped: {KINOVA} is not here (set GST_SHARED_DATA)")
        return
    work = Path(os.environ.get("GST_BENCH_WORK", ROOT / "benchmarks" / "work"))
    run = Path(sys.argv[1]) if len(sys.argv) > 1 else work / "real_push"
    make(run)
    calibration = json.loads((run / "scene" / "calibration.json").read_text())
    physics, motion = calibration["physics"], calibration["motion"]
    held_out = physics["held_out"]["episodes"]
    rule = without_physics(run, physics["fitted_to"], held_out)
    cubes = {**errors_of(run, "cubeexp", "cube", held_out), RULE: rule}
    others = [name for name in motion["held_out"]["episodes"] if name.startswith("single")]
    found = errors_of(run, "single", "tool", others)
    print_table(cubes, found)
    medians = {n: median(e for e, _ in v.values()) for n, v in cubes.items() if n != RULE}
    best = min((value, name) for name, value in medians.items() if not name.startswith(TWIN))
    tools = {name: mean(end for end, _ in each.values()) for name, each in found.items()}
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
        without_physics_mm=median(end for end, _ in rule.values()),
        tool_mm=tools,
        physics={name: physics[name] for name in ("parameters", "held_out", "fitted")},
    )


if __name__ == "__main__":
    main()
