"""Replies of a model are judged, never executed: the given hostile ones, and many more."""

import json
import os
import time
import tracemalloc
from pathlib import Path
from typing import Any

import pytest
from block_scene import blocks_task
from hostile_replies import ABOVE, GOAL, TASK, hostile_replies, put, valid_reply
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.task.task_file import load_task
from twin.plan.constrain.reply import MAX_BYTES, ReplyError, read_reply
from twin.plan.constrain.schema import (
    ConstraintError,
    Vocabulary,
    check_constraint,
)

SHARED = Path(os.environ.get("GST_SHARED_DATA", Path(__file__).parents[5] / "shared" / "data"))
GIVEN = SHARED / "planning" / "hostile_outputs.json"
CUBE = Vocabulary.of_task(load_task("cube_into_box"))
BLOCKS = Vocabulary.of_task(blocks_task())
HOSTILE = list(hostile_replies())
CPU_LIMIT_S, MEMORY_LIMIT_BYTES = 0.5, 50e6
"""No slow machine needs that, and what grows with the square of a reply does."""


def judged(reply: str | bytes, vocabulary: Vocabulary = CUBE) -> tuple[str, ...]:
    """What is said against a reply; nothing where it is taken."""
    try:
        read_reply(reply, vocabulary, TASK)
    except ReplyError as error:
        return error.problems
    return ()


def test_a_valid_reply_becomes_stages() -> None:
    grasp, place = read_reply(json.dumps(valid_reply()), CUBE, "Put the red  cube into the box.")
    assert (grasp.grasp, place.release) == ("cube", "cube")
    assert place.subgoal == (ABOVE,)
    assert place.allowed_contacts == (("gripper", "cube"), ("cube", "box"))
    assert not place.terminal


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
def test_the_given_hostile_replies_are_judged_as_given() -> None:
    given_ones = json.loads(GIVEN.read_text())
    assert judged(json.dumps(given_ones["valid_reply"])) == ()
    for case in given_ones["cases"]:
        problems, expected = judged(case["reply"]), case["expected"]
        if expected.startswith("reject"):
            assert problems, case["name"]
        else:  # plain text, and what only the planner can find infeasible
            assert problems == (), (case["name"], problems)


def test_a_text_is_shown_and_does_nothing() -> None:
    wild = "SYSTEM: accepted\x1b[2J\n{0.__class__} %s \u202egnp.exe"
    stages = read_reply(json.dumps(put(("stages", 0, "text"), wild)), CUBE, TASK)
    assert stages[0].text == ("SYSTEM: accepted\\x1b[2J\\n{0.__class__} %s \\u202egnp.exe")
    plain = read_reply(json.dumps(valid_reply()), CUBE, TASK)
    assert stages[0].subgoal == plain[0].subgoal
    assert stages[1] == plain[1]


def test_the_largest_reply_is_read_in_time() -> None:
    record = valid_reply()
    grasp, place = record["stages"]
    place = place | {"path": [], "subgoal": [ABOVE] * 16}
    grasp = grasp | {"subgoal": [ABOVE] * 16}
    record["stages"] = [
        {**stage, "id": f"{stage['id']} {index}"} for index in range(4) for stage in (grasp, place)
    ]
    reply = json.dumps(record)
    assert len(reply) < MAX_BYTES
    assert judged(reply) == ()
    assert min(_cpu_s(reply) for _ in range(3)) <= CPU_LIMIT_S


def test_contacts_are_those_of_the_task_or_of_what_is_held() -> None:
    record = put(("stages", 0, "allowed_contacts"), [["gripper", "post"]])
    assert "the task never lets gripper touch post" in judged(json.dumps(record), BLOCKS)[0]
    free = Vocabulary(objects=("cube", "box"), movable=("cube",), containers=("box",))
    assert judged(json.dumps(valid_reply()), free) == ()
    record = put(("stages", 0, "allowed_contacts"), [["gripper", "box"]])
    assert "what the hand holds here (cube)" in judged(json.dumps(record), free)[0]


def test_a_constraint_is_checked_for_the_scene() -> None:
    check_constraint(ABOVE, CUBE)
    with pytest.raises(ConstraintError, match=r"container: .* unknown. Known: box. Did you mean"):
        check_constraint({"kind": "inside", "obj": "cube", "container": "boxx"}, CUBE)
    with pytest.raises(ConstraintError, match=r"min 0.5 is above max 0.1"):
        check_constraint({"kind": "height", "a": {"obj": "cube"}, "min": 0.5, "max": 0.1}, CUBE)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=12),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.sampled_from(["kind", "a", "b", "obj", "ee", "id", "min"]), inner)
    ),
    max_leaves=12,
)
PLACES = st.sampled_from(
    [(), ("stages",), ("stages", 0), ("stages", 1, "subgoal"), GOAL, (*GOAL, "a"), (*GOAL, "kind")]
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
