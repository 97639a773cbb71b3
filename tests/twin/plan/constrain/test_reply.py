"""Replies of a model are judged, never executed: the given hostile ones, and many more.

Protocol, written before the first run: every family of ``hostile_replies`` is refused with the
place that it names, none is more than refused; talk around one good answer is read.
"""

import json
import os
import time
import tracemalloc
from pathlib import Path
from typing import Any

import pytest
from hostile_replies import ABOVE, GOAL, INSIDE, KEEP, hostile_replies, put, valid_reply
from hypothesis import given, settings
from hypothesis import strategies as st
from planned_start import problem_of_test

from bridge.errors import UsageError
from bridge.task.task_file import load_task
from twin.plan.constrain.reply import MAX_BYTES, ReplyError, read_reply
from twin.plan.constrain.schema import Vocabulary, check_constraint

SHARED = Path(os.environ.get("GST_SHARED_DATA", Path(__file__).parents[5] / "shared" / "data"))
GIVEN = SHARED / "planning" / "hostile_outputs.json"
CUBE = Vocabulary.of_task(load_task("cube_into_box"))
PROBLEM = problem_of_test()
HOSTILE = list(hostile_replies())
CPU_LIMIT_S, MEMORY_LIMIT_BYTES = 0.5, 50e6
"""No slow machine needs that, and what grows with the square of a reply does."""


def judged(reply: str | bytes) -> tuple[str, ...]:
    """What is said against a reply; nothing where it is taken."""
    try:
        read_reply(reply, CUBE, PROBLEM, {})
    except ReplyError as error:
        return error.problems
    return ()


def test_a_valid_reply_becomes_goals_and_constraints() -> None:
    reply, _ = read_reply(json.dumps(valid_reply()), CUBE, PROBLEM, {})
    assert reply["goals"] == [INSIDE]
    first, second = reply["constraints"]
    assert first == {"when": "release", "moving": "cube", "keep": ABOVE}
    assert (second["when"], second["moving"]) == ("carry", "cube")
    point = second["keep"]["a"]
    T = PROBLEM.scene.Ts_base_object["cube"]
    there = T[:3, :3] @ point["offset"] + T[:3, 3]
    assert (point["object"], point["anchor"]) == ("cube", "origin")
    assert there == pytest.approx([0.52, -0.13, 0.04], abs=1e-3)


TALK = {
    "bare": "{}",
    "a fence": "```json\n{}\n```",
    "a fence and talk": "Sure! I'd say:\n\n```json\n{}\n```\nIt's done, {{I hope}}.",
    "talk before": 'The "cube" goes into the box: {}',
    "thoughts": "<think>Is {{this}} it? [maybe</think>\n{}",
    "a byte order mark": "\ufeff{}",
    "twice": "{0}\n{0}",
}


@pytest.mark.parametrize("form", TALK.values(), ids=TALK.keys())
def test_talk_around_an_answer_is_passed_over(form: str) -> None:
    assert judged(form.format(json.dumps(valid_reply()))) == ()


def test_of_two_answers_the_last_is_read_and_that_is_said() -> None:
    first, last = valid_reply(), put(GOAL, {"kind": "on", "object": "cube", "support": "table"})
    reply, remarks = read_reply(f"{json.dumps(first)} No: {json.dumps(last)}", CUBE, PROBLEM, {})
    assert reply["goals"][0]["kind"] == "on"
    assert "the last of 2 answers in one reply was read" in remarks


def test_a_model_may_say_that_it_cannot() -> None:
    text = json.dumps({"version": 3, "cannot": "There is no mug."})
    assert read_reply(text, CUBE, PROBLEM, {})[0]["cannot"] == "There is no mug."


def test_hostile_replies_are_refused_with_their_place() -> None:
    for name, reply, place in HOSTILE:
        problems = judged(reply)
        assert problems, name
        assert any(text.startswith(f"{place}: ") for text in problems), (name, place, problems)
        for text in problems:
            assert text.isascii(), (name, text)
            assert text.isprintable(), (name, text)
            assert len(text) < 500, (name, text)


def test_nothing_of_a_hostile_reply_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    for _, reply, _ in HOSTILE:
        judged(reply)  # the tests' own checks of types are made now

    def refuse(*args: Any, **options: Any) -> None:
        raise AssertionError(args)

    for name in ("builtins.eval", "builtins.exec", "builtins.open", "os.system", "os.open"):
        monkeypatch.setattr(name, refuse)
    for _, reply, _ in HOSTILE:
        judged(reply)


def test_hostile_replies_cost_little() -> None:
    tracemalloc.start()
    try:
        for name, reply, _ in HOSTILE:
            tracemalloc.reset_peak()
            before, _ = tracemalloc.get_traced_memory()
            least = _cpu_s(reply)
            _, peak = tracemalloc.get_traced_memory()
            assert peak - before <= MEMORY_LIMIT_BYTES, (name, peak)
            for _ in range(3):
                if least > CPU_LIMIT_S:
                    least = min(least, _cpu_s(reply))
            assert least <= CPU_LIMIT_S, (name, least)
    finally:
        tracemalloc.stop()


def _cpu_s(reply: str) -> float:
    begin = time.process_time()
    judged(reply)
    return time.process_time() - begin


@pytest.mark.skipif(not GIVEN.is_file(), reason="shared data is not here (GST_SHARED_DATA)")
def test_the_given_replies_of_the_earlier_form_are_refused() -> None:
    given_ones = json.loads(GIVEN.read_text())
    cases = [json.dumps(given_ones["valid_reply"]), *(c["reply"] for c in given_ones["cases"])]
    for reply in cases:
        assert judged(reply), reply[:80]


def test_an_earlier_form_is_named_with_what_took_its_place() -> None:
    (said,) = judged(json.dumps(valid_reply() | {"version": 2}))
    assert said.startswith("top level: version 2 is an earlier form. Say version 3: object for obj")
    (said,) = judged(json.dumps(put(("goals", 0), {**INSIDE, "max_deg": 5})))
    assert said == 'goals[0]: unknown key "max_deg". For max_deg say tolerance_rad'


def test_directions_of_earlier_editions_are_refused_with_what_to_say() -> None:
    align = {"kind": "align", "a": {"ee": "approach"}, "b": {"world": "z"}, "tolerance_rad": 0.1}
    assert judged(json.dumps(put(KEEP, align))) == ()
    for changed, said in (
        ({"undirected": True}, "For undirected say the kind aligned"),
        ({"a": {"object": "cube", "axis": "any"}}, '"any" is unknown. Known: x, y, z, -x, -y, -z.'),
        ({"a": {"from": {"ee": True}, "to": {"xyz": [0, 0, 0]}}}, '"to". For from say world, or'),
    ):
        assert any(said in text for text in judged(json.dumps(put(KEEP, align | changed)))), said


def test_the_largest_reply_is_read_in_time() -> None:
    record = valid_reply() | {"goals": [INSIDE] * 32}
    record["constraints"] = record["constraints"] * 8
    reply = json.dumps(record)
    assert len(reply) < MAX_BYTES
    assert judged(reply) == ()
    assert min(_cpu_s(reply) for _ in range(3)) <= CPU_LIMIT_S


def test_a_task_holds_no_keypoints() -> None:
    with pytest.raises(UsageError, match="corner"):
        check_constraint(valid_reply()["constraints"][1]["keep"], CUBE)


def test_a_constraint_is_checked_for_the_scene() -> None:
    check_constraint(ABOVE, CUBE)
    with pytest.raises(UsageError, match=r"container: .* unknown. Known: box. Did you mean"):
        check_constraint({"kind": "inside", "object": "cube", "container": "boxx"}, CUBE)
    with pytest.raises(UsageError, match=r"min 0.5 is above max 0.1"):
        check_constraint({"kind": "height", "a": {"object": "cube"}, "min": 0.5, "max": 0.1}, CUBE)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=12),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.sampled_from(["kind", "a", "b", "object", "ee", "id", "min"]), inner)
    ),
    max_leaves=12,
)
PLACES = st.sampled_from(
    [(), ("goals",), GOAL, ("constraints", 0), ("constraints",), KEEP, (*KEEP, "a"), ("keypoints",)]
)


@settings(max_examples=60)
@given(PLACES, VALUES)
def test_no_value_anywhere_is_more_than_refused(path: tuple[str | int, ...], value: Any) -> None:
    record = put(path, value) if path else value
    judged(json.dumps(record))


@settings(max_examples=150)
@given(st.text() | st.binary())
def test_no_text_is_more_than_refused(text: str | bytes) -> None:
    assert judged(text)
