"""Draw where a pushed cube ended, really and in the twin, for docs/real_number.md.

Example: .venv/bin/python docs/images/real_push.py runs/kinova docs/images/real_push.svg
The run was imported, calibrated with --physics, replayed and evaluated.
"""

import argparse
import json
from pathlib import Path

import matplotlib as mpl

mpl.use("svg")
import matplotlib.pyplot as plt
import numpy as np

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import object_pose_topics, pose_track

CUBE = "cube"
TASK = "cubeexp"
TWIN = "twin-pybullet"


def end_mm(path: Path) -> np.ndarray:
    """Where the cube of an episode ends, seen from above."""
    episode = Episode.open(path)
    return np.asarray(pose_track(episode, object_pose_topics(episode)[CUBE]).p_m[-1, :2] * 1e3)


def ends_by_engine(run: RunFolder) -> tuple[dict[str, np.ndarray], dict[str, list[np.ndarray]]]:
    """The twin's ends with measured tool and calibrated friction by recording; the simulators'."""
    twin: dict[str, np.ndarray] = {}
    others: dict[str, list[np.ndarray]] = {}
    for path in sorted(run.derived_dir.glob(f"{TASK}*.mcap")):
        derived = Episode.open(path).derived
        if derived is None or derived.kind != "replay":
            continue
        if not derived.source_episode:
            others.setdefault(str(derived.engine), []).append(end_mm(path))
        elif derived.trajectory == "executed" and derived.calibration_id:
            twin[derived.source_episode] = end_mm(path)
    return twin, others


def main() -> None:
    """Draw and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    chosen = parser.parse_args()
    run = RunFolder.open(chosen.run)
    physics = json.loads((run.scene_dir / "calibration.json").read_text())["physics"]
    held_out = physics["held_out"]["episodes"]
    twin, others = ends_by_engine(run)
    mpl.rcParams.update({"svg.hashsalt": TWIN, "font.size": 8})
    figure, axes = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    for index, name in enumerate(held_out):
        real = end_mm(run.episodes_dir / f"{name}.mcap")
        label = index == 0
        axes.plot(*np.stack([real, twin[name]]).T, color="0.6", linewidth=0.8, zorder=1)
        axes.plot(
            *real, "o", color="black", markersize=5, label="real, held out" if label else None
        )
        axes.plot(
            *twin[name], "x", color="tab:blue", label="twin, measured tool" if label else None
        )
    for marker, (engine, ends) in zip("s^v<>D", others.items(), strict=False):
        axes.plot(*np.array(ends).T, marker, linestyle="", markersize=4, alpha=0.7, label=engine)
    axes.set_xlabel("x of the cube's end (mm); it starts at 501.5")
    axes.set_ylabel("y (mm)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(color="0.9")
    axes.legend(fontsize=7, loc="best", ncols=2)
    figure.savefig(chosen.out, metadata={"Date": None})


if __name__ == "__main__":
    main()
