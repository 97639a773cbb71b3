"""Which candidate is better: what is a pair, who may be best, and that advice may be followed."""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from bridge.errors import UsageError
from evaluator.compare import Comparison, compare_csv
from evaluator.compare.beside import MEASURES
from evaluator.compare.from_rows import compare_rows
from evaluator.compare.policies import (
    Answer,
    Course,
    compare_counts,
    compare_policies,
    comparison_part,
    made_trials,
    notes_of_trials,
    tries_of,
)
from evaluator.compare.regret import regret_results
from evaluator.compare.rows import TrialRow
from evaluator.compare.success import rate_groups, side_rates
from evaluator.report.front import front
from evaluator.result import Measurement, Results
from evaluator.statistics.sequential import Plan


def row(number: int, policy: str, success: bool | None, **more: object) -> TrialRow:
    values: dict[str, object] = {
        "episode": f"t{number}",
        "task": "cup",
        "condition": "",
        "policy": policy,
        "start_id": None,
        "cell": "",
        "stand_in": None,
        "recorded": success,
    }
    return TrialRow(**{**values, **more})  # type: ignore[arg-type]


def interleaved(outcomes: Mapping[str, Sequence[bool]], *, starts: bool = True) -> list[TrialRow]:
    count = max(map(len, outcomes.values()))
    return [
        row(100 * place + side, policy, bool(made[place]), start_id=f"s{place}" if starts else None)
        for place in range(count)
        for side, (policy, made) in enumerate(outcomes.items())
        if place < len(made)
    ]


def only(answers: Sequence[Answer]) -> Answer:
    assert len(answers) == 1
    return answers[0]


CLEAR = {"A": [True, False, False, False] * 10, "B": [True, True, True, False] * 10}


@pytest.mark.parametrize("starts", [True, False])
def test_the_better_one_is_named_with_its_counts_and_the_look(starts: bool) -> None:
    answer = only(compare_policies(interleaved(CLEAR, starts=starts)))
    assert answer.counts == ((10, 40), (30, 40))
    assert answer.sentence.startswith("B is better than A: 30 of 40 against 10 of 40, +50 points [")
    assert answer.sentence.endswith("stop here")
    assert answer.reading.decided is not None
    assert answer.reading.decided.pairs in (5, 10, 15, 20, 30, 40)
    assert answer.reading.evidence.strata[0].pairs == (40 if starts else 0)
    turned = only(compare_policies(interleaved(dict(reversed(CLEAR.items())), starts=starts)))
    assert turned.sentence == answer.sentence


def test_what_was_decided_at_a_look_does_not_hang_on_what_came_later() -> None:
    """The limit was reached at a look; later trials change the interval and not the winner."""
    rows = interleaved({"A": [False] * 20 + [True] * 8, "B": [True] * 20 + [False] * 8})
    answer = only(compare_policies(rows))
    assert answer.reading.better == 1
    assert answer.reading.decided is not None
    assert answer.reading.decided.pairs <= 20


def test_a_trial_without_an_outcome_is_a_failure_unless_its_cause_is_void() -> None:
    rows = interleaved(CLEAR)
    stopped = [
        row(9000 + place, "B", None, start_id=f"x{place}", why_unknown="protective stop")
        for place in range(10)
    ]
    answer = only(compare_policies([*rows, *stopped]))
    assert answer.counts[1] == (30, 50)
    assert answer.no_outcome == (0, 10)
    assert answer.without_these == pytest.approx(0.5)
    void = only(compare_policies([*rows, *stopped], void_causes=("protective stop",)))
    assert void.counts[1] == (30, 40)


def test_starts_that_were_localised_apart_or_overlap_in_part_are_not_pairs() -> None:
    rows = interleaved({"A": [True] * 6, "B": [False] * 4})
    (stratum,) = only(compare_policies(rows)).reading.evidence.strata
    assert (stratum.pairs, stratum.first, stratum.second) == (4, (2, 2), (0, 0))
    moved = [
        row(7, policy, True, start_id="s", start_positions_m={"cup": (x, 0.0, 0.0)})
        for policy, x in (("A", 0.4), ("B", 0.45))
    ]
    assert only(compare_policies(moved)).reading.evidence.strata[0].pairs == 0
    again = [*interleaved({"A": [True], "B": [True]}), row(5, "A", True, start_id="s0")]
    assert only(compare_policies(again)).reading.evidence.strata[0].first == (1, 1)


def test_of_several_whoever_is_not_shown_to_be_worse_may_be_best() -> None:
    rows = interleaved({**CLEAR, "C": [True, True, False, True] * 10})
    part = comparison_part(compare_policies(rows))
    standing = next(table for table in part.tables if table.id == "standing")
    found = {line[0]: line[3] for line in standing.rows}
    assert found == {"A": "no", "B": "yes", "C": "yes"}


def test_advice_may_be_followed_and_equal_candidates_still_get_hardly_a_winner() -> None:
    """Ten looks, each after as many more trials as the one before advised."""
    rng = np.random.default_rng(11)
    winners, studies = 0, 60
    for _ in range(studies):
        outcomes = {"A": list(rng.random(200) < 0.5), "B": list(rng.random(200) < 0.5)}
        size = 10
        for _ in range(10):
            rows = interleaved({name: made[:size] for name, made in outcomes.items()}, starts=False)
            reading = only(compare_policies(rows)).reading
            if reading.better or reading.more is None or size + reading.more > 150:
                winners += bool(reading.better)
                break
            size += reading.more
    assert winners <= 0.05 * studies + 2 * np.sqrt(0.05 * 0.95 * studies)


def test_tasks_tried_one_after_the_other_let_none_win_by_the_first() -> None:
    """Alike over both tasks, one better at the first and the other at the second."""
    rng = np.random.default_rng(3)
    winners = 0
    for _ in range(60):
        rows = [
            row(1000 * task + n, "AB"[n % 2], bool(rng.random() < (0.9, 0.1)[(n + task) % 2]))
            for task in range(2)
            for n in range(60)
        ]
        tasks = [replace(each, task=f"t{place // 60}") for place, each in enumerate(rows)]
        winners += any(a.reading.better for a in compare_policies(tasks) if not a.task)
    assert winners <= 6  # 5 % of 60 and two standard errors; in the order of tasks 60


def test_pairs_grow_as_they_are_counted() -> None:
    rng = np.random.default_rng(2)
    rows = [
        row(n, "AB"[n % 2], True, start_id=f"s{rng.integers(0, 12)}", task=f"t{rng.integers(0, 2)}")
        for n in range(60)
    ]
    answers = compare_policies(rows)
    course = Course.of(tries_of(made_trials(rows, ()), answers[0].question), Plan(pairs=4))
    assert course.all_.pairs == answers[0].reading.evidence.pairs
    places = [place for place in islice(Plan(pairs=4).places(), 12) if place <= course.all_.pairs]
    assert list(course.at) == places
    for place, evidence in course.at.items():  # each look has the first trials that are worth it
        assert place <= evidence.pairs < place + 2


def measurements(rates: dict[str, tuple[int, int]]) -> dict[str, Measurement]:
    """Ten trials each: successes as recorded, and of the twin."""
    rows = [
        row(n, policy, n < recorded, sim_planned=n < sim, start_id=f"{policy}{n}")
        for policy, (recorded, sim) in rates.items()
        for n in range(10)
    ]
    return {each.id: each for each in regret_results(rate_groups(rows, side_rates(rows)))}


def test_regret_is_what_taking_the_twins_first_costs() -> None:
    found = measurements({"A": (9, 5), "B": (6, 8), "C": (2, 1)})
    regret = found["decision.regret_pp"]
    assert regret.value == pytest.approx(30)
    assert "(B)" in regret.definition
    assert regret.interval is not None
    assert regret.interval.low <= 30 <= regret.interval.high
    assert found["decision.wrong_pairs"].value == pytest.approx(1 / 3)
    assert found["decision.wrong_pairs_pp"].value == pytest.approx(30)
    right = measurements({"A (v2)": (9, 9), "B": (6, 7)})
    assert right["decision.regret_pp"].value == 0
    assert right["decision.wrong_pairs_pp"].value is None
    assert measurements({"A": (9, 9)}) == {}
    both = "The twin and the recorded rates both rank A (v2) first"
    for pp, told in ((0.0, both), (0.3, "The twin ranks A (v2) first; its recorded rate is 0")):
        measured = (replace(right["decision.regret_pp"], value=pp),)
        found = Results(run="r", source="trials", stand_in=None, measurements=measured)
        assert any(told in text for _, text in front(found).answers)


def test_rates_with_n_are_compared_without_their_trials() -> None:
    rows = interleaved(CLEAR, starts=False)
    answer = only(compare_counts(rate_groups(rows, side_rates(rows))))
    assert answer.counts == ((10, 40), (30, 40))
    assert answer.reading.better == 1


def test_a_policy_that_trips_the_arm_does_not_gain_by_it(tmp_path: Path) -> None:
    """Of 20 trials of B 6 ended by a protective stop: as failures, and without them."""
    lines = ["trial_id,task,policy,start_id,outcome"]
    for n in range(20):
        lines.append(f"a{n},cup,A,s{n},{'success' if n < 12 else 'failure'}")
        lines.append(f"b{n},cup,B,s{n},{'success' if n < 12 else 'protective stop'}")
    lines[-1] = "b19,cup,B,s19,failure"
    path = tmp_path / "trials.csv"
    path.write_text("\n".join(lines) + "\n")
    found = compare_csv(path)
    (answer,) = compare_policies(found.rows)
    assert answer.counts == ((12, 20), (12, 20))
    assert answer.no_outcome == (0, 7)
    assert "+0 points" in answer.sentence
    assert "(7 without an outcome as failures; +0 without them)" in answer.sentence
    notes = {
        str(about): str(text) for t in found.tables if t.id == "notes" for about, text in t.rows
    }
    assert notes["B"].startswith("7 of 20 trials have no outcome (protective stop): 12 of 20")
    assert "12 of 13 without them, as in its rate" in notes["B"]
    declared = compare_policies(found.rows, void_causes=("protective stop",))
    assert declared[0].counts == ((12, 20), (12, 13))


def test_a_start_that_was_tried_again_is_named() -> None:
    rows = interleaved(CLEAR)
    again = [*rows, replace(rows[1], episode="again"), replace(rows[0], episode="once more")]
    assert [about for about, _ in notes_of_trials(again, ())] == ["A", "B"]
    assert all("s0 2 times" in text for _, text in notes_of_trials(again, ()))
    assert notes_of_trials(rows, ()) == []
    (answer,) = compare_policies(again)
    assert answer.reading.evidence.strata[0].pairs == 40


def test_a_checkpoint_that_changed_under_one_name_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "trials.csv"
    lines = ["trial_id,task,policy,checkpoint,outcome", "1,cup,ACT,a1,yes", "2,cup,ACT,a1,no"]
    path.write_text("\n".join(lines) + "\n")
    assert [row.policy for row in compare_csv(path).rows] == ["ACT", "ACT"]
    path.write_text("\n".join([*lines, "3,cup,ACT,b2,yes"]) + "\n")
    message = r"row 4: policy 'ACT' is checkpoint 'b2', in .*trials.csv row 2 'a1'. Give each"
    with pytest.raises(UsageError, match=message):
        compare_csv(path)


@pytest.mark.parametrize(
    ("first", "second", "words"),
    [
        ("a1", "b2", "policy 'A' is checkpoint 'b2', in .* 'a1'"),
        ("a1 map=07", "a1 map=08", "policy 'A' is map '08', in .* '07'"),
        ("server=0a map=07", "server=0b map=07", "policy 'A' is server '0b', in .* '0a'"),
        ("a1", "code=m:f map=07", ""),  # nothing that both say differs
        ("a1", "", ""),
    ],
)
def test_who_acted_may_not_change_under_one_name(first: str, second: str, words: str) -> None:
    rows = interleaved(CLEAR)
    mine = [row for row in rows if row.policy == "A"]
    rows = [*rows, replace(mine[0], episode="before", checkpoint=first)]
    rows.append(replace(mine[1], episode="after", checkpoint=second))
    with nullcontext() if not words else pytest.raises(UsageError, match=f"after: {words}"):
        compare_rows(rows, run="r", source="table", stand_in=None)
    rows[-1] = replace(rows[-1], policy="B")
    compare_rows(rows, run="r", source="table", stand_in=None)


@pytest.fixture
def four_policies(tmp_path: Path) -> Comparison:
    """Rates of four policies in three tasks; p3 is best in each."""
    lines = ["task,policy,side,k,n"]
    for task in ("cup", "hook", "drawer"):
        for policy, real in (("p0", 4), ("p1", 10), ("p2", 11), ("p3", 19)):
            lines += [f"{task},{policy},real,{real},20", f"{task},{policy},sim,{real + 1},20"]
    path = tmp_path / "rates.csv"
    path.write_text("\n".join(lines) + "\n")
    return compare_csv(path)


def test_rates_are_compared_in_each_task_and_intervals_say_what_was_decided(
    four_policies: Comparison,
) -> None:
    answers = compare_counts(four_policies.groups)
    assert len(answers) == 6 * (1 + 3)
    for answer in answers:
        interval = answer.reading.interval
        assert interval is not None
        assert (interval.low > 0 or interval.high < 0) == bool(answer.reading.better)
    first = front(four_policies.results())  # no other is worth a trial
    assert first.next_step == "take p3; no more trials are needed to choose."
    assert not first.commands


def test_the_first_page_begins_with_who_may_be_best(four_policies: Comparison) -> None:
    summary = " ".join(map(": ".join, front(four_policies.results()).answers))
    assert "p3 (57 of 60) is the best of 4 candidates: it is better than each" in summary
    assert "undecided" not in summary.lower()  # between p1 and p2, which nobody would take


@pytest.mark.parametrize(("k", "words"), [(0, "nothing succeeded, 0 of 20"), (10, "everything")])
def test_a_study_where_all_trials_end_alike_says_so_first(k: int, words: str) -> None:
    rows = [row(n, "AB"[n % 2], n // 2 < k, start_id=f"s{n // 2}") for n in range(20)]
    found = compare_rows(rows, run="r", source="trials", stand_in=None)
    summary = dict(front(found.results()).answers)["Which is better"]
    assert summary.startswith(f"Cannot be told: {words}")
    assert "you lose" not in summary


def test_a_study_without_a_twin_says_nothing_of_a_twin() -> None:
    found = compare_rows(interleaved(CLEAR), run="r", source="trials", stand_in=None)
    assert not [m.id for m in found.measurements if m.id.startswith("agreement.")]
    assert not {"confusion", "conclusions"} & {table.id for table in found.tables}
    (success,) = [table for table in found.tables if table.id == "success"]
    assert {row[3] for row in success.rows} == {"recorded"}
    assert front(found.results()).answers[0][1].startswith("B is better than A: 30 of 40")


def with_measures(count: int = 40, seed: int = 1, gain: float = 0.3) -> list[TrialRow]:
    """Two policies that succeed alike; B does more of the task, and is done 3 s sooner."""
    rng = np.random.default_rng(seed)
    rows = []
    for each in interleaved({name: list(rng.random(count) < 0.5) for name in "AB"}):
        by = gain if each.policy == "B" else 0.0
        progress = 1.0 if each.recorded else round(float(rng.random() * 0.5 + by), 3)
        time_s = float(15 + rng.normal() - 10 * by) if each.recorded else None
        rows.append(replace(each, progress=progress, time_s=time_s))
    return rows


def test_progress_and_time_stand_beside_the_answer_of_success() -> None:
    rows = with_measures()
    answer = only(compare_policies(rows))
    plain = only(compare_policies([replace(r, progress=None, time_s=None) for r in rows]))
    assert answer.sentence.startswith(plain.sentence + "; progress ")
    assert answer.reading == plain.reading
    first, second = ([r for r in rows if r.policy == name] for name in "AB")
    both = list(zip(first, second, strict=True))
    more = sum((b.progress or 0) > (a.progress or 0) for a, b in both)
    less = sum((b.progress or 0) < (a.progress or 0) for a, b in both)
    means = [f"{100 * np.mean([r.progress for r in side]):.3g} %" for side in (second, first)]
    assert f"progress {means[0]} against {means[1]}, more in {more} and less in {less} of 40" in (
        answer.sentence
    )
    sooner = sum(b.time_s < (a.time_s or np.inf) for a, b in both if b.time_s)
    later = sum(a.time_s < (b.time_s or np.inf) for a, b in both if a.time_s)
    assert f"sooner in {sooner} and later in {later} of 40 pairs" in answer.sentence


def test_a_failure_is_never_done_and_trials_are_paired_in_their_order() -> None:
    _, time = MEASURES
    first = row(1, "A", True, time_s=9.0), row(2, "A", False), row(3, "A", True, time_s=7.0)
    second = row(4, "B", True, time_s=8.0), row(5, "B", False), row(6, "B", False, time_s=1.0)
    sides = [*((False, each) for each in first), *((True, each) for each in second)]
    found = [(a.episode, b.episode, np.sign(won)) for a, b, won in time.pairs(sides)]
    assert found == [("t1", "t4", 1), ("t2", "t5", 0), ("t3", "t6", -1)]
    unknown = row(7, "B", True)  # nobody knows how long it took
    assert list(time.pairs([(False, first[0]), (True, unknown)])) == []


def test_progress_that_says_no_more_than_success_is_not_told() -> None:
    rows = [replace(r, progress=float(bool(r.recorded))) for r in with_measures()]
    rows = [replace(r, time_s=None) for r in rows]
    assert only(compare_policies(rows)).beside == ()


def test_equal_progress_followed_for_ten_looks_is_decided_in_few_studies() -> None:
    """Sequential as success is: at most 5 % of equal candidates, however often one looks."""
    decided = 0
    for seed in range(150):
        rows = with_measures(80, seed, gain=0.0)
        looks = (only(compare_policies(rows[:size])) for size in range(16, 161, 16))
        decided += any("(decided)" in look.sentence for look in looks)
    assert decided <= 15  # 5 % of 150 and two standard errors


@pytest.mark.parametrize("task", ["task,", ""])
@pytest.mark.parametrize(
    ("names", "cells", "found"),
    [
        ("score,duration_s", ("0.5", "12.5"), (0.5, 12.5)),
        ("progress,time_s", ("50 %", "12,5"), (0.5, 12.5)),
        ("score,time", ("3", "14:05"), (None, None)),
        ("partial,completion_time_s", ("", ""), (None, None)),
    ],
)
def test_columns_of_progress_and_time_are_read_by_what_they_hold(
    tmp_path: Path, task: str, names: str, cells: tuple[str, str], found: tuple[float, float]
) -> None:
    lines = [f"trial_id;{task.replace(',', ';')}policy;outcome;{names.replace(',', ';')}"]
    lines += [f"{n};{'cup;' if task else ''}A;yes;{';'.join(cells)}" for n in range(3)]
    path = tmp_path / "trials.csv"
    path.write_text("\n".join(lines) + "\n")
    assert {(row.progress, row.time_s) for row in compare_csv(path).rows} == {found}
