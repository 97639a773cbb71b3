"""Printed numbers keep their count, their interval, and their smallness."""

from bridge.task.verdict import Factor, Verdict
from dashboards import wording
from evaluator.report.page import breakable
from evaluator.result import Interval, Measurement

WILSON = Interval(low=0.208, high=0.939, level=0.95, method="wilson")


def measurement(**fields: object) -> Measurement:
    known = {"id": "a.b", "value": 2 / 3, "unit": "1", "definition": "d"}
    return Measurement(**{**known, **fields})


def plain(text: str) -> str:
    return text.replace("\u00a0", " ")


def test_a_length_keeps_its_unit_on_its_line() -> None:
    assert wording.length_text(0.0123) == "12.30\u00a0mm"
    assert wording.length_text(None) == "missing"


def test_a_chance_of_success_is_counts_and_whole_percentages() -> None:
    said = {"value": 1.0, "low": 0.5101091635454027, "high": 1.0, "k": 4, "n": 4}
    assert plain(wording.success_share(said)) == "4 of 4 varied replays succeed: 100 %, 51 to 100 %"


def test_a_verdict_in_rerun_says_what_its_varied_replays_show() -> None:
    yes, p = Factor(value=True), {"value": 1.0, "low": 0.51, "high": 1.0, "k": 4, "n": 4}
    kept = {"accepted": [True] * 4, "cause": [""] * 4, "missed_m": [None] * 4, "drawn": {}}
    verdict = Verdict(
        plan_id="plan",
        trajectory="planned",
        mode="dynamic",
        ik=yes,
        clearance=yes,
        terminal=yes,
        engine="pybullet",
        seed=0,
        p_success=p,
        samples=kept,
    )
    shown = plain(wording.verdict_text(verdict))
    told = (
        "4 of 4 varied replays succeed: 100 %, 51 to 100 %; all succeed, so none shows what decides"
    )
    assert shown == f"✓ accepted: plan, planned, dynamic, pybullet; {told}"


def test_a_name_breaks_at_its_joints_and_a_number_never() -> None:
    shown = breakable("gripper_left_finger is 7.4 mm inside, 6/10 [-84, 2.12]")
    assert shown == "gripper_<wbr>left_<wbr>finger is 7.4 mm inside, 6/10 [-84, 2.12]"


def test_a_number_has_its_count_its_interval_and_the_method() -> None:
    rate = measurement(k=2, n=3, counted="trial", interval=WILSON)
    assert plain(wording.measured(rate)) == "66.7 %"
    assert plain(wording.evidence(rate)) == "2/3 trials, [20.8, 93.9] (95 % Wilson)"


def test_undefined_says_why() -> None:
    undefined = measurement(value=None, reason_if_undefined="2 groups; it needs at least 3")
    assert wording.measured(undefined) == "undefined"
    assert wording.evidence(undefined) == "2 groups; it needs at least 3"


def test_a_number_without_interval_says_why() -> None:
    bare = measurement(n=4, counted="pair of runs", reason_without_interval="not estimated")
    assert wording.evidence(bare) == "4 pairs of runs, no interval: not estimated"


def test_outcomes_have_a_sign_and_a_word() -> None:
    shown = {wording.outcome_word(value) for value in (True, False, None)}
    assert shown == {"✓ success", "✗ failure", "? unknown"}
