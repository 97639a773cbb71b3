"""The gate on the wire: what it listens to, what it answers, and the verdict in the log."""

import json
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bridge.episode import schema
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import (
    CAMERAS,
    EVENT,
    GATE,
    JOINT_STATES,
    LOCALISATION,
    LOCALISE,
    ROBOT_DESCRIPTION,
    TF,
    TF_STATIC,
    VERDICT,
    cell_topic,
)
from bridge.errors import UsageError
from bridge.robots.robot import read_robot
from bridge.task.find import chosen_task_file
from bridge.terminal import Output, printable, stop_signals
from bridge.wire.config import WireConfig
from twin.errors import TwinError
from twin.gate.config import GateConfig
from twin.gate.gate import Gate, JudgedTasks
from twin.gate.twin_process import TwinProcess
from twin.replay.failure import WORDS

CELL_NAME = re.compile(r"^[A-Za-z0-9][A-Za-z0-9_-]*$")


class GateError(TwinError):
    """The gate cannot be set up as asked."""


def serve_gate(
    session: Any, gate: Gate, perception: Any, config: GateConfig, output: Output
) -> None:
    """Answer on ``<cell>/gate/verdict`` and publish every verdict on ``/<cell>/verdict``.

    A published verdict carries the time of the newest thing seen, on the cell's own clock, so
    that it lies before the execution it allows. Asked without a plan it says in what it judges.
    """
    publisher = session.publisher(cell_topic(config.cell, VERDICT), schema.VERDICT)
    publishing = threading.Lock()

    def answer(payload: bytes) -> bytes:
        if not payload:
            return json.dumps(gate.judged_in()).encode()
        started = time.monotonic()
        verdict = gate.judge(payload)
        data = verdict.to_json()
        with publishing:
            publisher.put(data, source_ns=perception.newest_ns() or session.now_ns())
        seconds = time.monotonic() - started
        p = verdict.p_success
        share = f" {p['k']:g} of {p['n']:g} samples succeed: {p['value']:.0%}." if p else ""
        text = f"{verdict.plan_id}: {WORDS[verdict.accepted]} in {seconds:.1f} s.{share}"
        output.say(printable(f"{text} {verdict.reason or ''}".rstrip()))
        return data

    # One is judged, some wait, and one more is told at once that it may not: all heard at once,
    # for the deadline runs from when a plan comes in.
    session.serve(cell_topic(config.cell, GATE)[1:], answer, side_by_side=config.waiting + 2)


def serve_localisation(
    session: Any, gate: Gate, perception: Any, config: GateConfig, output: Output
) -> None:
    """Answer on ``<cell>/gate/localise`` where the objects are, and publish each record.

    A planner that plans from these records shares the gate's perception, with its errors.
    """
    publisher = session.publisher(cell_topic(config.cell, LOCALISATION), schema.LOCALISATION)

    def answer(payload: bytes) -> bytes:
        request = _request(payload)
        located = gate.localise(str(request.get("task", "")), str(request.get("task_sha256", "")))
        records, stamp_ns = located.records(), perception.newest_ns() or session.now_ns()
        for record in records:
            publisher.put(json.dumps(record).encode(), source_ns=stamp_ns)
        words = {True: "all found", False: "not all found", None: "nobody could look"}
        output.say(printable(f"localise: {words[located.found]}. {located.reason or ''}".rstrip()))
        reply = {"found": located.found, "reason": located.reason, "objects": records}
        return json.dumps({"schema_version": 1, "stamp_ns": stamp_ns, **reply}).encode()

    session.serve(cell_topic(config.cell, LOCALISE)[1:], answer)


def _request(payload: bytes) -> dict[str, Any]:
    """Read ``{"task": NAME, "task_sha256": HASH}``; nothing asks for the gate's only task."""
    try:
        request = json.loads(payload or b"{}")
    except (ValueError, RecursionError):
        request = None
    if not isinstance(request, dict):
        raise GateError(
            'what is asked of /gate/localise is JSON: {"task": "its name", "task_sha256": "..."}'
        )
    return request


def watch_cell(session: Any, cell: str, take: Callable[[str, bytes, int, str], None]) -> None:
    """Hand the cell's images, joints, transforms, description and events to ``take``."""

    def on_sample(sample: Any) -> None:
        take(sample.topic, sample.data, sample.received_ns, sample.type_name)

    watched = [cell_topic(cell, CAMERAS) + "**", cell_topic(cell, EVENT)]
    watched += [cell_topic(cell, JOINT_STATES), TF, TF_STATIC, ROBOT_DESCRIPTION]
    for topic in watched:
        session.follow(topic, on_sample)


def claim_gate(session: Any, cell: str) -> None:
    """Let other gates of this cell see that there is one, as long as the session is open.

    Whoever asks takes the first answer that comes, and of two gates one may know another task or
    an older scene.
    """
    key = f"{cell}/gate/alive"
    if session.query_alive(key):
        raise GateError(
            f"a gate answers on {cell}{GATE} already, and of two only one would be heard. "
            "Stop it first; one whose machine is gone is forgotten after ten seconds."
        )
    session.declare_alive(key)


def run_gate(path: Path, config: GateConfig, output: Output) -> int:
    """Judge plans until SIGINT or SIGTERM; both end with exit code 0."""
    from bridge.wire.session import open_session  # noqa: PLC0415  # zenoh only when live
    from twin.gate.live import LiveView  # noqa: PLC0415
    from twin.robot.collision import hulls_of  # noqa: PLC0415
    from twin.robot.model import load_robot  # noqa: PLC0415
    from twin.scene.store.calibration import read_calibration  # noqa: PLC0415
    from twin.scene.store.folder import scene_hash_of  # noqa: PLC0415

    if not CELL_NAME.match(config.cell):
        raise UsageError(f"cell name {config.cell!r} is not usable: letters, digits, '_' and '-'.")
    run = RunFolder.open(path)
    tasks = JudgedTasks(
        only=chosen_task_file(config.task, tasks_dir=run.tasks_dir) if config.task else None,
        tasks_dir=run.tasks_dir,
    )
    if tasks.only is not None:
        config.replay.refuse_soft(tasks.only.task().soft_objects)
    urdf = read_robot(config.robot).description() if config.robot else None
    blind = hulls_of(load_robot(urdf)).blind() if urdf else None
    if blind is not None:
        raise GateError(f"no motion of {config.robot} could be accepted: {blind}")
    perception = LiveView(config.cell, read_calibration(run), urdf)

    def judged_in() -> dict[str, str | None]:
        known = read_calibration(run)
        calibration_id = None if known is None else known.calibration_id
        return {"scene_hash": scene_hash_of(run), "calibration_id": calibration_id}

    wire = WireConfig(connect=config.connect, config=config.zenoh_config)
    with (
        stop_signals() as stopped,
        open_session(wire) as session,
        TwinProcess(run.path, config, output) as twin,
    ):
        claim_gate(session, config.cell)
        watch_cell(session, config.cell, perception.take)
        gate = Gate(
            tasks=tasks,
            config=config,
            perception=perception,
            localise=twin.localise,
            replay=twin.replay,
            now_ns=session.now_ns,
            judged_in=judged_in,
        )
        serve_gate(session, gate, perception, config, output)
        serve_localisation(session, gate, perception, config, output)
        only = "any task" if tasks.only is None else tasks.only.task().name
        output.say(
            f"gate ready: {only} of cell {config.cell}, service {config.cell}{GATE}, "
            f"{perception.cameras_from()}. Stop with Ctrl-C."
        )
        while not stopped.wait(0.2):
            pass
    output.say("gate stopped")
    return 0
