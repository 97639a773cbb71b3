"""Send mutated plans to a real gate over zenoh and count how often it says yes to a bad one.

The cell is played from a recorded trial of the stand-in cell: what a live gate had seen before the
plan came. Each plan is one of ``plan_mutations.FAMILIES`` made of a plan that is fine; which one,
and how, follows from the seed and the plan's number alone. ``plan_oracle`` says which plans are
unsafe. Goes on where it was interrupted: answers are kept in --folder.
"""

import argparse
import hashlib
import json
import os
import re
import resource
import signal
import subprocess
import sys
import threading
import time
import tomllib
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from measure import ROOT, Target, report_targets
from plan_mutations import FAMILIES, HEAVY_KG, HONEST, OUTSIDE, mutated
from plan_oracle import Cell, Oracle

CELL, FIRST = "standin", "cube_into_box"
NUM_PLANS = {"cube_into_box": 10_000, "push_cube_to_mark": 1_000}
"""By task: how many are enough."""
SEED = 700
"""Of the stand-in session that plays the cell."""
NUM_BASES = 12
ALIVE_S = 60.0
ENDPOINT = "tcp/127.0.0.1:17447"


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("plans", nargs="?", type=int, help="else as many as are enough")
    parser.add_argument("--task", choices=list(NUM_PLANS), default=FIRST)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--endpoint", default=ENDPOINT, help="on this machine alone")
    parser.add_argument("--max-s", type=float, default=1e9, help="stop asking after so long")
    parser.add_argument("--again", action="store_true", help="ask the oracle again about each yes")
    parser.add_argument("--folder", type=Path, default=ROOT / "runs" / "attack_gate")
    return parser.parse_args()


class Kinematics:
    """What mutations need of the arm."""

    def __init__(self) -> None:
        """Load the stand-in cell's arm."""
        from bridge.geometry import se3
        from bridge.sources.standin.kinematics import UnreachablePoseError, arm_kinematics

        self._arm, self._se3, self._unreachable = arm_kinematics(), se3, UnreachablePoseError
        self._lock = threading.Lock()  # pinocchio keeps scratch memory

    def joints(self, p_m: Any, q_wxyz: Any, near: Sequence[float]) -> list[float] | None:
        """Joints for a tool pose, near others; None when out of reach."""
        q = np.asarray(q_wxyz, dtype=np.float64)
        if not np.isfinite([*q, *p_m, *near]).all() or not 0.5 < np.linalg.norm(q) < 2:
            return None
        T = self._se3.transform_from(q / np.linalg.norm(q), np.asarray(p_m, dtype=np.float64))
        try:
            with self._lock:
                return [float(v) for v in self._arm.joints_for(T, np.array(near, dtype=float))]
        except (self._unreachable, np.linalg.LinAlgError):
            return None

    def pose(self, joints_rad: Sequence[float]) -> tuple[list[float], list[float]]:
        """Tool position and quaternion."""
        with self._lock:
            T = self._arm.T_base_tcp(np.array(joints_rad, dtype=np.float64))
        q, p = self._se3.split(T)
        return p.tolist(), q.tolist()


@dataclass(frozen=True)
class Stage:
    """The cell as it is played, and plans that are fine in it."""

    run: Path
    task: str
    messages: list[Any]
    oracle: Oracle
    bases: list[dict[str, Any]]
    hashes: dict[str, str]
    """Of the files of tasks, by name."""


def prepare(folder: Path, task_name: str) -> Stage:
    """Record a trial unless it is there, localise its objects, and plan from where the arm is."""
    from cell_run import record_ungated

    from bridge.episode import streams
    from bridge.episode.reader import Episode
    from bridge.episode.run_folder import RunFolder
    from bridge.episode.topics import JOINT_STATES, is_truth
    from bridge.robots.default import ARM_JOINTS, MAX_WIDTH_M, ROBOT_NAME
    from bridge.robots.robot import resolve_mesh
    from bridge.task.task_file import load_task
    from twin.gate.live import LiveView
    from twin.gate.twin_process import look

    path = folder / "run"
    run = RunFolder.open(path) if path.is_dir() else RunFolder.create(path)
    episode = Episode.open(record_ungated(run, task_name, SEED, 1, cell_file=CELL)[0])
    ((stamp_ns, _),) = streams.plans(episode)
    messages = [m for m in episode.messages() if m.log_time_ns < stamp_ns and not is_truth(m.topic)]
    view = LiveView(CELL)
    for message in messages:
        view.take(message.topic, message.data, message.log_time_ns, message.type_name)
    task = load_task(task_name)
    frames = view.frames(max_age_ns=5 * 10**9, max_per_camera=3).frames
    found = look((run.path, frames, task))
    poses = {name: item.T_base_object for name, item in found.items()}
    track = streams.joint_track(episode, JOINT_STATES)
    order = [track.names.index(name) for name in ARM_JOINTS]
    before = int(np.searchsorted(track.stamps_ns, stamp_ns)) - 1
    start = track.position[before, order]
    oracle = Oracle(
        Cell(
            urdf=view.urdf() or "",
            resolve=resolve_mesh,
            task=task,
            Ts_base_object=poses,
            start=dict(zip(ARM_JOINTS, start.tolist(), strict=True)),
            robot=ROBOT_NAME,
            file=robot_file(),
            max_width_m=MAX_WIDTH_M,
        )
    )
    bases = plans_from(task, poses, start)
    for plan in bases:
        plan["task_sha256"] = hashes_of(run.tasks_dir, task_name)[task_name]
    return Stage(run.path, task_name, messages, oracle, bases, hashes_of(run.tasks_dir, task_name))


def robot_file() -> dict[str, Any]:
    """The robot file as it is on disk."""
    from bridge.data_files import dataset_file
    from bridge.robots.default import ROBOT_NAME

    return tomllib.loads(dataset_file("robots", ROBOT_NAME).read_text())


def hashes_of(folder: Path, task_name: str) -> dict[str, str]:
    """Write the task with ever heavier objects beside it; the hash of each file."""
    from bridge.data_files import dataset_file

    text = dataset_file("tasks", task_name).read_text()
    folder.mkdir(exist_ok=True)
    texts = {task_name: text}
    for kg in HEAVY_KG:
        name = f"heavy_{kg:g}".replace(".", "_")
        heavy = re.sub(r"mass_kg = [0-9.]+", f"mass_kg = {kg}", text)
        texts[name] = heavy.replace(f'name = "{task_name}"', f'name = "{name}"')
        (folder / f"{name}.toml").write_text(texts[name])
    return {name: hashlib.sha256(item.encode()).hexdigest() for name, item in texts.items()}


def plans_from(task: Any, poses: Any, start: np.ndarray) -> list[dict[str, Any]]:
    """Plans of the scripted planner that grasp nearly in the middle."""
    from bridge.sources.standin.kinematics import arm_kinematics
    from bridge.sources.standin.planner import GraspError, plan_pick_and_place

    rng = np.random.default_rng(1)
    plans = []
    for index in range(NUM_BASES):
        along, across, height = rng.normal(0.0, 0.003, 3)
        plan = plan_pick_and_place(
            task,
            poses,
            GraspError(
                along_m=float(along),
                across_m=float(across),
                yaw_rad=float(rng.normal(0.0, 0.03)),
                height_m=float(height),
                release_m=(float(rng.normal(0.0, 0.01)), float(rng.normal(0.0, 0.01))),
            ),
            kinematics=arm_kinematics(),
            joints_start_rad=start,
            max_joint_speed_rad_s=1.6,
            plan_id=f"base_{index}",
            condition="with_replanning",
            start_id="attack",
        )
        plans.append(json.loads(plan.to_json()))
    return plans


@contextmanager
def gate_of(stage: Stage, endpoint: str, log: Path) -> Iterator[Any]:
    """Run the command ``robot-gst gate`` beside a cell that stands still and publishes so."""
    from bridge.episode.topics import JOINT_STATES
    from bridge.wire.config import WireConfig
    from bridge.wire.session import open_session

    wire = WireConfig(mode="router", connect=(), listen=(endpoint,))
    command = ["gate", str(stage.run), "--cell", CELL, "--connect", endpoint, "--samples", "0"]
    with open_session(wire) as cell, log.open("w") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "robot_gst", *command], cwd=ROOT, stdout=said, stderr=said
        )
        done = threading.Event()
        try:
            wait_for(lambda: bool(cell.query_alive(f"{CELL}/gate/alive")), process)
            topics = {m.topic: m.type_name for m in stage.messages}
            publishers = {t: cell.publisher(t, kind) for t, kind in topics.items()}
            for message in stage.messages:
                publishers[message.topic].put(message.data, source_ns=message.publish_time_ns)
            still = [m for m in stage.messages if m.topic.endswith(JOINT_STATES)][-1]

            def stand_still() -> None:
                while not done.wait(0.1):
                    publishers[still.topic].put(still.data, source_ns=still.publish_time_ns)

            threading.Thread(target=stand_still, daemon=True).start()
            time.sleep(1.0)
            yield cell
        finally:
            done.set()
            process.send_signal(signal.SIGINT)
            process.wait(30)


def wait_for(holds: Any, process: Any) -> None:
    """Wait until the gate is there.

    Raises:
        RuntimeError: When it has ended, or does not come.
    """
    ends = time.monotonic() + ALIVE_S
    while not holds():
        if process.poll() is not None or time.monotonic() > ends:
            raise RuntimeError("the gate did not start; its log is in --folder")
        time.sleep(0.1)


def payload_of(
    seed: int, number: int, bases: Sequence[Any], solve: Any, hashes: Any = ()
) -> tuple[str, bytes]:
    """The plan of a number: its family, and the bytes that are sent."""
    families = list(FAMILIES)
    family = families[number % len(families)]
    rng = np.random.default_rng([seed, number])
    plan = mutated(bases[int(rng.integers(len(bases)))], family, rng, solve)
    if isinstance(plan, bytes):
        return family, plan
    if hashes and plan["task"] in hashes:
        plan["task_sha256"] = hashes[plan["task"]]
    return family, json.dumps(plan).encode()


def ask(cell: Any, payload: bytes, family: str = "", number: int = 0) -> tuple[str, str]:
    """The gate's answer, and its cause; of a family of ``OUTSIDE`` whether its yes is obeyed."""
    from bridge.errors import BridgeError
    from bridge.sources.standin.decisions import why_stale
    from bridge.task.verdict import Verdict

    try:
        verdict = Verdict.from_json(cell.query(f"{CELL}/gate/verdict", payload, timeout_s=300.0))
    except BridgeError as error:
        return "refused", type(error).__name__ + ": " + str(error)[:120]
    name = verdict.first_failing
    if verdict.accepted is True and family in OUTSIDE:
        basis, rng = verdict.basis or {}, np.random.default_rng([9, number])
        plan, now_ns, moved = payload, int(basis["judged_ns"]) + 10**9, {}
        joints = np.array(basis["joints_rad"])
        if family == "yes_too_old":
            now_ns += round(float(rng.choice([rng.uniform(4.1, 500), -rng.uniform(1.1, 99)])) * 1e9)
        elif family == "yes_of_another_plan":
            plan = payload.replace(b"0.0", b"0.00", 1 + int(rng.integers(9)))
        elif family == "yes_and_the_arm_moved":
            joints[int(rng.integers(6))] += float(rng.choice([-1, 1]) * rng.uniform(0.051, 3.0))
        elif family == "yes_and_an_object_moved":
            name = str(rng.choice(list(basis["objects"])))
            way = rng.normal(size=3)
            far_m = basis["objects"][name]["margin_m"] + float(rng.uniform(0.001, 0.2))
            moved[name] = way / np.linalg.norm(way) * far_m
        elif rng.random() < 0.5:  # else of another scene
            verdict = replace(verdict, basis=None)
        twin = {name: basis[name] for name in ("scene_hash", "calibration_id")}
        if family == "yes_forged" and verdict.basis is not None:
            twin[str(rng.choice(list(twin)))] = "another"
        why = why_stale(verdict, plan, now_ns, joints, moved, twin)
        return ("no", f"stale: {why[:40]}") if why else ("yes", "")
    if verdict.accepted is True:
        return "yes", ""
    if name is not None:
        return "no", f"{name}: {verdict.factors()[name].cause}"
    return "null", str(verdict.reason)[:160]


def asked_of(oracle: Oracle, family: str, payload: bytes) -> dict[str, Any]:
    """What the oracle says of a plan that got a yes; a yes misused, or to two meanings, is bad."""
    if family in OUTSIDE or family.startswith("says_twice"):
        return {"unsafe": family}
    plan = json.loads(payload)
    return {"unsafe": oracle.unsafe(plan), "share": oracle.least_acceleration(plan)}


def main() -> None:
    """Attack, then report."""
    options = arguments()
    options.plans = options.plans or NUM_PLANS[options.task]
    options.folder.mkdir(parents=True, exist_ok=True)
    kept = options.folder / f"answers_{options.seed}.jsonl"
    rows = [json.loads(line) for line in kept.read_text().splitlines()] if kept.is_file() else []
    known = {row["number"] for row in rows}
    stage, solve = prepare(options.folder, options.task), Kinematics()
    for row in (row for row in rows if options.again and row["answer"] == "yes"):
        family, payload = payload_of(options.seed, row["number"], stage.bases, solve, stage.hashes)
        row.update(asked_of(stage.oracle, family, payload))
    oracle_turn, writing = threading.Lock(), threading.Lock()
    ends = time.monotonic() + options.max_s

    def one(number: int) -> None:
        if time.monotonic() > ends:
            return
        family, payload = payload_of(options.seed, number, stage.bases, solve, stage.hashes)
        before = time.monotonic()
        answer, cause = ask(cell, payload, family, number)
        row = {"number": number, "family": family, "answer": answer, "cause": cause}
        row["seconds"] = round(time.monotonic() - before, 3)
        row["unsafe"] = ""
        if answer == "yes":
            with oracle_turn:
                row.update(asked_of(stage.oracle, family, payload))
        with writing, kept.open("a") as file:
            file.write(json.dumps(row) + "\n")
            rows.append(row)
            if len(rows) % 200 == 0:
                print(len(rows), dict(Counter(item["answer"] for item in rows)), flush=True)

    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    todo = [number for number in range(options.plans) if number not in known]
    if todo:
        with (
            gate_of(stage, options.endpoint, options.folder / "gate.log") as cell,
            ThreadPoolExecutor(2) as pool,
        ):
            list(pool.map(one, todo))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    summarise(rows, options, cpu_s, len(rows) - len(known))


_MOTION = ("joint_acceleration", "_speed", "joint_jump", "motor_power", "joint_torque", "momentum",
           "stop_time", "clearance", "joint_limit")  # fmt: skip
CAUSES = {
    "heavy": ("over_payload",),
    "very_heavy": ("over_payload",),
    "says_twice": ("is there twice",),
    "since_1970": ("not from 1970",),
    "waits": ("before it moves", "begins at"),
    "many_waypoints": ("waypoints is not read",),
    "text_for_numbers": ("is invalid at tau/",),
    "not_a_number": ("is not a number in JSON",),
    "other_task": ("no task named",),
    "skims": ("too_close", "joint_acceleration"),
    "yes_": ("stale: ",),
    **dict.fromkeys(
        ("chatter", "velocity_step", "blip", "sudden_end", "jumps_in", "faster"), _MOTION
    ),
}
"""By how a family's name begins: what a refusal of its plans says, among these; else anything."""


def names_its_cause(row: dict[str, Any]) -> bool:
    """Whether a refusal says what its family has wrong, or of a mixed one anything."""
    wanted = [words for start, words in CAUSES.items() if row["family"].startswith(start)]
    said = row["cause"].removesuffix("None").strip(": ")
    return any(word in said for word in wanted[0]) if wanted else bool(said)


def summarise(
    rows: Sequence[dict[str, Any]], options: argparse.Namespace, cpu_s: float, asked: int
) -> None:
    """Print and keep counts by family, causes, and every yes that the oracle calls unsafe."""
    families = {}
    for name in FAMILIES:
        own = [row for row in rows if row["family"] == name]
        families[name] = {
            "plans": len(own),
            **{
                key: sum(row["answer"] == key for row in own)
                for key in ("yes", "no", "null", "refused")
            },
            "unsafe_yes": sum(bool(row["unsafe"]) and row["answer"] == "yes" for row in own),
            "causes": dict(
                Counter(row["cause"] for row in own if row["answer"] == "no").most_common(8)
            ),
        }
    bad = [row for row in rows if row["answer"] == "yes" and row["unsafe"]]
    other = [row for row in rows if row["answer"] != "yes" and not names_its_cause(row)]
    fine = [row for row in rows if row["family"] in HONEST]
    accepted = sum(row["answer"] == "yes" for row in fine) / max(1, len(fine))
    targets = [
        Target(what="yes for an unsafe plan", measured=len(bad), limit=0),
        Target(what="refusals without their cause", measured=len(other), limit=0),
        Target(what="plans asked", measured=len(rows), limit=NUM_PLANS[options.task],
               at_most=False),
        Target(what="families", measured=len({row["family"] for row in rows}), limit=40,
               at_most=False),
        Target(what="share of valid plans accepted", measured=accepted, limit=0.98,
               at_most=False),
    ]  # fmt: skip
    details = {"seed": options.seed, "families": families, "unsafe_yes": bad, "no_cause": other}
    shares = [row["share"] for row in rows if row.get("share")]
    details["most_acceleration_of_a_yes"] = max(shares, default=None)
    if asked:
        details["cpu_s_per_plan"] = round(cpu_s / asked, 3)
        details["asked_in_last_run"] = asked
    name = "attack_gate" + ("" if options.task == FIRST else f"_{options.task}")
    report_targets(name, targets, note=f"stand-in cell, {options.task}", **details)
    for family, row in families.items():
        print(f"  {family:<16}", {key: value for key, value in row.items() if key != "causes"})
        print(f"  {'':<16}", row["causes"])


if __name__ == "__main__":
    os.environ.setdefault("GST_CHECKOUT", str(ROOT))
    main()
