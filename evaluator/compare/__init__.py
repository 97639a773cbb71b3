"""Pair recorded and derived episodes, then let metrics and statistics speak.

``compare_run`` reads a run folder, ``compare_csv`` a table.
"""

from evaluator.compare.rows import Comparison, RateGroup, TrialRow
from evaluator.compare.run import compare_run
from evaluator.compare.several import compare_csv

__all__ = ["Comparison", "RateGroup", "TrialRow", "compare_csv", "compare_run"]
