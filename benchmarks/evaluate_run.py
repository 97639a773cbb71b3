"""Write a run of many trials to evaluate: real episodes with plans, verdicts, tool and joints.

Every file is written by the project's own writer and has its own ids, outcome and hashes. The
series are one of a few variants; forcing each file to the disk is left out, for time.
"""

import os
import sys
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from bridge.episode import schema  # noqa: E402
from bridge.episode.cdr.messages import JointSample, PoseSample  # noqa: E402
from bridge.episode.metadata import Derived, EpisodeInfo, Outcome  # noqa: E402
from bridge.episode.provenance import hash_file  # noqa: E402
from bridge.episode.run_folder import RunFolder  # noqa: E402
from bridge.episode.writer import EpisodeWriter  # noqa: E402
from bridge.robots.default import ARM_JOINTS  # noqa: E402
from bridge.task.plan import Plan, Stage, Waypoint  # noqa: E402
from bridge.task.task_file import load_task  # noqa: E402
from bridge.task.verdict import Factor, Verdict  # noqa: E402
from twin.replay.config import ReplayConfig  # noqa: E402

START_NS = 100_000_000_000
RATE_HZ = 125
"""What a UR reports its joints at."""
NUM_WAYPOINTS = 100
VARIANTS = 8
OBJECTS = {
    "cube_into_box": "cube",
    "sloth_into_basket": "sloth",
    "five_ducks_into_basket": "duck_1",
}
"""What the plan of each task moves."""
CONDITIONS = ("without_replanning", "with_replanning")
_NONE = np.zeros(0)


@dataclass(frozen=True)
class Size:
    """How much a run holds."""

    num_trials: int
    seconds: float
    """Length of each motion [s]."""


def write_run(folder: Path, size: Size, *, first: int = 0) -> RunFolder:
    """Add trials ``first`` to ``first + num_trials`` to a run folder, made where needed."""
    run = RunFolder.create(folder)
    run.derived_dir.mkdir(exist_ok=True)
    numbers = range(first, first + size.num_trials)
    jobs = [(str(folder), size.seconds, list(numbers[start::8])) for start in range(8)]
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for _ in pool.map(_write_trials, jobs):
            pass
    return run


def _write_trials(job: tuple[str, float, list[int]]) -> None:
    folder, seconds, numbers = job
    os.fsync = os.fdatasync = lambda _: None  # type: ignore[assignment]
    run = RunFolder(Path(folder))
    for number in numbers:
        _write_trial(run, number, seconds)


def _write_trial(run: RunFolder, number: int, seconds: float) -> None:
    name, variant = f"trial_{number:06}", number % VARIANTS
    task = list(OBJECTS)[number // 2 % len(OBJECTS)]
    rng = np.random.default_rng(number)
    condition = CONDITIONS[number % 2]
    success, said = rng.random() < 0.7, rng.random() < 0.7
    said = success if rng.random() < 0.7 else said
    plan_id = f"plan_{name}"
    info = EpisodeInfo(
        id=name,
        kind="trial",
        task=task,
        condition=condition,
        policy="scripted",
        start_id=f"s{number // 2:06}",
        cell="bench",
        stand_in=True,
    )
    path = run.episodes_dir / f"{name}.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(info, outcome=Outcome(result="success" if success else "failure"))
        _json(writer, "/bench/localisation", schema.LOCALISATION, _place(task), -3)
        for other in (plan_id, f"{plan_id}_unsent"):
            plan = _plan(task, condition).replace(b"PLAN_ID", other.encode())
            _raw(writer, "/bench/plan", schema.PLAN, plan, -2)
        _raw(writer, "/bench/verdict", schema.VERDICT, _verdict(said, plan_id, "planned"), -1)
        _event(writer, "execution_started", plan_id, 0)
        _series(writer, variant, seconds, START_NS, 0.0)
        _event(writer, "execution_ended", plan_id, round(seconds * 1e9))
    source_sha256 = hash_file(path)
    for trajectory, offset_m in (("planned", 0.004), ("executed", 0.001)):
        derived = Derived(
            kind="replay",
            source_episode=name,
            source_sha256=source_sha256,
            plan_id=plan_id,
            trajectory=trajectory,
            mode="dynamic",
            engine="bench",
            seed=number,
            settings=_settings(task, number),
        )
        stem = f"{name}.replay.{trajectory}.dynamic"
        with EpisodeWriter(run.derived_dir / f"{stem}.mcap") as writer:
            replay_info = EpisodeInfo(id=stem.replace(".", "-"), kind="trial", stand_in=True)
            writer.describe(replay_info, derived=derived)
            verdict = _verdict(said, plan_id, trajectory)
            _raw(writer, "/bench/verdict", schema.VERDICT, verdict, 0)
            _series(writer, (variant + 1) % VARIANTS, seconds, START_NS, offset_m)


def _settings(task: str, number: int) -> dict[str, object]:
    """As much as a replay says of how it was made: its task and all its settings."""
    return {
        "replay_version": 0,
        "calibration_id": None,
        "task": asdict(load_task(task)),
        "config": asdict(ReplayConfig(seed=number)),
    }


def _raw(writer: EpisodeWriter, topic: str, type_name: str, data: bytes, after_ns: int) -> None:
    writer.write(topic, data, type_name=type_name, log_time_ns=START_NS + after_ns)


def _json(
    writer: EpisodeWriter, topic: str, type_name: str, record: dict[str, object], after_ns: int
) -> None:
    writer.write(topic, record, type_name=type_name, log_time_ns=START_NS + after_ns)


def _event(writer: EpisodeWriter, kind: str, plan_id: str, after_ns: int) -> None:
    stamp_ns = START_NS + after_ns
    record = {"schema_version": 1, "stamp_ns": stamp_ns, "type": kind, "plan_id": plan_id}
    _json(writer, "/bench/event", schema.EVENT, record, after_ns)


def _place(task: str) -> dict[str, object]:
    pose = {"p_m": [0.4, 0.0, 0.02], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}
    return {
        "schema_version": 1,
        "stamp_ns": START_NS - 3,
        "object": OBJECTS[task],
        "found": True,
        "T_base_object": pose,
        "method": "bench",
    }


def _series(
    writer: EpisodeWriter, variant: int, seconds: float, start_ns: int, offset_m: float
) -> None:
    for stamp_ns, pose, joints in _payloads(variant, seconds, start_ns, offset_m):
        writer.write("/bench/tcp/pose", pose, type_name=schema.POSE_STAMPED, log_time_ns=stamp_ns)
        writer.write(
            "/bench/joint_states", joints, type_name=schema.JOINT_STATE, log_time_ns=stamp_ns
        )


@cache
def _payloads(
    variant: int, seconds: float, start_ns: int, offset_m: float
) -> list[tuple[int, bytes, bytes]]:
    rng = np.random.default_rng(1000 + variant)
    found = []
    for index in range(int(RATE_HZ * seconds)):
        stamp_ns = start_ns + index * 1_000_000_000 // RATE_HZ
        T = np.eye(4)
        T[:3, 3] = [0.3 + 0.1 * index / RATE_HZ / seconds, offset_m, 0.2]
        T[:3, 3] += rng.normal(0.0, 1e-4, 3)
        pose = PoseSample(stamp_ns=stamp_ns, frame_id="base_link", T_frame_body=T)
        joints = JointSample(
            stamp_ns=stamp_ns,
            names=tuple(ARM_JOINTS),
            position=0.3 + index * 1e-3 + rng.normal(0.0, 1e-4, len(ARM_JOINTS)),
            velocity=_NONE,
            effort=_NONE,
        )
        found.append((stamp_ns, pose.to_cdr(), joints.to_cdr()))
    return found


@cache
def _plan(task: str, condition: str) -> bytes:
    """A plan of the usual length, to be given an id."""
    waypoints = tuple(
        Waypoint(
            t_ns=index * 50_000_000,
            p_m=(0.3 + 0.001 * index, 0.0, 0.2),
            q_wxyz=(1.0, 0.0, 0.0, 0.0),
            g=int(index > 50),
        )
        for index in range(NUM_WAYPOINTS)
    )
    pose = {"p_m": [0.5, 0.1, 0.05], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}
    place = Stage(
        id="place",
        text="Place it.",
        release=OBJECTS[task],
        predicted_objects={OBJECTS[task]: pose},
        t_end_ns=waypoints[-1].t_ns,
    )
    plan = Plan(
        id="PLAN_ID",
        planner="bench",
        policy="scripted",
        condition=condition,
        robot="ur5",
        frame="base_link",
        instruction="Put it there.",
        task=task,
        stages=(place,),
        tau=waypoints,
    )
    return plan.to_json()


def _verdict(accepted: bool, plan_id: str, trajectory: str) -> bytes:
    fine = Factor(value=True)
    hit = Factor(value=False, first_t_ns=1_500_000_000, cause="collision", bodies=("cup", "box"))
    verdict = Verdict(
        plan_id=plan_id,
        trajectory=trajectory,
        mode="dynamic",
        ik=fine,
        clearance=fine if accepted else hit,
        terminal=fine,
        engine="bench",
        seed=1,
    )
    return verdict.to_json()


def paths_of(run: RunFolder) -> Iterable[Path]:
    """Every episode file of a run."""
    return [*run.episodes(), *run.derived()]
