"""The index says what the evaluation says, in any order, page and filter, and is never old."""

import random
import shutil
from dataclasses import replace
from itertools import product
from types import ModuleType
from typing import Any

import msgspec
import pytest
from serving import judged, reader_held
from visible import words

from bridge.episode.catalogue import label_episode
from bridge.episode.executions import NO_PLAN
from bridge.episode.metadata import Outcome
from bridge.episode.run_folder import RunFolder
from dashboards import comparison
from dashboards.comparison import judge
from evaluator.compare import compare_run
from evaluator.quantity import slug
from evaluator.report.review import index_run, refresh
from evaluator.result import load_results, write_results
from evaluator.review_index import (
    SORT,
    ReviewIndex,
    Selection,
    UnusableIndexError,
    index_path,
    severity,
    state_of,
    written_index,
)
from evaluator.trial_row import TrialRow

HOSTILE = '<script>alert("x")</script>' + "long_name" * 45 + "\n'\";--%_ü"
PLAIN = TrialRow(
    episode="", task="pour", condition="with_replanning", policy="act", start_id=None, cell="lab",
    stand_in=None, recorded=None,
)  # fmt: skip
ANSWERS = (True, False, None)


def made(trials: list[TrialRow], **about: Any) -> ReviewIndex:
    return ReviewIndex(written_index(trials, (), about))


def many() -> list[TrialRow]:
    """Every combination of outcomes in several tasks, and a name that nobody should choose."""
    tasks = ("pour", "Über den Tisch", HOSTILE)
    return [
        replace(
            PLAIN,
            episode=f"trial_{number:04}",
            file=f"trial_{number:04}.mcap",
            task=tasks[number % 3],
            condition=("without_replanning", "with_replanning")[number // 3 % 2],
            recorded=ANSWERS[number // 6 % 3],
            sim_planned=ANSWERS[number // 18 % 3],
            failing_cause="collision" if number % 5 else None,
            first_failing="clearance" if number % 5 else None,
            failed_stage="grasp" if number % 7 else "",
            start_id=f"s{number % 11}",
            began_ns=10**18 - number,
            distance_m=number % 13 / 1000 if number % 4 else None,
        )
        for number in range(120)
    ]


@pytest.mark.parametrize("show", ["", "disagree", "wrong_yes", "failure", "undecided", "nonsense"])
def test_a_filter_takes_what_its_name_says(show: str) -> None:
    trials = many()
    wanted = {
        "": lambda t: True,
        "disagree": lambda t: t.agrees is False,
        "wrong_yes": lambda t: t.sim_planned is True and t.recorded is False,
        "failure": lambda t: t.recorded is False,
        "undecided": lambda t: t.agrees is None,
        "nonsense": lambda t: False,
    }[show]
    for task in ("", "pour", slug(HOSTILE)):
        selection = Selection(show=show, task=task)
        expected = [t for t in trials if wanted(t) and task in ("", slug(t.task))]
        index = made(trials)
        assert list(index.trials(selection)) == expected
        assert index.count(selection) == len(expected)


@pytest.mark.parametrize("sort", [name for known in SORT for name in (known, f"-{known}")])
def test_every_order_pages_through_every_trial_once(sort: str) -> None:
    index = made(many())
    selection = Selection(sort=sort)
    pages = [index.trials(selection, limit=7, offset=at) for at in range(0, 126, 7)]
    names = [trial.episode for page in pages for trial in page]
    assert sorted(names) == [trial.episode for trial in many()]
    steps = [index.neighbours(selection, name) for name in names]
    assert steps == list(zip([None, *names], [*names[1:], None], strict=False))


def test_the_farthest_come_first_and_what_was_not_measured_last() -> None:
    found = [trial.distance_m for trial in made(many()).trials(Selection(sort="distance"))]
    known = [far for far in found if far is not None]
    assert known == sorted(known, reverse=True)
    assert found[: len(known)] == known


@pytest.mark.parametrize("text", ["TRIAL_0007", "tisch über", "grasp pour", "%", "' OR 1=1 --"])
def test_words_are_found_in_whatever_case_and_order_and_are_plain_text(text: str) -> None:
    trials = many()
    found = made(trials).trials(Selection(q=text))

    def has(trial: TrialRow) -> bool:
        held = f"{trial.episode} {trial.task} {trial.failing_cause} {trial.failed_stage}"
        return all(word in held.casefold() for word in text.casefold().split())

    assert list(found) == [trial for trial in trials if has(trial)]


def test_a_wrong_yes_comes_first_and_in_each_kind_the_farthest() -> None:
    kinds = [(True, False), (False, True), (None, True), (True, True)]
    trials = [
        replace(PLAIN, episode=f"{number}", sim_planned=sim, recorded=real, distance_m=far)
        for number, ((sim, real), far) in enumerate(product(kinds, (0.02, 0.01, None)))
    ]
    shuffled = random.Random(1).sample(trials, len(trials))
    assert sorted(shuffled, key=severity) == trials


def test_what_nobody_planned_is_judged_by_what_was_executed() -> None:
    fails = {"recorded": False, "sim_executed": True, "plan_id": NO_PLAN}
    unplanned = replace(PLAIN, episode="unplanned", executed_replay="x.mcap", **fails)
    planned = replace(unplanned, episode="planned", plan_id="p")
    assert (unplanned.twin, unplanned.twin_replay, unplanned.agrees) == (True, "x.mcap", False)
    assert (planned.twin, planned.twin_replay, planned.agrees) == (None, None, None)
    index = made([unplanned, planned])
    assert [trial.episode for trial in index.trials(Selection(show="wrong_yes"))] == ["unplanned"]
    assert index.totals()[2] == 2


def test_the_index_holds_what_the_comparison_holds(shared_run: RunFolder) -> None:
    expected = {row.episode: row for row in compare_run(shared_run).rows}
    found = ReviewIndex(refresh(shared_run)).trials(Selection())
    assert {t.episode for t in found} == set(expected)
    assert [t.episode for t in found] == [t.episode for t in judged(shared_run).rows]
    assert any(t.distance_m for t in found)
    for trial in found:
        row = expected[trial.episode]
        for name in ("task", "recorded", "sim_planned", "sim_executed", "verdict", "plan_id"):
            assert getattr(trial, name) == getattr(row, name), name
        assert trial.file == f"{trial.episode}.mcap"


def told_behind(run: RunFolder) -> ReviewIndex:
    """What a page shows once whoever reads the run behind it is done."""
    if judge(run).is_being_updated:
        update = comparison._KNOWN[run].update
        assert update is not None
        assert update.wait(600) == 0
    known = judge(run)
    assert known.index is not None
    assert (known.is_old, known.is_being_updated) == (False, False)
    return known.index


def test_an_unchanged_run_is_not_read_again(copy: RunFolder) -> None:
    assert not judge(copy).is_old
    assert comparison._KNOWN[copy].update is None


def test_numbers_of_a_changed_run_are_computed_anew_and_stored_ones_stay(copy: RunFolder) -> None:
    stored = (copy.results_dir / "results.json").read_bytes()
    label_episode(copy, "trial_0003", Outcome(result="failure", by="reviewer"))
    index = ReviewIndex(refresh(copy))
    found = {each.id: each.value for each in index.measurements}
    assert found == {each.id: each.value for each in compare_run(copy).results().measurements}
    assert (
        found["agreement.sim_planned.rate"]
        != load_results(copy.path).get("agreement.sim_planned.rate").value
    )
    assert (copy.results_dir / "results.json").read_bytes() == stored
    assert index.about["outdated"] == "trial_0003.outcome.json is new"


def test_copied_files_leave_stored_numbers_as_they_are(copy: RunFolder) -> None:
    results = load_results(copy.path)
    kept = replace(results.measurements[0], value=0.125)
    write_results(replace(results, measurements=(kept,)), copy.results_dir / "results.json")
    index = ReviewIndex(refresh(copy))
    assert [each.value for each in index.measurements] == [0.125]
    assert index.about["outdated"] is None


@pytest.mark.parametrize("damage", [b"", b"nonsense", None])
def test_a_damaged_or_foreign_index_is_made_anew(copy: RunFolder, damage: bytes | None) -> None:
    path = index_path(copy)
    if damage is None:
        other = msgspec.msgpack.decode(path.read_bytes()) | {"version": 999}
        path.write_bytes(msgspec.msgpack.encode(other))
    else:
        path.write_bytes(damage)
    with pytest.raises(UnusableIndexError):
        ReviewIndex(path)
    assert judge(copy).index is None
    assert told_behind(copy).count(Selection()) == ReviewIndex(path).count(Selection()) == 4


def test_what_changes_while_an_evaluation_reads_makes_its_index_old(copy: RunFolder) -> None:
    state, compared = state_of(copy), compare_run(copy)
    index_run(copy, compared, compared.results(), state)
    assert not judge(copy, reads=False).is_old
    (copy.episodes_dir / "trial_0001.mcap").unlink()
    index_run(copy, compared, compared.results(), state)
    assert judge(copy, reads=False).is_old


def test_of_two_changed_runs_one_is_read_at_a_time(copy: RunFolder, own_run: RunFolder) -> None:
    shutil.rmtree(copy.results_dir)
    with reader_held(copy):
        assert judge(copy).is_being_updated
        assert judge(own_run).is_being_updated
        assert comparison._KNOWN[own_run].update is None


def test_a_page_says_that_its_numbers_are_being_recomputed(
    copy: RunFolder, synthetic: ModuleType
) -> None:
    browser = synthetic.browser_of(copy)
    label_episode(copy, "trial_0003", Outcome(result="failure", by="reviewer"))
    with reader_held(copy):
        for address in ("/", "/failures", "/numbers", "/twin", "/label", "/episode/trial_0003"):
            text = words(browser.get(address).text)
            assert "its numbers are being recomputed" in text, address
    before, after = judge(copy).row("trial_0003"), told_behind(copy).trial("trial_0003")
    assert (before and before.agrees, after and after.agrees) == (True, False)
    text = words(browser.get("/").text)
    assert "being recomputed" not in text
    assert "robot-gst evaluate" in text  # the report is older than the label


def test_a_run_read_for_the_first_time_says_nothing_false(
    own_run: RunFolder, synthetic: ModuleType
) -> None:
    app = synthetic.Browser(synthetic.create_app(synthetic.Library.open([own_run.path])))
    with reader_held(own_run):
        for address in ("/", "/failures", "/numbers", "/label"):
            text = words(app.get(address).text)
            assert "being read for the first time" in text, address
            assert "robot-gst record" not in text, address
            assert "evaluate" not in text, address


def test_a_run_that_cannot_be_written_is_shown_all_the_same(
    copy: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.rmtree(copy.results_dir)
    copy.results_dir.write_bytes(b"")  # no folder can be made here
    assert told_behind(copy).count(Selection()) == 4


def test_a_name_that_is_not_unicode_is_spelled_out() -> None:
    trial = replace(PLAIN, episode="trial_\udcff", file="trial_\udcff.mcap", task="\udc80")
    (found,) = made([trial]).trials(Selection())
    assert (found.episode, found.task) == ("trial_\\udcff", "\\udc80")


def test_a_file_being_written_does_not_make_the_index_old(copy: RunFolder) -> None:
    part = copy.episodes_dir / "trial_0009.mcap.part"
    part.write_bytes(b"1")
    before = state_of(copy).digest
    part.write_bytes(b"12")
    assert state_of(copy).digest == before
    part.unlink()
    assert state_of(copy).digest != before


def test_a_page_of_hostile_names_holds_no_markup_of_theirs(
    copy: RunFolder, synthetic: ModuleType
) -> None:
    state = state_of(copy)
    about = {
        "state": [state.digest, state.results], "missing": [HOSTILE],
        "tasks": [
            {"task": HOSTILE, "slug": slug(HOSTILE), "answer": "not yet", "sentence": HOSTILE}
        ],
        "views": [
            {"file": HOSTILE, "camera": HOSTILE, "stamp_ns": 1, "psnr_db": 9.0, "ssim": None}
        ],
    }  # fmt: skip
    trials = [replace(trial, start_id=HOSTILE, policy=HOSTILE) for trial in many()]
    index_path(copy).write_bytes(written_index(trials, (), about))
    page = synthetic.browser_of(copy).get("/?q=%3Cscript%3E&sort=%22%3E&page=%27").text
    assert "<script>alert" not in page
    page = synthetic.browser_of(copy).get("/?page=999999999999").text
    assert "<script>alert" not in page
    assert "Page 3 of 3" in page
    assert "trial_0119" in page
    page = synthetic.browser_of(copy).get("/?page=2&sort=-name").text
    assert page.index("trial_0069") < page.index("trial_0020")
    assert "page=3" in page
