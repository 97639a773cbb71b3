"""Contracts of cells: what they may hold, and when they are broken."""

import itertools
import random
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.clock import NS_PER_S
from bridge.data_files import datasets_folder
from bridge.episode.contract import (
    Contract,
    ContractError,
    Presence,
    Span,
    TopicReport,
    TopicRule,
    contract_from,
    find_contract,
    findings_of,
    health_lines,
    judge,
    read_contract,
    unseen_losses,
)
from bridge.episode.metadata import from_strings
from bridge.errors import UsageError

JOINTS = "/lab/joint_states"
RULE = TopicRule(rate_hz=100.0, tolerance=0.2, silence_s=0.5)


def seen(*stamps_s: float) -> Presence:
    presence = Presence()
    for stamp_s in stamps_s:
        presence.see(round(stamp_s * NS_PER_S))
    return presence


def steady(start_s: float, end_s: float, rate_hz: float = 100.0) -> list[float]:
    return [start_s + number / rate_hz for number in range(round((end_s - start_s) * rate_hz) + 1)]


def broken(
    presence: Presence | None, rule: TopicRule = RULE, *, end_s: float = 10.0, lost: int = 0,
) -> list[str]:  # fmt: skip
    span = Span(NS_PER_S, NS_PER_S + round(end_s * NS_PER_S))
    presences = {} if presence is None else {JOINTS: presence}
    return told(judge(presences, Contract(topics={JOINTS: rule}), span, {JOINTS: lost}), presences)


def told(
    reports: dict[str, TopicReport], presences: dict[str, Presence], name: str = "contract_broken"
) -> list[str]:
    """What is found under one name."""
    found = findings_of(reports, presences, 11 * NS_PER_S)
    return [f"{each.about}: {each.text}" for each in found if each.name == name]


def test_a_contract_that_is_kept_is_not_broken() -> None:
    assert broken(seen(*steady(1.0, 11.0))) == []


@pytest.mark.parametrize(
    ("stamps", "found"),
    [
        (steady(1.0, 4.0), "silent for the last 7.0 s; at most 0.5 s is allowed"),
        (steady(4.0, 11.0), "silent for the first 3.0 s"),
        (steady(1.0, 4.0) + steady(6.0, 11.0), "silent for 2.0 s from 3.0 s on"),
        (steady(1.0, 11.0, 60.0), "60.0 messages a second; the contract says 100 ± 20 %"),
        (steady(1.0, 11.0, 150.0), "150.0 messages a second"),
    ],
)
def test_each_way_to_break_it_is_named(stamps: list[float], found: str) -> None:
    assert any(found in text for text in broken(seen(*stamps)))


def test_what_the_recorder_dropped_is_not_held_against_the_rate() -> None:
    """Law: a publisher that sent at its rate kept it, whoever lost its messages."""
    half = seen(*steady(1.0, 11.0, 50.0))
    assert any("50.0 messages" in text for text in broken(half))
    assert broken(half, lost=500) == []


def test_a_required_topic_that_never_spoke_breaks_it_and_an_optional_one_does_not() -> None:
    assert broken(None) == [f"{JOINTS}: no message, and the contract requires it"]
    assert broken(None, TopicRule(rate_hz=100.0, silence_s=0.5, required=False)) == []


@given(
    stamps=st.lists(st.integers(NS_PER_S, 20 * NS_PER_S), min_size=1, max_size=50).map(sorted),
    limit_s=st.floats(0.1, 5.0),
)
def test_a_silence_is_told_exactly_when_one_is_longer_than_allowed(
    stamps: list[int], limit_s: float
) -> None:
    """Law: compared with the differences of all stamps, ends included."""
    presence = Presence()
    for stamp in stamps:
        presence.see(stamp)
    longest_ns = max(b - a for a, b in itertools.pairwise([NS_PER_S, *stamps, 21 * NS_PER_S]))
    found = broken(presence, TopicRule(silence_s=limit_s), end_s=20.0)
    assert bool(found) == (longest_ns / NS_PER_S > limit_s)


@pytest.mark.parametrize(
    ("stamps", "is_unknown"),
    [
        (steady(1.0, 4.0), True),
        (steady(1.0, 10.5), False),
        (steady(1.0, 1.5), False),  # too short to have shown a rate
        ([1.0, 4.0, 5.0], False),
        (steady(1.0, 3.0) + steady(4.5, 6.0), False),  # it is silent for so long now and then
    ],
)
def test_without_a_contract_only_a_regular_stream_that_ends_early_has_an_unknown_tail(
    stamps: list[float], is_unknown: bool
) -> None:
    presences = {JOINTS: seen(*stamps)}
    reports = judge(presences, None, Span(NS_PER_S, 11 * NS_PER_S), {})
    assert bool(told(reports, presences, "tail_unknown")) == is_unknown
    assert told(reports, presences) == []


def test_events_promise_no_next_one_however_many_came() -> None:
    span = Span(NS_PER_S, 11 * NS_PER_S)
    presences = {"/lab/event": seen(*steady(1.0, 4.0), *steady(5.0, 11.0, 1.0))}
    reports = judge(presences, None, span, {})
    assert list(findings_of(reports, presences, span.end_ns)) == []


@pytest.mark.parametrize(
    ("stamps", "found"),
    [
        (
            steady(1.0, 4.0, 30.0) + steady(5.0, 15.0, 1.6),
            ["1.6 messages a second instead of 30.0"],
        ),
        (steady(1.0, 4.0, 30.0) + steady(5.0, 15.0, 10.0), []),  # a third of it: no collapse
        (steady(1.0, 11.0, 1.6), []),  # it was never faster
        ([*steady(1.0, 4.0, 30.0), 6.0, 6.03, 8.0, 8.03, 10.0], []),  # hiccups
    ],
)
@pytest.mark.parametrize("jitter_s", [0.0, 0.005])
def test_without_a_contract_a_rate_that_collapses_is_named(
    stamps: list[float], found: list[str], jitter_s: float
) -> None:
    rng = random.Random(0)
    moved = [stamp + rng.uniform(-jitter_s, jitter_s) for stamp in stamps]
    presences = {JOINTS: seen(*moved)}
    span = Span(NS_PER_S, 16 * NS_PER_S)
    reports = judge(presences, None, span, {})
    words = told(reports, presences, "rate_collapsed")
    assert len(words) == len(found)
    for text, expected in zip(words, found, strict=True):
        first, last = (float(w) for w in (text.split()[1], text.split()[-1]))
        assert first == pytest.approx(float(expected.split()[0]), rel=0.15)
        assert last == pytest.approx(30.0, rel=0.05)
    reports = judge(presences, Contract(topics={JOINTS: TopicRule()}), span, {})
    assert told(reports, presences, "rate_collapsed") == []


def test_a_contract_is_read_from_its_file_and_its_record(tmp_path: Path) -> None:
    contract = Contract(topics={JOINTS: RULE, "/lab/plan": TopicRule(required=False)}, cell="lab")
    (tmp_path / "cell.toml").write_text(
        HEAD + f'cell = "lab"\n[topics."{JOINTS}"]\nrate_hz = 100\ntolerance = 0.2\n'
        'silence_s = 0.5\n[topics."/lab/plan"]\nrequired = false\n'
    )
    assert read_contract(tmp_path / "cell.toml") == contract
    assert find_contract(tmp_path, None) == contract
    assert contract_from(from_strings(contract.to_record()), name="e1") == contract
    assert find_contract(tmp_path / "elsewhere", None) is None


HEAD = "schema_version = 1\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "schema_version is missing; it must be 1"),
        ("schema_version = 2", "schema_version is 2; it must be 1"),
        (HEAD, "Expected .object., got .null."),
        ("schema_version = 1 1", "cannot be read: .*line 1"),
        (HEAD + "topic = 1\n[topics]", "unknown field .topic."),
        (HEAD + '[topics."/a"]\nrate = 1', r'topics."/a": .*unknown field .rate.'),
        (HEAD + '[topics."a"]\nrate_hz = 1', "starts with a slash: /a"),
        (
            HEAD + '[topics."/a"]\nrate_hz = -1',
            r"topics.\S*: Expected .float. > 0.0 - at .*rate_hz",
        ),
        (HEAD + '[topics."/a"]\nsilence_s = "x"', "got .str. - at .*silence_s"),
        (HEAD + '[topics."/a"]\nrequired = 1', "Expected .bool., got .int. - at .*required"),
        (HEAD + "cell = 3\n[topics]", "Expected .str., got .int. - at .*cell"),
        (HEAD + 'topics."/a" = 3', r"topics.\S*: Expected .object."),
    ],
)
def test_what_a_contract_cannot_hold_is_named(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(text)
    with pytest.raises(ContractError, match=words):
        read_contract(path)


def test_the_templates_can_be_read_and_an_unknown_one_lists_them() -> None:
    names = sorted(path.stem for path in (datasets_folder() / "cells/contracts").glob("*.toml"))
    assert names
    for name in names:
        contract = find_contract(Path("nowhere"), name)
        assert contract is not None
        assert contract.required()
    with pytest.raises(UsageError, match=f"There are: {', '.join(names)}"):
        find_contract(Path("nowhere"), "kitchen")


def test_records_of_other_programs_are_no_sentences() -> None:
    assert health_lines({"unnumbered": [1], "findings": [{"name": 1}]}) == []
    assert unseen_losses({"/b": 2, "/a": 0}) == [
        "/b: 2 messages carry no sequence number; losses of it cannot be seen"
    ]
