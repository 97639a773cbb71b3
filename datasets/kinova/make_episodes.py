"""The Kinova reality-gap runs (Collins, Howard, Leitner, ICRA 2019) as episodes, and their bands.

Example: python datasets/kinova/make_episodes.py data/kinova runs/kinova --bands bands.svg

Real runs (``real/Experiment*/*.tsv``, motion capture at 100 Hz) become recorded episodes;
simulator runs (``sim/Experiment*/*.csv``) become unpaired derived episodes.

Three facts that the folder's notes leave open were settled by numbers (see
``tests/datasets``): the nine ``Rot`` values are column by column (then R = Rx(roll)
Ry(pitch) Rz(yaw) holds to 6e-6, row by row it is off by 0.04); PyBullet and V-REP files hold
quaternions as xyzw and MuJoCo files as wxyz (the other way round the end effector would turn 24
degrees differently from the real one, or start upside down).

A file that cannot be used (damaged, of an unknown simulator, of a simulation that exploded) is
listed and skipped; the others are imported.
"""

import argparse
import json
import re
import shutil
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.clock import ns_from_s
from bridge.episode import schema
from bridge.episode.cdr.messages import PoseSample
from bridge.episode.metadata import Derived, EpisodeInfo
from bridge.episode.provenance import hash_file, hash_settings
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import pose_track
from bridge.episode.topics import TCP_POSE, cell_topic, object_topic
from bridge.episode.writer import EpisodeWriter
from bridge.errors import BridgeError, GstError, PathNotFoundError
from bridge.geometry import se3
from bridge.task.scripted_motion import RECORD_NAME, JointTarget, PushedBox, ScriptedMotion

CELL = "kinova"
FRAME = "world"
"""Motion capture and simulator share it: robot base near the origin, z up."""
TCP_TOPIC = cell_topic(CELL, TCP_POSE)
CUBE_TOPIC = object_topic(CELL, "cube", "pose")
BASE_TOPIC = cell_topic(CELL, "/base/pose")
_REAL_COLUMNS = 53
_SIM_COLUMNS = 14
_BODY_STARTS = {BASE_TOPIC: 2, TCP_TOPIC: 19, CUBE_TOPIC: 36}
_REAL_NAME = re.compile(r"^(?P<task>[A-Za-z]+)(?P<number>\d+)_6D\.tsv$")
_QUATERNION_ORDERS = {
    "PyBullet": "xyzw",
    "Mujoco": "wxyz",
    "VRepBullet278": "xyzw",
    "VRepBullet283": "xyzw",
    "VRepNewton": "xyzw",
    "VRepODE": "xyzw",
    "VRepVortex": "xyzw",
}
_SIM_NAME = re.compile(
    rf"^(?P<task>[A-Za-z]+)_(?P<engine>{'|'.join(_QUATERNION_ORDERS)})_(?P<number>\d+)\.csv$"
)
FARTHEST_M = 10.0
"""Nothing on the table goes so far; the simulations that explode end at 1e13 m and more."""
ROBOT_FOLDER = "robot"
"""Of the data set, and of a run: URDF and meshes, which belong to the data set."""
URDF = "m1n6s300.urdf"
_JOINTS = tuple(f"m1n6s300_joint_{number}" for number in range(1, 7))
_SCRIPTS: dict[str, tuple[float, tuple[tuple[float, dict[int, float]], ...]]] = {
    "cubeexp": (
        20.0,
        (
            (0.0, {1: 30, 2: 120, 3: 90}),
            (8.0, {1: -60, 2: 65, 3: 90}),
            (14.0, {1: -67, 2: 30, 3: 90}),
        ),
    ),
    "single": (6.0, ((0.0, {1: -100}),)),
}
"""By task: duration [s], and from which time which joints (counted from 0) go where [deg]. From the
authors' software; checked against the recordings."""
_GAIN_HZ, _LIMIT_DEG_S, _PERIOD_S = 10.0, 30.0, 0.05
_BASE_M = (0.0, 0.0, 0.055)
"""The arm stands higher than the origin: with all joints zero the simulators' end effector, link 6
of the description, is at 0.872 m, which is 55 mm more than the description alone gives."""
_CUBE = PushedBox(size_m=(0.075, 0.075, 0.075), mass_kg=0.0884)
CITATION = "Collins, Howard, Leitner: Quantifying the reality gap, ICRA 2019"


class KinovaFormatError(BridgeError):
    """A file of the data set does not look as its header says."""

    def __init__(self, *, path: Path, found: str) -> None:
        """Remember the file and what was found."""
        self.path = path
        super().__init__(f"{path}: {found}. Restore it from the original data set.")


@dataclass(frozen=True, kw_only=True)
class KinovaRun:
    """One run: poses of bodies over time, in the frame ``world``."""

    path: Path
    task: str
    number: int
    engine: str | None
    """None for the real robot, else the simulator's name in lower case."""
    stamps_s: Float[np.ndarray, " num_samples"]
    Ts_world_body: dict[str, Float[np.ndarray, "num_samples 4 4"]]
    """By topic."""
    num_lost: dict[str, int]
    """Samples in which motion capture did not see the body; left out."""
    seen_mask: dict[str, np.ndarray]


def read_real_run(path: Path) -> KinovaRun:
    """Read a motion-capture file.

    Raises:
        KinovaFormatError: When columns are missing or are not numbers.
    """
    name = _REAL_NAME.match(path.name)
    if name is None:
        raise KinovaFormatError(path=path, found="the name is not like Single0001_6D.tsv")
    rows = _rows(path, "\t", _REAL_COLUMNS)
    transforms, seen = {}, {}
    for topic, start in _BODY_STARTS.items():
        T = np.tile(np.eye(4), (len(rows), 1, 1))
        T[:, :3, 3] = rows[:, start : start + 3] * 1e-3
        # Column by column; see the module's docstring.
        T[:, :3, :3] = rows[:, start + 7 : start + 16].reshape(-1, 3, 3).transpose(0, 2, 1)
        determinant = np.linalg.det(T[:, :3, :3])
        seen[topic] = np.isfinite(T).all(axis=(1, 2)) & (np.abs(determinant - 1) < 0.01)
        transforms[topic] = T
    return KinovaRun(
        path=path,
        task=name["task"].lower(),
        number=int(name["number"]),
        engine=None,
        stamps_s=rows[:, 1],
        Ts_world_body=transforms,
        num_lost={topic: int((~mask).sum()) for topic, mask in seen.items()},
        seen_mask=seen,
    )


def read_sim_run(path: Path, duration_s: float) -> KinovaRun:
    """Read a simulator file; it has no times, so they are spread evenly over ``duration_s``.

    Raises:
        KinovaFormatError: When columns are missing or are not numbers, the simulator is not known,
            or a body is farther away than ``FARTHEST_M``.
    """
    name = _SIM_NAME.match(path.name)
    if name is None:
        known = ", ".join(_QUATERNION_ORDERS)
        found = f"the name is not like Single_PyBullet_0.csv with one of {known}"
        raise KinovaFormatError(path=path, found=found)
    rows = _rows(path, None, _SIM_COLUMNS)
    farthest_m = np.abs(rows[:, [0, 1, 2, 7, 8, 9]]).max()
    if not farthest_m <= FARTHEST_M:
        found = f"a position of {farthest_m:.3g} m: the simulation exploded"
        raise KinovaFormatError(path=path, found=found)
    order = [_QUATERNION_ORDERS[name["engine"]].index(axis) for axis in "wxyz"]
    transforms = {
        topic: se3.transform_from(
            rows[:, start + 3 : start + 7][:, order], rows[:, start : start + 3]
        )
        for topic, start in ((TCP_TOPIC, 0), (CUBE_TOPIC, 7))
    }
    everything = np.ones(len(rows), dtype=bool)
    return KinovaRun(
        path=path,
        task=name["task"].lower(),
        number=int(name["number"]),
        engine=name["engine"].lower(),
        stamps_s=np.linspace(0.0, duration_s, len(rows)),
        Ts_world_body=transforms,
        num_lost=dict.fromkeys(transforms, 0),
        seen_mask=dict.fromkeys(transforms, everything),
    )


def _rows(path: Path, separator: str | None, columns: int) -> Float[np.ndarray, "rows columns"]:
    rows = []
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        if not line.strip():
            continue
        text = line if separator else line.replace(",", " ")
        cells = text.split(separator)[:columns]
        if len(cells) != columns:
            found = f"line {number} has {len(cells)} columns, expected {columns}"
            raise KinovaFormatError(path=path, found=found)
        try:
            rows.append([float(cell) if cell.strip() else np.nan for cell in cells])
        except ValueError as error:
            raise KinovaFormatError(path=path, found=f"line {number}: {error}") from error
    if len(rows) < 2:
        raise KinovaFormatError(path=path, found=f"{len(rows)} rows of data, need at least 2")
    return np.array(rows)


def find_runs(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the real and the simulated files of the data set, in name order."""
    real = sorted(folder.glob("real/*/*_6D.tsv"))
    simulated = sorted(folder.glob("sim/*/*.csv"))
    if not real:
        raise PathNotFoundError(
            path=folder / "real",
            what="real runs",
            hint="Give the folder that holds real/Experiment1/*.tsv and sim/Experiment1/*.csv.",
        )
    return real, simulated


def import_runs(
    folder: Path, run: RunFolder, skipped: list[KinovaFormatError] | None = None
) -> Iterator[tuple[Path, KinovaRun]]:
    """Write every run that can be used as an episode; yields file and run as each is done.

    Args:
        skipped: Takes what was wrong with each file that is left out.

    Raises:
        KinovaFormatError: The first fault, where no file at all can be used.
    """
    real_paths, sim_paths = find_runs(folder)
    faults = [] if skipped is None else skipped
    _copy_robot(folder, run)
    durations: dict[tuple[str, str], list[float]] = {}
    for path in real_paths:
        try:
            real = read_real_run(path)
        except KinovaFormatError as fault:
            faults.append(fault)
            continue
        durations.setdefault((path.parent.name, real.task), []).append(float(real.stamps_s[-1]))
        yield _write_real(real, run), real
    if not durations:
        raise faults[0]
    for path in sim_paths:
        of_task = durations.get((path.parent.name, path.name.split("_")[0].lower()))
        try:
            if not of_task:
                found = "no real run of its task gives its duration"
                raise KinovaFormatError(path=path, found=found)
            simulated = read_sim_run(path, float(np.mean(of_task)))
        except KinovaFormatError as fault:
            faults.append(fault)
            continue
        yield _write_sim(simulated, run, num_real=len(of_task)), simulated


def _copy_robot(folder: Path, run: RunFolder) -> None:
    """Put URDF and meshes beside the episodes, so that later steps find them."""
    source, target = folder / ROBOT_FOLDER, run.path / ROBOT_FOLDER
    if (source / URDF).is_file() and not target.exists():
        shutil.copytree(source, target, copy_function=shutil.copyfile)
        for each in (target, *target.rglob("*")):  # what is read-only there is not so here
            each.chmod(0o755 if each.is_dir() else 0o644)


def scripted_motion(task: str) -> ScriptedMotion | None:
    """Return what the authors told the arm in a task; None for a task that is not known."""
    if task not in _SCRIPTS:
        return None
    duration_s, targets = _SCRIPTS[task]
    return ScriptedMotion(
        robot=f"{ROBOT_FOLDER}/{URDF}",
        hand_link="m1n6s300_link_6",
        joints=_JOINTS,
        base_m=_BASE_M,
        targets=tuple(
            JointTarget(
                t_s=t_s,
                joints_rad={_JOINTS[index]: float(np.deg2rad(deg)) for index, deg in each.items()},
            )
            for t_s, each in targets
        ),
        gain_hz=_GAIN_HZ,
        limit_rad_s=float(np.deg2rad(_LIMIT_DEG_S)),
        period_s=_PERIOD_S,
        duration_s=duration_s,
        boxes={"cube": _CUBE} if task == "cubeexp" else {},
    )


def _info(kinova: KinovaRun, suffix: str) -> EpisodeInfo:
    return EpisodeInfo(
        id=f"{kinova.task}_{suffix}",
        kind="imported",
        task=kinova.task,
        trial=kinova.number,
        robot="Kinova Mico2",
        cell=CELL,
        tags=("reality-gap", kinova.path.parent.name),
    )


def _write_real(kinova: KinovaRun, run: RunFolder) -> Path:
    info = _info(kinova, f"{kinova.number:04d}")
    path = run.episodes_dir / f"{info.id}.mcap"
    if path.exists():  # written whole by an earlier import
        return path
    with EpisodeWriter(path) as writer:
        writer.describe(info)
        _write_poses(writer, kinova)
        writer.add_metadata("source", _source(kinova, "seconds since the start of the capture"))
        motion = scripted_motion(kinova.task)
        if motion is not None:
            writer.add_metadata(RECORD_NAME, motion.to_record())
    return path


def _write_sim(kinova: KinovaRun, run: RunFolder, num_real: int) -> Path:
    settings = {
        "file": kinova.path.name,
        "file_sha256": hash_file(kinova.path),
        "pairing": "unpaired, no time column: normalised time",
        "duration_s": float(kinova.stamps_s[-1]),
        "duration_from": f"mean of {num_real} real runs of this task",
    }
    info = _info(kinova, f"{kinova.engine}_{kinova.number}")
    derived = Derived(
        kind="replay",
        source_episode="",
        source_sha256="",
        trajectory="planned",
        mode="dynamic",
        engine=kinova.engine,
        settings=settings,
    )
    name = (
        f"{kinova.task}.replay.planned.dynamic.unpaired.{kinova.engine}.{hash_settings(settings)}"
    )
    path = run.derived_dir / f"{name}.mcap"
    if path.exists():
        return path
    with EpisodeWriter(path) as writer:
        writer.describe(info, derived=derived)
        _write_poses(writer, kinova)
        writer.add_metadata("source", _source(kinova, "spread evenly; the file has no time column"))
    return path


def _source(kinova: KinovaRun, times: str) -> dict[str, str]:
    record: dict[str, Any] = {
        "file": kinova.path.name,
        "citation": CITATION,
        "times": times,
        "samples_left_out": kinova.num_lost,
    }
    return {name: json.dumps(value) for name, value in record.items()}


def _write_poses(writer: EpisodeWriter, kinova: KinovaRun) -> None:
    for index, stamp_s in enumerate(kinova.stamps_s):
        stamp_ns = ns_from_s(float(stamp_s))
        for topic, transforms in kinova.Ts_world_body.items():
            if not kinova.seen_mask[topic][index]:
                continue
            pose = PoseSample(stamp_ns=stamp_ns, frame_id=FRAME, T_frame_body=transforms[index])
            writer.write(topic, pose.to_cdr(), type_name=schema.POSE_STAMPED, log_time_ns=stamp_ns)


NUM_SAMPLES = 101
"""Instants of normalised time at which runs are compared."""
WAITING_M = 0.01
"""A run waits while it is closer than this to where it started, or will stay."""
BAND_WIDTH = 2.0
"""The recorded band reaches this many root mean square distances from its mean curve."""
Curves = Float[np.ndarray, "num_runs num_samples 3"]


def moving_curve(path: Path) -> Float[np.ndarray, "num_samples 3"]:
    """Return the tool's way over normalised time, from leaving the start to staying at the end."""
    track = pose_track(Episode.open(path), TCP_TOPIC)
    if track is None:
        raise KinovaFormatError(path=path, found="it holds no pose of the tool")
    p_m = track.p_m
    away = np.linalg.norm(p_m - p_m[0], axis=1) > WAITING_M
    left = np.linalg.norm(p_m - p_m[-1], axis=1) > WAITING_M
    if away.any() and left.any():
        first = max(0, int(np.argmax(away)) - 1)
        p_m = p_m[first : int(np.flatnonzero(left)[-1]) + 2]
    at = np.linspace(0.0, len(p_m) - 1.0, NUM_SAMPLES)
    return np.stack([np.interp(at, np.arange(len(p_m)), p_m[:, k]) for k in range(3)], axis=1)


def band_of(recorded: Curves, simulated: Float[np.ndarray, "others num_samples 3"]) -> np.ndarray:
    """Return the distance of both mean curves, and how far the recorded band reaches [m]."""
    mean_m = recorded.mean(axis=0)
    squared = ((recorded - mean_m) ** 2).sum(axis=-1).sum(axis=0)
    reach_m = BAND_WIDTH * np.sqrt(squared / max(1, len(recorded) - 1))
    return np.stack([np.linalg.norm(simulated.mean(axis=0) - mean_m, axis=-1), reach_m])


def draw_bands(files: Sequence[tuple[Path, KinovaRun]], out: Path) -> None:
    """Draw for each task how far every simulator's mean curve lies from the recorded band."""
    from matplotlib.figure import Figure  # noqa: PLC0415  # episodes are made without it

    curves: dict[str, dict[str | None, list[np.ndarray]]] = {}
    for path, kinova in files:
        curves.setdefault(kinova.task, {}).setdefault(kinova.engine, []).append(moving_curve(path))
    shown = {task: sides for task, sides in curves.items() if None in sides and len(sides) > 1}
    figure = Figure(figsize=(7.0, 0.3 + 2.8 * max(1, len(shown))), layout="constrained")
    axes = figure.subplots(max(1, len(shown)), squeeze=False)[:, 0]
    for axis, (task, sides) in zip(axes, shown.items(), strict=False):
        recorded = np.array(sides[None])
        for engine in sorted(name for name in sides if name):
            distance_m, reach_m = band_of(recorded, np.array(sides[engine]))
            axis.plot(1e3 * distance_m, label=f"{engine} (n = {len(sides[engine])})")
        axis.fill_between(range(NUM_SAMPLES), 1e3 * reach_m, alpha=0.2, label="recorded band")
        axis.set_title(f"{task}: {len(recorded)} recorded runs")
        axis.set_xlabel("time from start to end (%)")
        axis.set_ylabel("between mean curves (mm)")
        axis.legend(fontsize=7)
    figure.savefig(out, metadata={"Date": None})


def main(arguments: Sequence[str] | None = None) -> int:
    """Import the data set into a run folder; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="with real/Experiment1/*.tsv and sim/")
    parser.add_argument("run", type=Path, help="run folder; made where needed")
    parser.add_argument("--bands", type=Path, help="draw the bands of each task into this SVG")
    asked = parser.parse_args(arguments)
    skipped: list[KinovaFormatError] = []
    try:
        files = list(import_runs(asked.folder, RunFolder.create(asked.run), skipped))
        if asked.bands is not None:
            draw_bands(files, asked.bands)
    except GstError as error:
        print(error, file=sys.stderr)
        return 1
    real = sum(kinova.engine is None for _, kinova in files)
    print(f"{real} real and {len(files) - real} simulated runs in {asked.run}")
    for fault in skipped:
        print(f"skipped: {fault}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
