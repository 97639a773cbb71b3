"""Commands that publish: an RGB-D folder, the stand-in cell."""

import contextlib
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from bridge.sources.folder_config import FolderConfig
from bridge.sources.standin.settings import SessionConfig
from bridge.terminal import Output, stop_signals
from bridge.wire.config import DEFAULT_ENDPOINT

OUTPUT = Output()
FOLDER = FolderConfig()
STANDIN = SessionConfig()
LOOPBACK = (DEFAULT_ENDPOINT,)


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
    from bridge.record.status import describe_answer
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
        text += f"\n{describe_answer(answer)}"
    output.result({"sent": sent, "recorded": answer}, text)
    return 0


def publish_standin(
    *,
    config: Annotated[SessionConfig, Parameter(name="*")] = STANDIN,
    connect: tuple[str, ...] = LOOPBACK,
    zenoh_config: Annotated[Path | None, Parameter(name="--config")] = None,
    output: Output = OUTPUT,
) -> int:
    """Run the stand-in cell: a simulated laboratory that records a scan, trials, then probes.

    It needs a recorder (robot-gst record RUN) and, with replanning, a gate (robot-gst gate RUN).
    SIGINT or SIGTERM finish the open episode.
    Example: robot-gst publish standin --trials 3 --seed 1
    Scan only: robot-gst publish standin --trials 0
    Probes of physics only: robot-gst publish standin --trials 0 --no-scan --probes 4
    Soft toys: robot-gst publish standin --task sloth_into_basket --conditions without_replanning

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
