"""``report.html`` in a real browser: nothing from outside, no complaint, readable by everyone."""

import os
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from headless import ACCESSIBLE
from own_process import printed

from bridge.episode.run_folder import RunFolder

CHECKS = (ACCESSIBLE.read_text(), Path(__file__).with_name("checks.js").read_text())
pytestmark = pytest.mark.slow


WHOLE = """
import sys, robot_gst
code = robot_gst.run(["evaluate", sys.argv[1], "--out", sys.argv[2], "--quiet"])
heavy = ("twin", "torch", "open3d", "mujoco", "pybullet", "zenoh")
print(code, [name for name in heavy if name in sys.modules])
"""


class Evaluated(NamedTuple):
    """The command in a process of its own: what it said in the end, and its page."""

    said: str
    report: Path


@pytest.fixture(scope="module")
def evaluated(
    evaluation_run_once: RunFolder, tmp_path_factory: pytest.TempPathFactory
) -> Evaluated:
    folder = tmp_path_factory.mktemp("report")
    said = printed(WHOLE, str(evaluation_run_once.path), str(folder))
    return Evaluated(said, folder / "report.html")


@pytest.fixture(scope="module")
def report(evaluated: Evaluated) -> Path:
    return evaluated.report


def test_a_whole_evaluation_loads_neither_the_twin_nor_torch(evaluated: Evaluated) -> None:
    assert evaluated.said.endswith("0 []")


def faults(browser: Any) -> list[str]:
    """What keeps somebody from reading the page."""
    return [fault for check in CHECKS for fault in browser.ask(check)]


def keep(browser: Any, name: str) -> None:
    """Keep a picture where GST_PICTURES says, for a person to look at."""
    if folder := os.environ.get("GST_PICTURES"):
        (Path(folder) / f"{name}.png").write_bytes(browser.picture())


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("dark", [False, True])
def test_the_report_asks_for_nothing_complains_of_nothing_and_can_be_read(
    browser: Any, report: Path, width: int, dark: bool
) -> None:
    browser.show(report.as_uri(), width=width, dark=dark)
    keep(browser, f"report_{width}_{'dark' if dark else 'light'}")
    asked = [url for url in browser.asked if not url.startswith("data:image/png;base64,")]
    assert asked == [report.as_uri()]
    assert browser.ask("document.documentElement.scrollWidth") <= width
    assert faults(browser) == []
    browser.ask("document.querySelectorAll('details').forEach((part) => { part.open = true })")
    assert browser.ask("document.documentElement.scrollWidth") <= width
    assert faults(browser) == []
    assert browser.complaints == []
