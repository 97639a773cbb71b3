"""What a session has settled, and what to run next: from trials alone, without a network."""

from dataclasses import replace

import pytest

from bridge.episode.catalogue import Entry
from evaluator.live.follow import change_line, state_lines
from evaluator.live.session import (
    LiveTrial,
    SessionTrials,
    changes_of,
    next_start,
    summarise_session,
    trial_of,
)

WITHOUT, WITH = "without_replanning", "with_replanning"


def trial(
    number: int,
    recorded: bool | None,
    *,
    condition: str = WITH,
    start: str | None = None,
    task: str = "cube",
) -> LiveTrial:
    return LiveTrial(
        episode=f"trial_{number:04d}",
        task=task,
        condition=condition,
        policy="scripted",
        start_id=start,
        recorded=recorded,
        start_ns=number,
    )


def fill(*trials: LiveTrial) -> SessionTrials:
    session = SessionTrials()
    for each in trials:
        session.take(each)
    return session


def test_only_trials_that_can_be_read_count() -> None:
    entry = Entry(file="t.mcap", id="t", kind="trial", outcome="success", task="cube")
    known = trial_of(entry)
    assert known is not None
    assert known.recorded is True
    assert trial_of(replace(entry, kind="scan")) is None
    assert trial_of(replace(entry, error="broken")) is None
    unknown = trial_of(replace(entry, outcome="unknown"))
    assert unknown is not None
    assert unknown.recorded is None


def test_the_same_news_twice_is_no_news_and_a_corrected_label_replaces() -> None:
    session = fill(trial(1, True))
    assert session.take(trial(1, True)) is None
    change = session.take(trial(1, False))
    assert change is not None
    assert change.before is not None
    assert (change.before.recorded, change.trial.recorded) == (True, False)
    assert [t.recorded for t in session.trials] == [False]


def test_a_late_label_takes_its_place_in_the_order_of_trials() -> None:
    session = fill(trial(2, True), trial(1, None), trial(3, False))
    assert summarise_session(session.trials, None).unknown == 1
    session.take(trial(1, True))
    assert [t.recorded for t in session.trials] == [True, True, False]
    standing = summarise_session(session.trials, None)
    assert (standing.rates[0].k, standing.rates[0].n) == (2, 3)


def test_what_left_the_folder_counts_no_more_and_what_it_has_not_listed_yet_stays() -> None:
    session = fill(trial(9, True))
    changes, gone = session.take_listing([trial(1, True)])
    assert ([c.trial.episode for c in changes], gone) == (["trial_0001"], [])
    assert len(session.trials) == 2  # the message was quicker than the folder
    _, gone = session.take_listing([trial(1, True), trial(9, True)])
    assert gone == []
    _, gone = session.take_listing([trial(9, True)])
    assert [t.episode for t in gone] == ["trial_0001"]


def test_news_in_any_order_give_the_same_standing() -> None:
    trials = [trial(i, i % 3 != 0, start=f"s{i // 2}") for i in range(1, 9)]
    forwards, backwards = fill(*trials), fill(*reversed(trials))
    assert summarise_session(forwards.trials, 0.5) == summarise_session(backwards.trials, 0.5)


def test_pairs_are_starts_tried_once_in_each_condition() -> None:
    trials = [
        trial(1, False, condition=WITHOUT, start="a"),
        trial(2, True, start="a"),
        trial(3, True, condition=WITHOUT, start="b"),
        trial(4, False, start="b"),
        trial(5, True, condition=WITHOUT, start="c"),
        trial(6, False, condition=WITHOUT, start="c"),
        trial(7, True, start="c"),
        trial(8, True, start=None),
    ]
    assert changes_of(trials, "cube", "scripted") == [1, -1]


def test_a_settled_rate_stops_and_an_open_one_says_how_many_more() -> None:
    good = [trial(i, True) for i in range(1, 21)]
    settled = summarise_session(good, 0.5).rates[0]
    assert settled.advice is not None
    assert (settled.advice.stop, settled.advice.answer) == (True, "above")
    still_open = summarise_session(good[:3], 0.5).rates[0]
    assert still_open.advice is not None
    assert not still_open.advice.stop
    assert (still_open.advice.more_trials or 0) > 0
    assert summarise_session(good, None).rates[0].advice is None


def test_a_rate_that_changed_ends_the_sequence_with_its_reason() -> None:
    trials = [trial(i, i <= 60) for i in range(1, 300)]
    rate = summarise_session(trials, 0.5).rates[0]
    assert "the rate has changed" in rate.changed
    assert rate.advice is None


def test_half_a_pair_is_completed_first() -> None:
    trials = [
        trial(1, True, condition=WITHOUT, start="a"),
        trial(2, True, start="a"),
        trial(3, True, start="b"),
    ]
    proposal = next_start(trials, summarise_session(trials, None))
    assert proposal is not None
    assert (proposal.condition, proposal.start_id) == (WITHOUT, "b")


def test_a_void_trial_is_run_again() -> None:
    trials = [
        trial(1, True, condition=WITHOUT, start="a"),
        trial(2, None, start="a"),
    ]
    proposal = next_start(trials, summarise_session(trials, None))
    assert proposal is not None
    assert (proposal.condition, proposal.start_id) == (WITH, "a")


def test_new_starts_begin_with_either_condition_in_turn() -> None:
    trials = [trial(1, True, condition=WITHOUT, start="a"), trial(2, True, start="a")]
    begun = []
    number = 3
    for _ in range(8):
        proposal = next_start(trials, summarise_session(trials, None))
        assert proposal is not None
        start = proposal.start_id or f"n{number}"
        if proposal.start_id is None:
            begun.append(proposal.condition)
        trials.append(trial(number, True, condition=proposal.condition, start=start))
        number += 1
    assert begun == [WITH, WITHOUT, WITH, WITHOUT]
    counts = [sum(t.condition == name for t in trials) for name in (WITHOUT, WITH)]
    assert counts == [5, 5]


def test_the_task_with_fewer_trials_comes_first_and_settled_ones_not_at_all() -> None:
    trials = [trial(i, True, task="cube") for i in range(1, 25)]
    trials += [trial(30, True, task="duck"), trial(31, True, task="duck")]
    proposal = next_start(trials, summarise_session(trials, 0.5))
    assert proposal is not None
    assert proposal.task == "duck"
    settled = [t for t in trials if t.task == "cube"]
    assert next_start(settled, summarise_session(settled, 0.5)) is None
    assert next_start([], summarise_session([], 0.5)) is None


@pytest.mark.parametrize(
    ("before", "words"), [(None, "success;"), (False, "corrected, was failure")]
)
def test_a_line_says_what_happened_what_follows_and_what_is_next(
    before: bool | None, words: str
) -> None:
    session = fill(*[trial(i, True, start=f"s{i}") for i in range(1, 4)])
    if before is not None:
        session.take(trial(4, before, start="s4"))
    change = session.take(trial(4, True, start="s4"))
    assert change is not None
    standing = summarise_session(session.trials, 0.9)
    line = change_line(change, standing, next_start(session.trials, standing), 0.9)
    assert line.startswith("trial_0004: success")
    assert words in line
    assert "cube, with replanning, scripted 4/4 [" in line
    assert "continue: about " in line
    assert "next: cube, with replanning" in line


def test_without_trials_the_state_says_so() -> None:
    standing = summarise_session([trial(1, None)], 0.5)
    assert state_lines(standing, None, 0.5) == ["no trial with a known outcome yet (1 without)"]
