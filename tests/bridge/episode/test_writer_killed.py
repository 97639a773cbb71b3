"""SIGKILL of a real writer at random instants: readable every time, and at most 0.5 s is gone."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from mcap_samples import linear, read_all, some_messages, write_ours

from bridge.episode.recover import recover, recover_parts
from bridge.episode.run_folder import RunFolder

CHILD = Path(__file__).with_name("writer_child.py")
MAX_TAIL_NS = 500_000_000
LIVES_S, CLOSES_AFTER_S = 3.0, 1.0
KILLS = int(os.environ.get("GST_KILLS", "5"))
"""`make soak` kills a hundred times, which takes four minutes."""


def start(*arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, str(CHILD), *map(str, arguments)], stdout=subprocess.PIPE, text=True
    )


def written_before_kill(child: subprocess.Popen[str], after_s: float | str) -> list[list[str]]:
    """Let the child live for so long after its first message, or until it says a word."""
    assert child.stdout is not None
    lines = [child.stdout.readline()]
    deadline = time.monotonic() + (after_s if isinstance(after_s, float) else 60.0)
    while time.monotonic() < deadline and lines[-1].strip() != after_s and lines[-1]:
        lines.append(child.stdout.readline())
    if after_s == "closing":
        time.sleep(random.Random(len(lines)).uniform(0, 0.02))
    child.send_signal(signal.SIGKILL)
    lines += child.stdout.readlines()
    child.wait()
    child.stdout.close()
    return [line.split() for line in lines if line.startswith("/")]


def check_one_kill(folder: Path, kind: str, after_s: float | str) -> None:
    run = RunFolder.create(folder)
    path = run.episodes_dir / "live.mcap"
    seconds = CLOSES_AFTER_S if after_s == "closing" else LIVES_S
    lines = written_before_kill(start("write", path, kind, seconds), after_s)
    reports = recover_parts(run)
    if path.exists() and not reports:  # killed after the rename
        found = read_all(path)
    else:
        (report,) = reports
        assert report.output == path
        found = read_all(path)
        assert report.messages == len(found)
    for topic in {line[0] for line in lines}:
        said = [(int(line[1]), int(line[2])) for line in lines if line[0] == topic]
        kept = [item for item in found if item.topic == topic]
        assert [item.sequence for item in kept] == [number for number, _ in said][: len(kept)] or (
            # The kill may fall between a write and its line.
            [item.sequence for item in kept[:-1]] == [number for number, _ in said]
        )
        first_ns, last_ns = said[0][1], said[-1][1]
        kept_ns = kept[-1].log_time if kept else first_ns
        assert last_ns - kept_ns <= MAX_TAIL_NS, (topic, after_s)


def test_a_killed_writer_leaves_all_but_the_last_half_second(tmp_path: Path) -> None:
    check_one_kill(tmp_path, "joints", 0.6)


@pytest.mark.slow
def test_kills_at_random_instants_cost_at_most_half_a_second_each(tmp_path: Path) -> None:
    """Two in five kills hit writing, one in five finalising, two in five a recovery."""
    rng = random.Random(3)
    for index in range(KILLS * 2 // 5):
        kind = ("joints", "mixed")[index % 2]
        check_one_kill(tmp_path / f"w{index}", kind, rng.uniform(0.01, 2.5))
    for index in range(KILLS // 5):
        check_one_kill(tmp_path / f"c{index}", "mixed", "closing")
    whole = write_ours(tmp_path / "whole.mcap", some_messages(30_000), chunk_bytes=1 << 18)
    data = whole.read_bytes()[: whole.stat().st_size * 9 // 10]
    (tmp_path / "cut.mcap").write_bytes(data)
    expected = len(linear(tmp_path / "cut.mcap"))
    for index in range(KILLS * 2 // 5):
        kill_a_recovery(tmp_path / f"r{index}", data, expected, rng.uniform(0, 0.3))


def kill_a_recovery(folder: Path, data: bytes, expected: int, after_s: float) -> None:
    folder.mkdir()
    part = folder / "a.mcap.part"
    part.write_bytes(data)
    child = start("recover", part)
    assert child.stdout is not None
    child.stdout.readline()
    time.sleep(after_s)
    child.send_signal(signal.SIGKILL)
    child.wait()
    child.stdout.close()
    if part.exists():
        recover(part)
    assert len(read_all(folder / "a.mcap")) >= expected
    assert os.listdir(folder) == ["a.mcap"]  # noqa: PTH208 - names only


@pytest.mark.slow
def test_reruns_checker_accepts_what_was_written_and_what_was_recovered(tmp_path: Path) -> None:
    rerun = Path(sys.executable).with_name("rerun")
    if not rerun.exists():
        pytest.skip("rerun is not installed")
    from bridge.episode import schema
    from bridge.episode.cdr.messages import string_to_cdr
    from bridge.episode.writer import EpisodeWriter, WriterConfig

    path = tmp_path / "whole.mcap"
    with EpisodeWriter(path, config=WriterConfig(chunk_bytes=4000)) as writer:
        for index in range(500):
            text = string_to_cdr(f"message {index}")
            writer.write("/text", text, type_name=schema.STRING, log_time_ns=index)
        writer.attach("a", b"b", media_type="", log_time_ns=0)
    part = tmp_path / "cut.mcap.part"
    part.write_bytes(path.read_bytes()[:-3000])
    recovered = recover(part).output
    assert recovered is not None
    for file in (path, recovered):
        done = subprocess.run(
            [rerun, "mcap", "check", "--full", file], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
