"""Where a result came from: content hashes, code version, settings."""

import hashlib
import json
import subprocess
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any


def hash_file(path: Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def hash_settings(settings: dict[str, Any]) -> str:
    """Eight hexadecimal digits that change when any setting does."""
    text = json.dumps(settings, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


@cache
def software() -> dict[str, str]:
    """Version of this package and, in a checkout, its git commit."""
    try:
        version = metadata.version("robot-gst")
    except metadata.PackageNotFoundError:
        version = "not installed"
    return {"name": "robot-gst", "version": version, "git_commit": _git_commit()}


def _git_commit() -> str:
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return ""
    try:
        done = subprocess.run(
            ["git", "-C", str(root), "rev-parse", "HEAD"],
            capture_output=True,
            text=True,
            timeout=5,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip()
