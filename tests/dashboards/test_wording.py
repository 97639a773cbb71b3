"""Printed numbers keep their count, their interval, and their smallness."""

import pytest

from dashboards import wording
from evaluator.result import Interval, Measurement

WILSON = Interval(low=0.208, high=0.939, level=0.95, method="wilson")


def measurement(**fields: object) -> Measurement:
    known = {"id": "a.b", "value": 2 / 3, "unit": "1", "definition": "d"}
    return Measurement(**{**known, **fields})


def plain(text: str) -> str:
    return text.replace("\u00a0", " ")


@pytest.mark.parametrize(
    ("value", "unit", "expected"),
    [
        (0.0123, "m", "12.3 mm"),
        (1.2e-5, "m", "0.01 mm"),
        (0.0, "m", "0.0 mm"),
        (24.666, "pp", "+25 pp"),
        (-3.2, "pp", "−3 pp"),
        (0.8, "fraction", "80 %"),
        (31.774, "dB", "31.77 dB"),
        (0.00004, "1", "4e−05"),
        (7.0, "count", "7"),
        (1.5, "N", "1.5 N"),
    ],
)
def test_a_value_is_printed_in_its_unit(value: float, unit: str, expected: str) -> None:
    assert plain(wording.number(value, unit)) == expected


def test_a_chance_of_success_is_counts_and_whole_percentages() -> None:
    said = {"value": 1.0, "low": 0.5101091635454027, "high": 1.0, "k": 4, "n": 4}
    assert plain(wording.success_share(said)) == "4 of 4 varied replays succeed, 51 to 100 %"


def test_a_rate_in_large_is_its_count_and_below_stands_its_interval() -> None:
    rate = measurement(k=2, n=3, counted="trial", interval=WILSON)
    assert wording.headline(rate) == "2 of 3"
    below = plain(wording.headline_evidence(rate))
    assert below == "67 % of trials, 21 to 94 % (95 % Wilson)"
    assert plain(wording.short_evidence(rate)) == "2/3, 21 to 94 %"


def test_undefined_says_why_and_absent_says_missing() -> None:
    undefined = measurement(value=None, reason_if_undefined="2 groups; it needs at least 3")
    assert wording.measured(undefined) == "undefined"
    assert wording.evidence(undefined) == "2 groups; it needs at least 3"
    assert wording.measured(None) == "missing"


def test_a_number_without_interval_says_why() -> None:
    bare = measurement(n=4, counted="pair of runs", reason_without_interval="not estimated")
    assert wording.evidence(bare) == "n = 4 pairs of runs, no interval: not estimated"


def test_outcomes_have_a_sign_and_a_word() -> None:
    shown = {wording.outcome_word(value) for value in (True, False, None)}
    assert shown == {"✓ success", "✗ failure", "? unknown"}
