"""The verdict service: a plan comes in over the wire, I(tau) goes out, before the robot moves.

Each plan is replayed in the twin from where the objects were last seen at rest. What cannot be
decided is answered with ``accepted: null`` and a reason; nothing is ever accepted by default.
"""

import queue
import re
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Protocol, runtime_checkable

import numpy as np
from cyclopts import Parameter
from jaxtyping import Float

from bridge.episode import schema
from bridge.episode.run import RunFolder
from bridge.errors import GstError
from bridge.task.plan import Plan
from bridge.task.robot import BASE_FRAME
from bridge.task.task_file import Task, load_task
from bridge.task.verdict import Factor, Verdict
from bridge.terminal import Output, stop_signals
from bridge.wire.config import DEFAULT_ENDPOINT, WireConfig
from twin.errors import TwinError
from twin.replay.config import ReplayConfig
from twin.replay.scene import refuse_soft
from twin.scene.settings import convert_duration

ENGINE_NONE = "none"
CELL_NAME = re.compile(r"^[A-Za-z0-9][A-Za-z0-9_-]*$")
POLL_S = 0.05


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class GateConfig:
    """What the gate judges, and how long it may take."""

    connect: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    """Endpoints of the recorder."""
    zenoh_config: Annotated[Path | None, Parameter(name="--config")] = None
    """zenoh configuration (JSON5), for example with certificates."""
    cell: str = "standin"
    """Whose plans are judged: topics and the service are below this name."""
    task: str = "cube_into_box"
    """The task whose objects and success predicate count."""
    deadline_s: Annotated[float, Parameter(name="--deadline", converter=convert_duration)] = 20.0
    """Answer after this long at the latest: 20s, 1min or plain seconds."""
    waiting: int = 4
    """Plans that may wait while one is judged; more are turned away at once."""
    frames: int = 3
    """Frames per camera that are averaged to find the objects."""
    frame_wait_s: float = 2.0
    """Wait this long for fresh frames before giving up."""
    max_frame_age_s: float = 5.0
    """A camera that has been silent for longer, on the cell's clock, is not trusted."""
    max_silence_s: float = 30.0
    """When nothing at all arrived for this long, not counting the time spent on a verdict, the
    cell is not trusted to be as it was last seen."""
    replay: Annotated[ReplayConfig, Parameter(name="replay")] = field(default_factory=ReplayConfig)
    """How each plan is re-lived."""


class GateError(TwinError):
    """The gate cannot be set up as asked."""


class UndecidedError(TwinError):
    """There is no basis for a verdict; the message says what is missing."""


@runtime_checkable
class Eyes(Protocol):
    """What the gate sees of the cell: ``twin.scene.live.LiveView``, or a fake."""

    def urdf(self) -> str | None:
        """The robot description."""

    def executing(self) -> str | None:
        """The plan being executed right now."""

    def newest_ns(self) -> int:
        """The latest time on the cell's own clock."""

    def heard_ns(self) -> int:
        """When the last message arrived."""

    def frames(self, *, max_age_ns: int, max_per_camera: int) -> Any:
        """The latest frames at rest."""


Localise = Callable[[Any, Task], dict[str, Any]]
Replay = Callable[[Plan, dict[str, Float[np.ndarray, "4 4"]], str], Verdict]


class Gate:
    """Judges plans one at a time; every answer comes before the deadline."""

    def __init__(
        self,
        *,
        task: Task,
        config: GateConfig,
        eyes: Eyes,
        localise: Localise,
        replay: Replay,
        now_ns: Callable[[], int],
    ) -> None:
        """Put together what sees, what finds objects and what replays."""
        self._task = task
        self._config = config
        self._eyes = eyes
        self._localise = localise
        self._replay = replay
        self._now_ns = now_ns
        self._turn = threading.Lock()
        self._counting = threading.Lock()
        self._inside = 0
        self._contact_ns = 0

    def judge(self, payload: bytes) -> Verdict:
        """Judge one plan.

        Raises:
            InvalidRecordError: When the payload is no gst plan; nothing else is an error.
        """
        plan = Plan.from_json(payload)
        with self._counting:
            if self._inside > self._config.waiting:
                return no_verdict(plan, f"{self._inside} plans are being judged already; ask later")
            self._inside += 1
        try:
            return self._before_deadline(plan)
        finally:
            with self._counting:
                self._inside -= 1

    def _before_deadline(self, plan: Plan) -> Verdict:
        ends = time.monotonic() + self._config.deadline_s
        limit = f"the deadline of {self._config.deadline_s:g} s"
        if not self._turn.acquire(timeout=self._config.deadline_s):
            return no_verdict(plan, f"an earlier plan was still being judged at {limit}")
        answers: queue.SimpleQueue[Verdict] = queue.SimpleQueue()

        def work() -> None:
            try:
                answers.put(self._decide(plan))
            finally:
                self._turn.release()

        # A replay cannot be interrupted: past the deadline it finishes unheard, and until then
        # holds the turn. A daemon thread does not keep the process from ending.
        worker = threading.Thread(target=work, name=f"judge {plan.id}", daemon=True)
        try:
            worker.start()
        except RuntimeError as error:
            self._turn.release()
            return no_verdict(plan, f"no thread to judge it in: {error}")
        try:
            return answers.get(timeout=max(0.0, ends - time.monotonic()))
        except queue.Empty:
            return no_verdict(plan, f"the replay was not done at {limit}")

    def _decide(self, plan: Plan) -> Verdict:
        silent_ns = self._now_ns() - max(self._eyes.heard_ns(), self._contact_ns)
        try:
            urdf = self._check(plan)
            if silent_ns > self._config.max_silence_s * 1e9:
                raise UndecidedError(
                    f"nothing has arrived from the cell for {silent_ns * 1e-9:.0f} s"
                )
            verdict = self._replay(plan, self._find_objects(), urdf)
            # A cell that waits for the verdict may stand still meanwhile: not counted as silence.
            self._contact_ns = self._now_ns() - silent_ns
            return verdict
        except GstError as error:
            return no_verdict(plan, str(error))
        except Exception as error:  # noqa: BLE001  # a bug must not become a yes, nor silence
            traceback.print_exc()
            return no_verdict(plan, f"internal error: {type(error).__name__}: {error}")

    def _check(self, plan: Plan) -> str:
        """Refuse plans this gate cannot judge; return the robot description."""
        refuse_soft(self._task)
        if plan.task and plan.task != self._task.name:
            raise UndecidedError(
                f"plan {plan.id} is for task {plan.task!r}; this gate judges {self._task.name!r}. "
                "Start it with --task."
            )
        if plan.frame != BASE_FRAME:
            raise UndecidedError(
                f"plan {plan.id} is given in frame {plan.frame!r}; only {BASE_FRAME!r}, the "
                "robot's root, is judged"
            )
        urdf = self._eyes.urdf()
        if urdf is None:
            raise UndecidedError("no robot description has arrived on /robot_description")
        robot = robot_name(urdf)
        if plan.robot != robot:
            raise UndecidedError(
                f"plan {plan.id} is for robot {plan.robot!r}; the cell's robot is {robot!r}"
            )
        running = self._eyes.executing()
        if running is not None:
            raise UndecidedError(f"{running} is being executed; objects are judged at rest")
        return urdf

    def _find_objects(self) -> dict[str, Float[np.ndarray, "4 4"]]:
        found = self._localise(self._wait_for_frames(), self._task)
        missing = [f"{name}: {item.reason}" for name, item in found.items() if not item.found]
        if missing:
            raise UndecidedError(f"not every object was found: {'; '.join(missing)}")
        return {name: item.T_base_object for name, item in found.items()}

    def _wait_for_frames(self) -> Any:
        ends = time.monotonic() + self._config.frame_wait_s
        while True:
            live = self._eyes.frames(
                max_age_ns=round(self._config.max_frame_age_s * 1e9),
                max_per_camera=self._config.frames,
            )
            if live.frames:
                return live.frames
            if time.monotonic() >= ends:
                raise UndecidedError(f"no usable frames: {'; '.join(live.reasons)}")
            time.sleep(POLL_S)


def no_verdict(plan: Plan, reason: str) -> Verdict:
    """The answer when nothing can be decided: accepted null, with the reason."""
    undecided = Factor(value=None)
    return Verdict(
        plan_id=plan.id,
        trajectory="planned",
        mode="dynamic",
        ik=undecided,
        clearance=undecided,
        terminal=undecided,
        engine=ENGINE_NONE,
        seed=0,
        reason=reason,
    )


def robot_name(urdf: str) -> str:
    """Return the name in a URDF's ``<robot>`` element, "" when there is none."""
    found = re.search(r"<robot\b[^>]*?\bname\s*=\s*[\"']([^\"']*)[\"']", urdf)
    return found[1] if found else ""


def make_gate(run: RunFolder, config: GateConfig, eyes: Eyes, now_ns: Callable[[], int]) -> Gate:
    """Put the real localisation and replay behind the gate; imports what is heavy."""
    from twin.replay.rollout import replay_plan  # noqa: PLC0415  # seconds of imports
    from twin.replay.scene import ReplayScene  # noqa: PLC0415
    from twin.scene.localise import localise_objects  # noqa: PLC0415
    from twin.scene.store import scene_hash_of  # noqa: PLC0415

    task = load_task(config.task)

    def replay(plan: Plan, poses: dict[str, Float[np.ndarray, "4 4"]], urdf: str) -> Verdict:
        scene = ReplayScene(
            task=task, Ts_base_object=poses, urdf=urdf, scene_hash=scene_hash_of(run)
        )
        return replay_plan(plan, scene, config.replay).verdict

    return Gate(
        task=task,
        config=config,
        eyes=eyes,
        localise=localise_objects,
        replay=replay,
        now_ns=now_ns,
    )


def serve_gate(session: Any, gate: Gate, eyes: Eyes, config: GateConfig, output: Output) -> None:
    """Answer on ``<cell>/gate/verdict`` and publish every verdict on ``/<cell>/verdict``.

    A published verdict carries the time of the newest thing seen, on the cell's own clock, so
    that it lies before the execution it allows.
    """
    publisher = session.publisher(f"/{config.cell}/verdict", schema.VERDICT)

    def answer(payload: bytes) -> bytes:
        started = time.monotonic()
        verdict = gate.judge(payload)
        data = verdict.to_json()
        publisher.put(data, source_ns=eyes.newest_ns() or session.now_ns())
        seconds = time.monotonic() - started
        said = {True: "accepted", False: "rejected", None: "no verdict"}[verdict.accepted]
        output.say(f"{verdict.plan_id}: {said} in {seconds:.1f} s. {verdict.reason or ''}".rstrip())
        return data

    session.serve(f"{config.cell}/gate/verdict", answer)


def watch_cell(session: Any, cell: str, take: Callable[[str, bytes, int, str], None]) -> None:
    """Hand the cell's images, transforms, description and events to ``take``."""

    def on_sample(sample: Any) -> None:
        take(sample.topic, sample.data, sample.received_ns, sample.type_name)

    for key in (f"{cell}/cam/**", f"{cell}/event", "tf", "tf_static", "robot_description"):
        session.subscribe(key, on_sample)


def run_gate(path: Path, config: GateConfig, output: Output) -> int:
    """Judge plans until SIGINT or SIGTERM; both end with exit code 0."""
    from bridge.wire.session import open_session  # noqa: PLC0415  # zenoh only when live
    from twin.scene.live import LiveView  # noqa: PLC0415

    if not CELL_NAME.match(config.cell):
        raise GateError(f"cell name {config.cell!r} is not usable: letters, digits, '_' and '-'.")
    run = RunFolder.open(path)
    eyes = LiveView(config.cell)
    wire = WireConfig(connect=config.connect, config=config.zenoh_config)
    with stop_signals() as stopped, open_session(wire) as session:
        watch_cell(session, config.cell, eyes.take)
        gate = make_gate(run, config, eyes, session.now_ns)
        serve_gate(session, gate, eyes, config, output)
        output.say(
            f"gate ready: {config.task} of cell {config.cell}, service {config.cell}/gate/verdict. "
            "Stop with Ctrl-C."
        )
        while not stopped.wait(0.2):
            pass
    output.say("gate stopped")
    return 0
