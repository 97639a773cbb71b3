"""A second process draws what this one would, and nothing is lost with it."""

import io
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from other_processes import check_an_interrupted_evaluation, ended_within, is_running

import robot_gst
from bridge import process_pool
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.writer import EpisodeWriter
from evaluator.compare import Comparison, compare_csv
from evaluator.report.figures import beside as module
from evaluator.report.figures.beside import MIN_FILES, Beside, beside
from evaluator.report.figures.drawing import Rendered
from evaluator.report.figures.selection import drawable, drawings_of
from evaluator.report.write import write_report

ROOT = Path(__file__).resolve().parents[3]
PAPER = ROOT / "docs" / "examples" / "paper_table_rates.csv"


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    return compare_csv(PAPER)


@pytest.fixture(scope="module")
def in_process(comparison: Comparison, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("in_process")
    write_report(comparison, folder)
    return folder


@pytest.fixture
def second() -> Iterator[Beside]:
    process = Beside()
    yield process
    process.close()


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
def test_a_report_is_the_same_with_a_second_process(
    comparison: Comparison,
    in_process: Path,
    second: Beside,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "evaluator.report.figures.render", None)  # none drawn here
    written = write_report(comparison, tmp_path, second)
    assert written.not_written is None
    assert contents(tmp_path) == contents(in_process)
    assert any(name.endswith(".pdf") for name in contents(tmp_path))
    assert second.process.returncode is not None


@pytest.mark.slow
@pytest.mark.parametrize("after_sending", [False, True])
@pytest.mark.usefixtures("unchecked")
def test_a_killed_process_takes_nothing_of_the_report_with_it(
    comparison: Comparison, in_process: Path, second: Beside, tmp_path: Path, after_sending: bool
) -> None:
    if after_sending:
        second.send(drawable(comparison))
    second.process.kill()
    second.process.wait()
    write_report(comparison, tmp_path, second)
    assert contents(tmp_path) == contents(in_process)


def test_half_an_answer_is_none(comparison: Comparison, second: Beside) -> None:
    second.close()
    drawn = drawings_of(drawable(comparison))[0]
    loaded = process_pool._packed(None)
    data = loaded + process_pool._packed({item.id: (b"svg", b"pdf", "inline") for item in drawn})

    def take(heard: bytes) -> list[Rendered] | None:
        outlet, inlet = os.pipe()
        os.write(inlet, heard)
        os.close(inlet)
        with io.FileIO(outlet) as second.outlet:
            return second.take(drawn)

    for length in (0, 1, len(loaded), (len(loaded) + len(data)) // 2, len(data) - 1):
        assert take(data[:length]) is None
    found = take(data)
    assert found is not None
    assert [item.drawing for item in found] == drawn


def test_a_process_that_hangs_is_not_waited_for(
    comparison: Comparison, second: Beside, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_WAIT_S", 0.1)
    second.process.send_signal(signal.SIGSTOP)
    assert second.take(drawings_of(drawable(comparison))[0]) is None
    assert second.process.returncode == -signal.SIGKILL


def test_the_process_ends_with_its_object_and_with_the_program() -> None:
    process = Beside()
    pid = process.process.pid
    assert is_running(pid)
    del process
    assert not is_running(pid)
    code = (
        "import os, signal; from evaluator.report.figures.beside import Beside; "
        "second = Beside(); print(second.process.pid, flush=True); "
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert done.returncode == -signal.SIGKILL
    assert ended_within(int(done.stdout), 10.0)


INTERRUPTED = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where tests run in a background
import robot_gst
import evaluator.compare
from evaluator.report.figures import beside

class Told(beside.Beside):
    def __init__(self):
        super().__init__()
        print(self.process.pid, flush=True)

def compare_run(*_, **__):
    print("comparing", flush=True)
    time.sleep(20)

beside.MIN_FILES, beside.Beside, evaluator.compare.compare_run = 0, Told, compare_run
sys.exit(robot_gst.run(["evaluate", sys.argv[1]]))
"""


def make_run(path: Path) -> None:
    """A run with one scan and nothing else."""
    for name in ("episodes", "derived"):
        (path / name).mkdir()
    with EpisodeWriter(path / "episodes" / "scan.mcap") as writer:
        writer.describe(EpisodeInfo(id="scan", kind="scan"))


def test_an_interrupt_reaches_both_and_neither_leaves_a_trace(tmp_path: Path) -> None:
    make_run(tmp_path)
    check_an_interrupted_evaluation(INTERRUPTED, tmp_path, "comparing")


def test_an_evaluation_that_fails_leaves_no_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    started: list[int] = []

    class Watched(Beside):
        def __init__(self) -> None:
            super().__init__()
            started.append(self.process.pid)

    monkeypatch.setattr(module, "MIN_FILES", 0)
    monkeypatch.setattr(module, "Beside", Watched)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    make_run(tmp_path)
    blocked = tmp_path / "blocked"
    blocked.write_text("a file, not a folder")
    assert robot_gst.run(["evaluate", str(tmp_path), "--out", str(blocked)]) == 1
    assert "cannot write" in capsys.readouterr().err
    assert len(started) == 1
    assert not is_running(started[0])


def test_only_a_large_run_gets_a_second_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[bool] = []
    monkeypatch.setattr(module, "Beside", lambda: started.append(True))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    for name in ("episodes", "derived"):
        (tmp_path / name).mkdir()
    for number in range(MIN_FILES - 1):
        (tmp_path / "derived" / f"{number}.mcap").touch()
    beside(tmp_path)
    beside(PAPER)
    beside(None)
    assert not started
    (tmp_path / "episodes" / "one.mcap").touch()
    beside(tmp_path)
    assert started == [True]
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    beside(tmp_path)
    assert started == [True]


def test_without_a_further_process_it_goes_on_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused() -> Beside:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(module, "Beside", refused)
    monkeypatch.setattr(module, "MIN_FILES", 0)
    for name in ("episodes", "derived"):
        (tmp_path / name).mkdir()
    assert beside(tmp_path) is None
