"""A recorded laboratory session judged again, with its cameras calibrated from its own log.

The session's scan and first four trials are learned from anew (``calibrate --cameras``, then
``--posterior``), in a run folder beside the session's. Its later plans are then put to a gate in
this process, which sees what the live gate had seen when each plan came, and nothing later.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from lab_session import AFTER, BEFORE, CELL, DRAWS, MIN_P, SAMPLES, LabSession, row_of
from measure import ROOT

PART = "cameras"


def judge_again(session: LabSession) -> list[dict[str, Any]]:
    """Rows of the later trials as ``LabSession.rows_file`` has them; kept once they are made."""
    from bridge.episode.run_folder import RunFolder
    from bridge.task.find import chosen_task_file
    from bridge.terminal import Output
    from twin.gate.config import GateConfig
    from twin.gate.gate import JudgedTasks
    from twin.gate.twin_process import TwinProcess

    kept = session.run / f"verdicts_{PART}.json"
    if kept.is_file():
        rows: list[dict[str, Any]] = json.loads(kept.read_text())
        return rows
    run, file = RunFolder.open(calibrated_copy(session)), chosen_task_file(session.task)
    task, tasks = file.task(), JudgedTasks(only=file)
    settings = GateConfig(cell=CELL, task=session.task, samples=SAMPLES, min_p_success=MIN_P)
    rows = []
    with TwinProcess(run.path, settings, Output(quiet=True)) as twin:
        for path in sorted((session.run / "episodes").glob("trial_*.mcap")):
            before = row_of(path, task)
            start = before.pop("start_seed") % 1000
            if not BEFORE <= start < BEFORE + AFTER or not before["planned"]:
                continue
            row = {**before, **said_of(ask(path, settings, run, tasks, twin))}
            about = {"task": task.name, "seed": session.seed, "start": start, "part": PART}
            rows.append({**about, **row})
    kept.write_text(json.dumps(rows, indent=1) + "\n")
    return rows


def calibrated_copy(session: LabSession) -> Path:
    """The session's scan, scene and first trials in a run of their own, calibrated."""
    from bridge.episode.reader import Episode
    from bridge.episode.run_folder import RunFolder

    path = session.folder / f"{session.name}.{PART}"
    shutil.rmtree(path, ignore_errors=True)
    run = RunFolder.create(path)
    shutil.copytree(session.run / "scene", run.scene_dir, dirs_exist_ok=True)
    (run.scene_dir / "calibration.json").unlink(missing_ok=True)
    for episode in sorted((session.run / "episodes").glob("*.mcap")):
        info = Episode.open(episode).info
        if info.kind == "scan" or (info.start_seed or 0) % 1000 < BEFORE:
            shutil.copy(episode, run.episodes_dir)
    for what in (["--cameras"], ["--posterior", "--draws", str(DRAWS), "--workers", "1"]):
        command = [sys.executable, "-m", "robot_gst", "calibrate", str(path), *what, "--quiet"]
        subprocess.run(command, check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
    return path


def ask(path: Path, settings: Any, run: Any, tasks: Any, twin: Any) -> Any:
    """Let a gate see what was recorded before the plan, and judge it."""
    from bridge.episode import streams
    from bridge.episode.reader import Episode
    from bridge.episode.topics import JOINT_STATES, PLAN, cell_topic, is_truth
    from twin.gate.live import LiveView
    from twin.gate.service import make_gate
    from twin.scene.store.calibration import read_calibration

    episode = Episode.open(path)
    view = LiveView(CELL, read_calibration(run))
    watched = ("/tf", "/tf_static", "/robot_description", cell_topic(CELL, JOINT_STATES))
    stamp_ns, plan = streams.plans(episode)[-1]
    for message in episode.messages():
        if message.topic == cell_topic(CELL, PLAN):
            break
        seen = message.topic in watched or message.topic.startswith(
            (f"/{CELL}/cam/", f"/{CELL}/event")
        )
        if seen and not is_truth(message.topic):
            sent_ns = message.publish_time_ns
            view.take(message.topic, message.data, sent_ns, message.type_name)
    gate = make_gate(tasks, settings, view, lambda: stamp_ns, twin)
    return gate.judge(plan.to_json())


def said_of(verdict: Any) -> dict[str, Any]:
    """What a row has of a verdict."""
    p = verdict.p_success
    return {
        "said": verdict.accepted,
        "nominal": None,
        "p_success": None if p is None else p["value"],
        "samples": None if p is None else p["n"],
        "reason": verdict.reason,
    }
