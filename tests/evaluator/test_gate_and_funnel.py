"""The gate's worth and the stage funnel."""

import pytest

from evaluator.compare.stages import funnel
from evaluator.errors import UndefinedStatisticError
from evaluator.statistics.gate import Confusion, kappa


def table(tp: int, fp: int, fn: int, tn: int) -> Confusion:
    return Confusion(true_positive=tp, false_positive=fp, false_negative=fn, true_negative=tn)


def test_kappa_by_hand_and_undefined() -> None:
    # Cohen's example form: 20 yes-yes, 5, 10, 15: agreement 0.7, chance 0.5, kappa 0.4.
    assert kappa(table(20, 5, 10, 15)) == pytest.approx(0.4)
    with pytest.raises(UndefinedStatisticError, match="both sides are the same"):
        kappa(table(4, 0, 0, 0))
    assert kappa(table(2, 2, 0, 0)) == 0


def test_a_stage_after_a_failed_one_is_not_reached() -> None:
    trials = [[True, True, True], [True, False, True], [False, True, True], [True, None, True]]
    stages = funnel(trials, ["pick", "carry", "release"])
    assert [(s.reached, s.passed, s.unknown) for s in stages] == [(4, 3, 0), (3, 1, 1), (1, 1, 0)]
