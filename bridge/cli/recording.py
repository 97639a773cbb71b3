"""Commands that record, and that control a recorder from anywhere."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from bridge.record.config import EpisodeAbout, RecorderConfig
from bridge.terminal import RARE, Output, stop_signals
from bridge.wire.config import LOOPBACK

if TYPE_CHECKING:
    from bridge.task.task_file import TaskFile

OUTPUT = Output()
ABOUT = EpisodeAbout()
RECORDER = RecorderConfig()
Action = Literal["start", "stop", "mark", "label", "status"]


def record(
    run: Path,
    /,
    *,
    episode: str | None = None,
    duration_s: Annotated[float | None, Parameter(name=("--duration", "--duration-s"))] = None,
    anyway: Annotated[bool, RARE] = False,
    about: Annotated[EpisodeAbout, Parameter(name="*")] = ABOUT,
    config: Annotated[RecorderConfig, Parameter(name="*")] = RECORDER,
    listen: tuple[str, ...] = LOOPBACK,
    connect: tuple[str, ...] = (),
    zenoh_config: Annotated[Path | None, Parameter(name="--config")] = None,
    output: Output = OUTPUT,
) -> int:
    """Record episodes live; everything published to this recorder ends up in one.

    Without --episode it waits for robot-gst ctl start.
    SIGINT or SIGTERM finish the open episode.
    Example: robot-gst record runs/monday --episode scan --duration 30

    Args:
        run: Run folder; made where needed.
        episode: Start this episode at once.
        duration_s: Stop after this long [s]; with --episode.
        anyway: Start it although topics are missing that cell.toml requires; else it waits.
        about: What is being recorded, with --episode.
        listen: Where to listen; other processes connect here.
        connect: Other zenoh routers to join.
        zenoh_config: zenoh configuration (JSON5), for example with access control.
    """
    from bridge.errors import UsageError
    from bridge.record.control import parse_info
    from bridge.record.process import run_recorder
    from bridge.record.status import describe_answer
    from bridge.wire.config import WireConfig

    if duration_s is not None and (episode is None or duration_s <= 0):
        raise UsageError("--duration needs --episode ID and a time above zero.")
    about, task = _with_task_file(about)
    info = None if episode is None else parse_info(episode, asdict(about))
    wire = WireConfig(mode="router", listen=listen, connect=connect, config=zenoh_config)
    with stop_signals() as stop:
        answer = run_recorder(
            run,
            wire=wire,
            config=config,
            stop=stop,
            output=output,
            episode=info,
            duration_s=duration_s,
            anyway=anyway,
            task=task,
        )
    data = answer or {"ok": True, "episode": None}
    output.result(data, describe_answer(data) if answer else "stopped; no episode was open")
    return 0


def ctl(
    action: Action,
    text: str = "",
    /,
    *,
    id: str | None = None,
    about: Annotated[EpisodeAbout, Parameter(name="*")] = ABOUT,
    result: Literal["success", "failure", "unknown"] | None = None,
    detail: str | None = None,
    discard: bool = False,
    anyway: bool = False,
    recorder: Annotated[str, RARE] = "main",
    connect: tuple[str, ...] = LOOPBACK,
    zenoh_config: Annotated[Path | None, Parameter(name="--config")] = None,
    output: Output = OUTPUT,
) -> int:
    """Control a recorder from anywhere.

    Example: robot-gst ctl start --id trial_0001 --task cube_into_box --cell standin

    Args:
        action: start, stop, mark, label or status.
        text: Words of a mark or label.
        id: Episode to start, by default the next number, or to label when it is finished.
        about: What is being recorded (start).
        result: How it went (stop, label).
        detail: What happened, in words (stop, label).
        discard: Throw the open episode away (stop).
        anyway: Start although topics are missing that cell.toml requires (start).
        recorder: Name of the recorder.
        connect: Where it listens.
        zenoh_config: zenoh configuration (JSON5).
    """
    from bridge.record.control import RecorderClient
    from bridge.record.status import describe_answer, describe_status
    from bridge.wire.config import WireConfig
    from bridge.wire.session import open_session

    about, task = _with_task_file(about)
    sent = {} if task is None else {"task_file": task.data.decode()}
    outcome = None
    if result is not None:
        outcome = {"result": result, "k": int(result == "success"), "n": 1, "detail": detail}
    requests: dict[str, dict[str, Any]] = {
        "start": {"id": id, "info": asdict(about), "anyway": anyway, **sent},
        "stop": {"outcome": outcome, "discard": discard},
        "mark": {"text": text},
        "label": {"text": text, "outcome": outcome, "episode": id},
        "status": {},
    }
    with open_session(WireConfig(connect=connect, config=zenoh_config)) as session:
        answer = RecorderClient(session, recorder).ask(action, requests[action])
    text = describe_status(answer) if action == "status" else describe_answer(answer)
    output.result(answer, text)
    return 0


def _with_task_file(about: EpisodeAbout) -> "tuple[EpisodeAbout, TaskFile | None]":
    """Read the task file that ``about`` names by its path; what is left there is its name."""
    from bridge.task.task_file import TaskFile

    if not about.task.endswith(".toml"):
        return about, None
    file = TaskFile.read(Path(about.task))
    return replace(about, task=file.task().name), file
