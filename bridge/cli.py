"""Commands of the room ``bridge``; imports stay late so that --help is quick."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from bridge.episode.message import StampedMessage
from bridge.record.config import EpisodeAbout, RecorderConfig
from bridge.sources.folder_config import FolderConfig
from bridge.sources.standin.settings import SessionConfig
from bridge.terminal import Output
from bridge.wire.config import DEFAULT_ENDPOINT

OUTPUT = Output()
ABOUT = EpisodeAbout()
RECORDER = RecorderConfig()
FOLDER = FolderConfig()
STANDIN = SessionConfig()
LOOPBACK = (DEFAULT_ENDPOINT,)


def info(episode: Path, /, *, output: Output = OUTPUT) -> int:
    """Show what an episode holds.

    Example: robot-gst info runs/demo/episodes/trial_0001.mcap
    """
    from bridge.episode.reader import Episode

    opened = Episode.open(episode)
    topics = opened.topics()
    outcome = opened.outcome
    data = {
        "file": str(episode),
        "info": asdict(opened.info),
        "outcome": asdict(outcome) if outcome else None,
        "derived": asdict(opened.derived) if opened.derived else None,
        "software": opened.metadata_records.get("software", {}),
        "duration_s": opened.duration_s,
        "topics": [asdict(item) for item in topics.values()],
    }
    about = opened.info
    lines = [
        f"{episode.name}: {about.kind} {about.task} {about.condition}".rstrip(),
        f"  {'stand-in cell' if about.stand_in else 'cell'} {about.cell or 'not named'}, "
        f"{opened.duration_s:.1f} s, {sum(item.count for item in topics.values())} messages, "
        f"{episode.stat().st_size / 1e6:.1f} MB",
        f"  outcome: {outcome.result if outcome else 'not labelled'}",
    ]
    if opened.derived:
        derived = opened.derived
        lines.append(
            f"  derived: {derived.kind} of {derived.source_episode} "
            f"{derived.trajectory or ''} {derived.mode or ''} {derived.engine or ''}".rstrip()
        )
    width = max((len(topic) for topic in topics), default=0)
    lines += [
        f"  {item.topic:<{width}}  {item.count:>7}  {item.type_name}" for item in topics.values()
    ]
    output.result(data, "\n".join(lines))
    return 0


def check(episodes: list[Path], /, *, output: Output = OUTPUT) -> int:
    """Check that episodes are whole: CRCs, decoding, counts, and losses they declare.

    Exit code 0 clean, 3 declared losses, 1 broken. Example: robot-gst check runs/demo
    """
    from bridge.episode.check import check_episode

    files: list[Path] = []
    for path in episodes:
        files.extend(sorted(path.rglob("*.mcap")) if path.is_dir() else [path])
    reports = [check_episode(path) for path in files]
    lines = []
    for report in reports:
        lines.append(
            f"{report.path.name}: {report.summary}, {report.messages} messages, "
            f"{report.declared_losses} declared lost"
        )
        lines += [f"  {fault}" for fault in report.faults]
    data = {
        "episodes": [
            {
                "file": str(report.path),
                "state": report.summary,
                "messages": report.messages,
                "declared_losses": report.declared_losses,
                "faults": report.faults,
            }
            for report in reports
        ]
    }
    output.result(data, "\n".join(lines) or "no episodes found")
    codes = {report.exit_code for report in reports}
    return 1 if 1 in codes or not reports else max(codes)


def ls(run: Path, /, *, output: Output = OUTPUT) -> int:
    """List the episodes of a run.

    Example: robot-gst ls runs/demo
    """
    from bridge.episode.catalogue import list_episodes
    from bridge.episode.run import RunFolder

    entries = list_episodes(RunFolder.open(run))
    lines = [
        f"{entry.id:<28} {entry.kind:<9} {entry.condition:<20} {entry.outcome:<8} "
        f"{entry.duration_s:7.1f} s {entry.size_bytes / 1e6:7.1f} MB"
        f"{'  stand-in' if entry.stand_in else ''}{'  ' + entry.error if entry.error else ''}"
        for entry in entries
    ]
    output.result(
        {"episodes": [asdict(entry) for entry in entries]},
        "\n".join(lines) or f"no episodes in {run}. Record some: robot-gst record {run}",
    )
    return 1 if any(entry.error for entry in entries) else 0


def label(
    run: Path,
    episode: str,
    /,
    *,
    result: Annotated[str, Parameter(help="success, failure or unknown.")],
    by: str = "operator",
    detail: str | None = None,
    output: Output = OUTPUT,
) -> int:
    """Say after the fact how an episode ended; kept in notes/, the episode is not rewritten.

    Example: robot-gst label runs/monday trial_0003 --result failure --detail "slipped"
    """
    from bridge.episode.catalogue import label_episode
    from bridge.episode.metadata import Outcome
    from bridge.episode.run import RunFolder

    outcome = Outcome(result=result, k=int(result == "success"), n=1, by=by, detail=detail)
    path = label_episode(RunFolder.open(run), episode, outcome)
    output.result({"label": asdict(outcome), "file": str(path)}, f"{episode}: {result} ({path})")
    return 0


def doctor(*, output: Output = OUTPUT) -> int:
    """Say what is installed, what is missing, and how to get it.

    Example: robot-gst doctor
    """
    from bridge.doctor import examine

    findings = examine()
    lines = [
        f"{'ok  ' if item.ok else 'MISS'} {item.what:<28} {item.found:<12} {item.advice}".rstrip()
        for item in findings
    ]
    output.result({"findings": [asdict(item) for item in findings]}, "\n".join(lines))
    return 0 if all(item.ok for item in findings) else 1


@contextmanager
def _stop_on_signals() -> Iterator[threading.Event]:
    """Set the event on SIGINT or SIGTERM instead of ending the process."""
    stop = threading.Event()
    before = {
        number: signal.signal(number, lambda *_: stop.set())
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


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
    with _stop_on_signals() as stop:
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
    from bridge.record.process import describe_status
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
    """Publish an RGB-D folder (with a scene.json) as if it were a live camera.

    Example: robot-gst publish folder data/kitchen --cell kitchen --camera kinect --episode scan

    Args:
        folder: Folder with scene.json, colour and depth images.
        config: Names and rate.
        fast: Send as fast as the recorder takes it; stamps keep their distance.
        episode: Ask the recorder to record this episode from the first to the last frame.
        recorder: Name of the recorder.
        connect: Where it listens.
        zenoh_config: zenoh configuration (JSON5).
        output: How to talk.
    """
    from bridge.sources.folder import num_frames
    from bridge.sources.folder_index import read_index
    from bridge.sources.folder_publish import publish_folder_frames
    from bridge.wire.config import WireConfig
    from bridge.wire.recorder_client import RecorderClient
    from bridge.wire.session import open_session

    index = read_index(folder)
    answer: dict[str, Any] | None = None
    wire = WireConfig(connect=connect, config=zenoh_config)
    with _stop_on_signals() as stop, open_session(wire) as session:
        client = RecorderClient(session, recorder)
        if episode is not None:
            info = {"kind": "scan", "cell": config.cell, "tags": [f"folder:{index.name}"]}
            client.start(episode, info)
        try:
            with output.progress("publish", num_frames(index, config)) as advance:
                sent = publish_folder_frames(
                    session, index, config, fast=fast, should_stop=stop.is_set, advance=advance
                )
        finally:
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
    with _stop_on_signals() as stop, open_session(wire) as session:
        summary = run_session(session, config, output, should_stop=stop.is_set)
    output.result(summary, describe(summary))
    return 0


def import_rgbd(
    folder: Path,
    run: Path,
    /,
    *,
    episode: str = "scan",
    config: Annotated[FolderConfig, Parameter(name="*")] = FOLDER,
    output: Output = OUTPUT,
) -> int:
    """Turn an RGB-D folder (with a scene.json) into a scan episode.

    Example: robot-gst import rgbd data/kitchen runs/kitchen --cell kitchen --camera kinect

    Args:
        folder: Folder with scene.json, colour and depth images.
        run: Run folder; made where needed.
        episode: Id of the new episode.
        config: Names and rate.
        output: How to talk.
    """
    from bridge.episode.metadata import EpisodeInfo
    from bridge.episode.provenance import hash_file
    from bridge.episode.run import RunFolder
    from bridge.exchange.rgbd import write_scan
    from bridge.sources.folder import folder_messages, num_frames
    from bridge.sources.folder_index import read_index

    index = read_index(folder)
    info = EpisodeInfo(id=episode, kind="scan", cell=config.cell, tags=(f"folder:{index.name}",))
    source = {
        "folder": index.name,
        "index_sha256": hash_file(index.path),
        "depth_unit_m": index.depth_unit_m,
        "depth_rounded_to_m": 1e-3,
        "frames_left_out_without_pose": index.num_unposed,
        "times": f"nominal, {config.rate_hz:g} Hz from 0; the folder has none",
    }
    total = num_frames(index, config)

    with output.progress("import", total) as advance:

        def messages() -> Iterator[StampedMessage]:
            for done, frame in enumerate(folder_messages(index, config, 0), start=1):
                yield from frame
                advance(done, "")

        path = write_scan(RunFolder.create(run), info, messages(), source=source)
    data = {"file": str(path), "frames": total, "frames_left_out": index.num_unposed}
    output.result(data, f"{path}: {total} frames")
    return 0


def import_kinova(folder: Path, run: Path, /, *, output: Output = OUTPUT) -> int:
    """Turn the Kinova reality-gap runs into episodes: real ones recorded, simulated ones derived.

    Example: robot-gst import kinova data/kinova runs/kinova

    Args:
        folder: Folder with real/Experiment1/*.tsv and sim/Experiment1/*.csv.
        run: Run folder; made where needed.
        output: How to talk.
    """
    from bridge.episode.run import RunFolder
    from bridge.exchange.kinova import find_runs, import_runs

    real, simulated = find_runs(folder)
    files = []
    with output.progress("import", len(real) + len(simulated)) as advance:
        for path, _ in import_runs(folder, RunFolder.create(run)):
            files.append(str(path))
            advance(len(files), path.name)
    data = {"real": len(real), "simulated": len(simulated), "files": files}
    output.result(data, f"{len(real)} real and {len(simulated)} simulated runs in {run}")
    return 0
