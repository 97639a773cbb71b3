"""How far twin and reality disagree, and how sure we are.

An evaluation as DataFrames: ``evaluator.read_trials(RUN)``, ``read_groups``, ``read_measurements``.
"""

from importlib import import_module
from typing import Any

_FRAMES = ("read_groups", "read_measurements", "read_trials")


def __getattr__(name: str) -> Any:
    """Load pandas only when somebody reads a DataFrame."""
    if name not in _FRAMES:
        message = f"module 'evaluator' has no attribute {name!r}"
        raise AttributeError(message)
    # by name: the package itself stands below all its modules
    return getattr(import_module("evaluator.frames"), name)
