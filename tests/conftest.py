"""Settings for all tests."""

import gc
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent))

import compiled
import lean_checks

if TYPE_CHECKING:
    from bridge.episode.run_folder import RunFolder
    from bridge.wire.session import WireSession

lean_checks.install()  # before any room is imported
gc.disable()  # until all is imported

# Time limits of single examples say more about the machine's other work than about the code.
settings.register_profile("robot-gst", deadline=None)
settings.load_profile("robot-gst")

# Workers side by side share the cores; nested threads would only get in each other's way.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

LONG_FILES = (
    "test_demo.py",
    "test_real_input.py",
    "test_killed_recorders.py",
    "test_endurance.py",
    "test_reconstruct.py",
    "test_report_in_a_browser.py",
    "test_stopped_and_shared.py",
    "test_harnesses.py",
    "test_writer_killed.py",
    "test_standin_session.py",
)
"""Files of about twenty seconds or more. Workers take whole files in this order: one that came
last would leave the other worker idle."""


@pytest.fixture
def run(tmp_path: Path) -> "RunFolder":
    from bridge.episode.run_folder import RunFolder

    return RunFolder.create(tmp_path / "run")


@pytest.fixture
def endpoint() -> str:
    from loopback import free_endpoint

    return free_endpoint()


@pytest.fixture
def router(endpoint: str) -> Iterator["WireSession"]:
    """A session to which others connect, over real TCP on the loopback address."""
    from bridge.wire.config import WireConfig
    from bridge.wire.session import open_session

    with open_session(WireConfig(mode="router", connect=(), listen=(endpoint,))) as session:
        yield session


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Leave the checks of shapes in calls out of a long test."""
    with lean_checks.unchecked():
        yield


def pytest_runtest_setup() -> None:
    """Count calls of each test on their own."""
    lean_checks.begin_test()


def pytest_sessionstart(session: pytest.Session) -> None:
    """Share the work of compiling with the other workers."""
    worker = getattr(session.config, "workerinput", None)
    if worker is not None and not sys.dont_write_bytecode:
        count = worker["workercount"]
        compiled.compile_share(session.config, int(worker["workerid"][2:]) % count, count)


def pytest_collection_finish() -> None:
    """Keep all that was imported out of the search for garbage, which took a tenth of the time."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files."""
    order = {name: place for place, name in enumerate(LONG_FILES)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))
