"""Pair recorded and derived episodes, then let metrics and statistics speak.

``compare_run`` reads a run folder, ``compare_csv`` a trials CSV or a rates CSV.
"""

from evaluator.compare.rows import Comparison, RateGroup, TrialRow
from evaluator.compare.run import compare_run
from evaluator.compare.spreadsheet import compare_csv

__all__ = ["Comparison", "RateGroup", "TrialRow", "compare_csv", "compare_run"]
