"""``evaluate --live`` against a recorder: over the loopback address, and on made-up messages."""

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from live_recorder import LiveRecorder, open_recorder
from loopback import free_endpoint

from bridge.episode import schema
from bridge.episode.catalogue import Entry, label_episode
from bridge.episode.metadata import Outcome
from bridge.episode.run_folder import RunFolder
from bridge.task.record import check_record
from bridge.terminal import Output
from bridge.wire.config import WireConfig
from bridge.wire.session import WireSample, open_session
from evaluator.live.follow import Follower, read_update

ROOT = Path(__file__).resolve().parents[2]
WAIT_S = 150.0
WITHOUT, WITH = "without_replanning", "with_replanning"


class Live:
    """One ``evaluate --live --json`` process and the lines it has printed."""

    def __init__(self, run: Path, endpoint: str) -> None:
        """Start it."""
        command = ("evaluate", str(run), "--live", "--goal", "0.5", "--connect", endpoint, "--json")
        self.child = subprocess.Popen(
            [sys.executable, "robot_gst.py", *command],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._lines: queue.Queue[str] = queue.Queue()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self.child.stdout is not None
        for line in self.child.stdout:
            self._lines.put(line)

    def next(self) -> dict[str, Any]:
        """Wait for the next line."""
        record = json.loads(self._lines.get(timeout=WAIT_S))
        check_record(record, name="advice", package="bridge.episode")
        return dict(record)

    def is_silent(self, seconds: float) -> bool:
        """Whether nothing is printed for a while."""
        time.sleep(seconds)
        return self._lines.empty()

    def end(self, number: signal.Signals) -> tuple[int, str]:
        """Send a signal; return the exit code and what was said on stderr."""
        self.child.send_signal(number)
        code = self.child.wait(timeout=WAIT_S)
        self._thread.join(timeout=WAIT_S)
        assert self.child.stderr is not None
        return code, self.child.stderr.read()


@contextmanager
def following(run: Path, endpoint: str) -> Iterator[Live]:
    live = Live(run, endpoint)
    try:
        yield live
    finally:
        if live.child.poll() is None:
            live.child.kill()
            live.child.wait()
        for stream in (live.child.stdout, live.child.stderr):
            if stream is not None:
                stream.close()


def record_trial(
    recorder: LiveRecorder, name: str, condition: str, start: str, result: str | None
) -> None:
    about = {"task": "cube_into_box", "policy": "scripted"}
    recorder.start(name, condition=condition, start_id=start, **about)
    recorder.stop(result=result)


@pytest.mark.slow
def test_a_session_is_followed_while_it_is_recorded(tmp_path: Path) -> None:
    endpoint, path = free_endpoint(), tmp_path / "run"
    host = WireConfig(mode="router", connect=(), listen=(endpoint,))
    heard: list[bytes] = []
    with open_recorder(path, wire=host) as recorder:
        record_trial(recorder, "t1", WITHOUT, "s1", "failure")
        with open_session(WireConfig(connect=(endpoint,))) as session:
            session.subscribe("rec/main/advice", lambda sample: heard.append(sample.data))
            with following(path, endpoint) as live:
                begun = live.next()
                assert begun["episode"] is None
                assert [(r["k"], r["n"]) for r in begun["rates"]] == [(0, 1)]
                assert begun["next"]["condition"] == WITHOUT  # the other was never run yet

                record_trial(recorder, "t2", WITH, "s1", "failure")
                line = live.next()
                assert (line["episode"], line["outcome"]) == ("t2", "failure")
                assert [(g["improved"], g["n"]) for g in line["gains"]] == [(0, 1)]
                assert line["next"]["start_id"] is None  # the pair is complete

                recorder.label("success", episode="t2")
                line = live.next()
                assert "t2: success (corrected, was failure)" in line["text"]
                assert [(g["improved"], g["n"]) for g in line["gains"]] == [(1, 1)]

                record_trial(recorder, "t3", WITH, "s2", None)
                elsewhere = entry_record("t9", run=str(tmp_path / "elsewhere"))
                again = entry_record("t2", run=str(path), condition=WITH, start_id="s1")
                with_start = {**again, "start_ns": begun_at(path, "t2")}
                publisher = session.publisher("/rec/main/episode", schema.ENTRY)
                for forged in (elsewhere, with_start, {"no": "entry"}):
                    publisher.put(json.dumps(forged).encode(), source_ns=1)
                assert live.is_silent(0.5)

                late = Outcome(result="success", k=1, n=1, by="operator")
                label_episode(RunFolder(path), "t3", late)
                line = live.next()
                assert "t3: success (labelled late)" in line["text"]

                code, said = live.end(signal.SIGINT)
                assert code == 0, said
                assert "elsewhere" in said
                assert "cannot be read" in said
                ended = live.next()
                assert (ended["episode"], ended["rates"]) == (None, line["rates"])
            assert [json.loads(data)["episode"] for data in heard][:3] == [None, "t2", "t2"]

            with following(path, endpoint) as live:  # started anew, it knows all of it
                resumed = live.next()
                assert resumed["rates"] == ended["rates"]
                assert resumed["gains"] == ended["gains"]
                code, said = live.end(signal.SIGTERM)
                assert code == 0, said


def begun_at(path: Path, name: str) -> int:
    from bridge.episode.catalogue import list_episodes

    return next(entry.start_ns for entry in list_episodes(RunFolder(path)) if entry.id == name)


def entry_record(name: str, *, run: str, **changes: Any) -> dict[str, Any]:
    """Return what a recorder says of a successful trial."""
    values = {"kind": "trial", "task": "cube_into_box", "policy": "scripted", "outcome": "success"}
    entry = Entry(file=f"{name}.mcap", id=name, **{**values, **changes})
    about = {"schema_version": 1, "recorder": "main", "run": run}
    return {**about, **json.loads(json.dumps(asdict(entry)))}


def sample_of(record: dict[str, Any]) -> WireSample:
    return WireSample(
        topic="/rec/main/episode",
        type_name=schema.ENTRY,
        message_encoding="json",
        data=json.dumps(record).encode(),
        source_ns=1,
        sequence=0,
        source_gid=b"g" * 16,
        received_ns=1,
    )


@pytest.fixture
def empty_run(tmp_path: Path) -> RunFolder:
    return RunFolder.create(tmp_path / "run")


@pytest.fixture
def make(empty_run: RunFolder) -> Callable[..., tuple[Follower, list[dict[str, Any]]]]:
    """Make a follower whose words are kept instead of being sent."""

    def build() -> tuple[Follower, list[dict[str, Any]]]:
        said: list[dict[str, Any]] = []
        follower = Follower(
            empty_run,
            lambda data: said.append(json.loads(data)),
            lambda: 5,
            goal=None,
            output=Output(quiet=True, json=True),
        )
        return follower, said

    return build


def test_news_of_this_run_count_at_once_and_what_is_no_news_is_left_out(
    make: Callable[..., tuple[Follower, list[dict[str, Any]]]],
    empty_run: RunFolder,
    capsys: pytest.CaptureFixture[str],
) -> None:
    follower, said = make()
    follower.begin()
    here = str(empty_run.path)
    told = [
        entry_record("t1", run=here, condition=WITH, start_ns=1),
        entry_record("t1", run=here, condition=WITH, start_ns=1),
        entry_record("t2", run="/another/run", condition=WITH, start_ns=2),
        entry_record("t3", run=here, condition=WITH, start_ns=3, outcome="unknown"),
        entry_record("scan", run=here, kind="scan", start_ns=4),
        {"id": "t4"},
    ]
    for record in told:
        follower.hear(sample_of(record))
    for _ in told:
        follower.step()
    assert [record["episode"] for record in said] == [None, "t1"]
    assert all(check_record(r, name="advice", package="bridge.episode") for r in said)
    lines = capsys.readouterr().out.splitlines()
    assert [json.loads(line)["episode"] for line in lines] == [None, "t1"]


def test_what_a_broken_program_publishes_is_no_news() -> None:
    good = entry_record("t1", run="/run")
    assert read_update(json.dumps(good).encode()) is not None
    for broken in (b"", b"[]", b"{", json.dumps({**good, "start_ns": "soon"}).encode()):
        assert read_update(broken) is None
    without_run = {name: value for name, value in good.items() if name != "run"}
    assert read_update(json.dumps(without_run).encode()) is None
