"""Trials of the stand-in cell as episodes of a run, in process: no wire, no recorder process."""

import json
from pathlib import Path
from typing import Any

from bridge.clock import ns_from_s
from bridge.episode import metadata
from bridge.episode.metadata import EpisodeInfo, Outcome
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.sources.standin.session import run_session
from bridge.sources.standin.settings import SessionConfig
from bridge.terminal import Output
from bridge.wire.errors import NoReplyError
from bridge.wire.qos import Qos

START_NS = ns_from_s(1_750_000_000.0)
UNGATED = "without_replanning"


class FileSession:
    """Has the methods of ``WireSession`` that the cell uses, and writes its episodes to files."""

    def __init__(self, folder: Path) -> None:
        """Write into a folder of episodes."""
        self._folder = folder
        self._writer: EpisodeWriter | None = None

    def publisher(self, topic: str, type_name: str, *, qos: Qos = Qos.RELIABLE) -> "_Topic":
        """Announce a topic."""
        return _Topic(self, topic, type_name)

    def write(self, topic: str, type_name: str, data: bytes, source_ns: int) -> None:
        """Into the open episode; what comes between two is not recorded."""
        if self._writer is not None:
            self._writer.write(topic, data, type_name=type_name, log_time_ns=source_ns)

    def query(self, key: str, payload: bytes, *, timeout_s: float) -> bytes:
        """Play the recorder; nobody is the gate."""
        request = json.loads(payload)
        verb = key.rsplit("/", 1)[-1]
        if verb == "start":
            fields = {**request["info"], "tags": tuple(request["info"].get("tags", ()))}
            info = EpisodeInfo(id=request["id"], **fields)
            self._writer = EpisodeWriter(self._folder / f"{request['id']}.mcap")
            self._writer.describe(info)
            return b"{}"
        if verb == "stop":
            self._stop(request["outcome"], discard=bool(request["discard"]))
            return b"{}"
        if verb == "list":
            done = [{"id": path.stem} for path in sorted(self._folder.glob("*.mcap"))]
            return json.dumps({"of": len(done), "episodes": done}).encode()
        raise NoReplyError(key=key, timeout_s=timeout_s)

    def subscribe(self, key_expression: str, callback: object) -> None:
        """Nobody else sends."""

    def _stop(self, outcome: dict[str, Any] | None, *, discard: bool) -> None:
        writer, self._writer = self._writer, None
        if writer is None:
            return
        if discard:
            writer.discard()
            return
        if outcome is not None:
            said = Outcome(**{**outcome, "stages": tuple(outcome.get("stages", ()))})
            writer.add_metadata("outcome", metadata.to_strings(said))
        writer.close()


class _Topic:
    def __init__(self, session: FileSession, topic: str, type_name: str) -> None:
        self._session, self._topic, self._type_name = session, topic, type_name

    def put(self, data: bytes, *, source_ns: int) -> None:
        self._session.write(self._topic, self._type_name, bytes(data), source_ns)


def record_ungated(
    run: RunFolder,
    task: str,
    seed: int,
    trials: int,
    cell_file: str = "",
    session: FileSession | None = None,
    **settings: Any,
) -> list[Path]:
    """Record one session of trials that nobody judges beforehand, unless it is there.

    Args:
        run: Where to; one session, one laboratory, one run.
        cell_file: A cell of ``datasets/cells``; empty: the task's own.
        session: Who writes, where it does more than that.
        settings: Of the session, where they are not the usual ones.

    Returns:
        The episodes, one per trial.
    """
    paths = [run.episodes_dir / f"trial_{number:04d}.mcap" for number in range(1, trials + 1)]
    if all(path.is_file() for path in paths):
        return paths
    for path in paths:
        path.unlink(missing_ok=True)
    config = SessionConfig(
        cell_file=cell_file,
        task=task,
        seed=seed,
        scan=False,
        trials=trials,
        conditions=(UNGATED,),
        **settings,
    )
    wire = session or FileSession(run.episodes_dir)
    run_session(wire, config, Output(quiet=True), start_ns=START_NS)
    return paths
