"""Code in a Python process of its own, in which nothing is loaded yet."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PLAYED = ROOT / "tests/played.py"
PACKAGES = ("bridge", "twin", "evaluator", "dashboards")
DEADLINE_S = 200.0
"""Below the time after which pytest ends itself, which would leave the process behind."""


def printed(code: str, *arguments: str, folder: Path = ROOT) -> str:
    """Run code and return what it printed, without blanks around it; it must end well."""
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        cwd=folder,
        timeout=DEADLINE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def imports_from(folder: Path) -> str:
    """A ``sitecustomize`` that makes our packages' names mean those of a folder."""
    return "\n".join(
        (
            "import sys",
            "from importlib.machinery import PathFinder",
            "class Finder:",
            "    @staticmethod",
            "    def find_spec(name, path=None, target=None):",
            f"        if name in {(*PACKAGES, 'robot_gst')!r}:",
            f"            return PathFinder.find_spec(name, [{str(folder)!r}])",
            "sys.meta_path.insert(0, Finder)",
            "",
        )
    )


def begun(*arguments: str, **options: Any) -> "subprocess.Popen[str]":
    """A process of Python that finds our packages, and whose words can be read."""
    return subprocess.Popen(
        [sys.executable, *arguments],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        text=True,
        **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options},
    )
