"""Commands that speak zenoh: recording, control, and sources."""

import contextlib
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from bridge.record.config import EpisodeAbout, RecorderConfig
from bridge.sources.folder_config import FolderConfig
from bridge.sources.standin.settings import SessionConfig
from bridge.terminal import Output, stop_signals
from bridge.wire.config import DEFAULT_ENDPOINT

OUTPUT = Output()
ABOUT = EpisodeAbout()
RECORDER = RecorderConfig()
FOLDER = FolderConfig()
STANDIN = SessionConfig()
LOOPBACK = (DEFAULT_ENDPOINT,)


def record(
    run: Path,
    /,
    *,
    episode: str | None = None,
    duration_s: Annotated[float | None, Parameter(name=("--duration", "--duration-s"))] = None,
    about: Annotated[EpisodeAbout, Parameter(name="*")] = ABOUT,
    config: Annotated[RecorderConfig, Parameter(name="*")] = RECORDER,
    listen: tuple[str, ...] = LOOPBACK,
    connect: tuple[str, ...] = (),
    zenoh_config: Annotated[Path | None, Parameter(name="--config")] = None,
    output: Output = OUTPUT,
) -> int:
    """Record episodes live; everything published to this recorder ends up in one.

    Without --episode it waits for robot-gst ctl start, or the keys s, x, m, y, n.
    SIGINT or SIGTERM finish the open episode.
    Example: robot-gst record runs/monday --episode scan --duration 30

    Args:
        run: Run folder; made where needed.
        episode: Start this episode at once.
        duration_s: Stop after this long [s]; with --episode.
        about: What is being recorded, with --episode or the key s.
        config: The recorder's settings.
        listen: Where to listen; other processes connect here.
        connect: Other zenoh routers to join.
        zenoh_config: zenoh configuration (JSON5), for example with access control.
        output: How to talk.
    """
    from bridge.errors import UsageError
    from bridge.record.control import parse_info
    from bridge.record.process import run_recorder
    from bridge.wire.config import WireConfig

    if duration_s is not None and (episode is None or duration_s <= 0):
        raise UsageError("--duration needs --episode ID and a time above zero.")
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
            about=about,
        )
    data = answer or {"ok": True, "episode": None}
    output.result(data, _describe_answer(data) if answer else "stopped; no episode was open")
    return 0


def _describe_answer(answer: dict[str, Any]) -> str:
    """One line about a start, stop, mark or label."""
    if answer.get("discarded"):
        return f"{answer['episode']}: discarded"
    if "messages" in answer:
        return (
            f"{answer['episode']}: {answer['messages']} messages, {answer['lost']} lost, "
            f"{answer['undecodable']} undecodable, {answer['duration_s']:.1f} s"
        )
    return f"{answer['episode']}: ok"


def ctl(
    action: Literal["start", "stop", "mark", "label", "status"],
    text: str = "",
    /,
    *,
    id: str | None = None,
    about: Annotated[EpisodeAbout, Parameter(name="*")] = ABOUT,
    result: Literal["success", "failure", "unknown"] | None = None,
    detail: str | None = None,
    discard: bool = False,
    recorder: str = "main",
    connect: tuple[str, ...] = LOOPBACK,
    zenoh_config: Annotated[Path | None, Parameter(name="--config")] = None,
    output: Output = OUTPUT,
) -> int:
    """Control a recorder from anywhere.

    Example: robot-gst ctl start --id trial_0001 --task cube_into_box --cell standin

    Args:
        action: start, stop, mark, label or status.
        text: Words of a mark or label.
        id: Episode to start, or to label after it has been finished.
        about: What is being recorded (start).
        result: How it went (stop, label).
        detail: What happened, in words (stop, label).
        discard: Throw the open episode away (stop).
        recorder: Name of the recorder.
        connect: Where it listens.
        zenoh_config: zenoh configuration (JSON5).
        output: How to talk.
    """
    from bridge.errors import UsageError
    from bridge.record.status import describe_status
    from bridge.wire.config import WireConfig
    from bridge.wire.recorder_client import RecorderClient
    from bridge.wire.session import open_session

    outcome = None
    if result is not None:
        outcome = {"result": result, "k": int(result == "success"), "n": 1, "detail": detail}
    requests: dict[str, dict[str, Any]] = {
        "start": {"id": id, "info": asdict(about)},
        "stop": {"outcome": outcome, "discard": discard},
        "mark": {"text": text},
        "label": {"text": text, "outcome": outcome, "episode": id},
        "status": {},
    }
    if action == "start" and id is None:
        raise UsageError("start needs the new episode's id: robot-gst ctl start --id trial_0001.")
    with open_session(WireConfig(connect=connect, config=zenoh_config)) as session:
        answer = RecorderClient(session, recorder).ask(action, requests[action])
    text = describe_status(answer) if action == "status" else _describe_answer(answer)
    output.result(answer, text)
    return 0


def publish_folder(
    folder: Path,
    /,
    *,
    config: Annotated[FolderConfig, Parameter(name="*")] = FOLDER,
    fast: bool = False,
    episode: str | None = None,
    recorder: str = "main",
    connect: tuple[str, ...] = LOOPBACK,
    zenoh_config: Annotated[Path | None, Parameter(name="--config")] = None,
    output: Output = OUTPUT,
) -> int:
    """Publish an RGB-D folder (scene.json, TUM or 7-Scenes layout) as if it were a live camera.

    Example: robot-gst publish folder data/kitchen --cell kitchen --camera kinect --episode scan

    Args:
        folder: Folder of one of the three layouts (docs/rgbd_folder.md).
        config: Names and rate.
        fast: Send as fast as the recorder takes it; stamps keep their distance.
        episode: Ask the recorder to record this episode from the first to the last frame.
        recorder: Name of the recorder.
        connect: Where it listens.
        zenoh_config: zenoh configuration (JSON5).
        output: How to talk.
    """
    from bridge.errors import GstError
    from bridge.sources.folder import num_frames
    from bridge.sources.folder_index import read_index
    from bridge.sources.folder_publish import publish_folder_frames
    from bridge.wire.config import WireConfig
    from bridge.wire.recorder_client import RecorderClient
    from bridge.wire.session import open_session

    index = read_index(folder, config)
    output.say(f"{index.path}: {index.summary}")
    answer: dict[str, Any] | None = None
    wire = WireConfig(connect=connect, config=zenoh_config)
    with stop_signals() as stop, open_session(wire) as session:
        client = RecorderClient(session, recorder)
        if episode is not None:
            info = {"kind": "scan", "cell": config.cell, "tags": [f"folder:{index.name}"]}
            client.start(episode, info)
        try:
            with output.progress("publish", num_frames(index, config)) as advance:
                sent = publish_folder_frames(
                    session, index, config, fast=fast, should_stop=stop.is_set, advance=advance
                )
        except GstError:
            if episode is not None:  # a part of a folder is no scan
                with contextlib.suppress(GstError):  # the first error is the one to show
                    client.stop(discard=True)
            raise
        if episode is not None:
            answer = client.stop()
    text = f"{sent['frames']} of {sent['of']} frames, {sent['messages']} messages sent"
    if answer is not None:
        text += f"\n{_describe_answer(answer)}"
    output.result({"sent": sent, "recorded": answer}, text)
    return 0


def publish_standin(
    *,
    config: Annotated[SessionConfig, Parameter(name="*")] = STANDIN,
    connect: tuple[str, ...] = LOOPBACK,
    zenoh_config: Annotated[Path | None, Parameter(name="--config")] = None,
    output: Output = OUTPUT,
) -> int:
    """Run the stand-in cell: a simulated laboratory that records a scan, then trials.

    It needs a recorder (robot-gst record RUN) and, with replanning, a gate (robot-gst gate RUN).
    SIGINT or SIGTERM finish the open episode.
    Example: robot-gst publish standin --trials 3 --seed 1
    Scan only: robot-gst publish standin --trials 0

    Args:
        config: What the session does.
        connect: Where the recorder listens.
        zenoh_config: zenoh configuration (JSON5).
        output: How to talk.
    """
    from bridge.sources.standin.session import describe, run_session
    from bridge.wire.config import WireConfig
    from bridge.wire.session import open_session

    wire = WireConfig(connect=connect, config=zenoh_config)
    with stop_signals() as stop, open_session(wire) as session:
        summary = run_session(session, config, output, should_stop=stop.is_set)
    output.result(summary, describe(summary))
    return 0
