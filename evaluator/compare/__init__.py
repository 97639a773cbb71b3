"""Pair recorded and derived episodes, then let metrics and statistics speak.

``compare_run`` reads a run folder, ``compare_trials`` a trials CSV, ``compare_rates`` a rates CSV.
"""

from evaluator.compare.rows import Comparison, TcpErrorSeries, TrialRow
from evaluator.compare.run import compare_run

__all__ = ["Comparison", "TcpErrorSeries", "TrialRow", "compare_run"]
