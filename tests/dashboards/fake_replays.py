"""Replays for tests of what-if: done by another process, without physics."""

import os
import time
from pathlib import Path
from typing import Any

from dashboards.what_if import Question
from twin.replay.config import ChangeConfig

LIMIT_M = -0.0063


def by_shift(asked: tuple[Question, ChangeConfig]) -> dict[str, Any]:
    """Say yes unless the object is too far along -x, or the grip is weak; undecided at 0.25."""
    _, change = asked
    accepted: bool | None = change.x_m > LIMIT_M and change.grip_force > 0.6
    if change.friction < 0.3:
        accepted = None
    why = None if accepted else "the cube is missed"
    return {"accepted": accepted, "reason": why, "error": None, "file": f"{change.x_m}.mcap"}


def never(asked: tuple[Question, ChangeConfig]) -> dict[str, Any]:
    """Note the process, and go on until somebody ends it."""
    question, _ = asked
    waiting = question.run_path / "pid.part"
    waiting.write_text(str(os.getpid()))
    waiting.rename(Path(question.run_path) / "pid")
    while True:
        time.sleep(3600)
