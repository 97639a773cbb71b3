"""How far twin and reality disagree, and how sure we are.

An evaluation as DataFrames: ``evaluator.read_trials(RUN)``, ``read_groups``, ``read_measurements``.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from evaluator.frames import read_groups, read_measurements, read_trials

__all__ = ["read_groups", "read_measurements", "read_trials"]


def __getattr__(name: str) -> Any:
    """Load pandas only when somebody reads a DataFrame."""
    if name not in __all__:
        message = f"module 'evaluator' has no attribute {name!r}"
        raise AttributeError(message)
    from evaluator import frames  # noqa: PLC0415  # loads pandas

    return getattr(frames, name)
