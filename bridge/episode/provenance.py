"""Where a result came from: content hashes, code version, settings."""

import hashlib
import json
import subprocess
from collections.abc import Iterable
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

_PIECE_BYTES = 1 << 18


def hash_file(path: Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal."""
    return hash_files([path])


def hash_files(paths: Iterable[Path]) -> str:
    """SHA-256 of the bytes of files, one after the other, in hexadecimal."""
    digest = hashlib.sha256()
    for path in paths:
        with path.open("rb") as stream:
            while piece := stream.read(_PIECE_BYTES):
                digest.update(piece)
    return digest.hexdigest()


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


@cache
def _git_commit() -> str:
    # Asked once: a process goes on running the code it started with.
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
