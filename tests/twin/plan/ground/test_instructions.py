"""Instructions: those given, our own, and laws that hold for any."""

import json
import os
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from spoken_scenes import SCENES, as_meant, asked, outcome, vocabulary_from_labels

from bridge.data_files import datasets_folder
from bridge.task.task_file import TaskFile
from twin.plan.ground.grammar import ground
from twin.plan.ground.vocabulary import GroundingError, Vocabulary, vocabulary_of
from twin.plan.ground.words import MAX_CHARACTERS

ROOT = Path(__file__).parents[4]
SHARED = Path(os.environ.get("GST_SHARED_DATA", ROOT.parent / "shared" / "data"))
GIVEN = SHARED / "planning" / "instructions.json"


def rows(name: str = "paraphrases.txt") -> list[tuple[str, str, str, str]]:
    """Scene, instruction, what is expected, and the order or nothing."""
    found = []
    for line in Path(__file__).with_name(name).read_text().splitlines():
        if line and not line.startswith("#"):
            scene, text, wanted, *order = (part.strip() for part in line.split(" | "))
            found.append((scene, text, wanted, order[0] if order else ""))
    return found


ROWS = rows()
DOCS = (ROOT / "docs" / "planning.md").read_text()
VALID = [row for row in ROWS if not row[2].startswith("!")]


@pytest.mark.parametrize(("scene", "text", "wanted", "order"), ROWS)
def test_our_own_instructions(scene: str, text: str, wanted: str, order: str) -> None:
    assert as_meant(scene, text, wanted, order), outcome(SCENES[scene], text)


@pytest.mark.skipif(not GIVEN.is_file(), reason="the given instructions are not on this machine")
def test_of_the_given_instructions_two_thirds_are_understood_and_none_is_guessed() -> None:
    given_file = json.loads(GIVEN.read_text())
    scenes = {name: vocabulary_from_labels(about) for name, about in given_file["scenes"].items()}
    scores = [(case, _scored(case, scenes)) for case in given_file["cases"]]
    valid = [score for case, score in scores if case["outcome"] == "valid"]
    assert valid.count("right") >= len(valid) * 2 / 3
    assert "guessed" not in valid
    assert all(score == "right" for case, score in scores if case["outcome"] == "error")


def _scored(case: dict[str, Any], scenes: dict[str, Vocabulary]) -> str:
    """The scoring that the file itself describes: right, guessed, or an error of its own."""
    expected = case["expected"]
    try:
        found = ground(case["text"], scenes[case["scene"]])
    except GroundingError as error:
        fits = case["outcome"] == "error" and error.kind == expected["error"]
        named = all(name in str(error) for name in expected.get("names_candidates", ()))
        return "right" if fits and named and error.exit_code == 2 else "another error"
    chosen = {key: f"any of {item.count}" for item in found.choices for key in item.chosen}
    goals = [
        dict(goal) | {"object": chosen.get(goal["object"], goal["object"])} for goal in found.goals
    ]
    mine = {json.dumps(goal, sort_keys=True) for goal in goals}
    theirs = Counter(json.dumps(goal, sort_keys=True) for goal in expected.get("goal", []))
    in_order = expected.get("order") in ("any", list(found.order))
    is_right = Counter(mine) == theirs and in_order and "path:" not in expected.get("note", "")
    return "right" if is_right else "guessed"


@pytest.mark.parametrize(("scene", "text", "wanted", "order"), ROWS[::3])
def test_neither_case_nor_spaces_nor_the_order_of_the_scene_matter(
    scene: str, text: str, wanted: str, order: str
) -> None:
    there = SCENES[scene]
    said = outcome(there, text)
    assert outcome(there, text.upper()) == said
    assert outcome(there, "  " + text.replace(" ", "\t \n")) == said
    turned = Vocabulary(things=dict(reversed(there.things.items())))
    assert outcome(turned, text)[0] == said[0] or "any" in said[0]


UNUSED = ("frabjous", "gently", "upwards", "42", "mug", "(", "🙂", "é", "red.exe")


@settings(max_examples=400, deadline=None)
@given(st.sampled_from(VALID), st.sampled_from(UNUSED), st.integers(0, 40))
def test_a_word_that_means_nothing_is_an_error_wherever_it_stands(
    row: tuple[str, str, str, str], odd: str, at: int
) -> None:
    scene, text, _, _ = row
    words = text.split()
    words.insert(at % (len(words) + 1), odd)
    assert isinstance(asked(SCENES[scene], " ".join(words)), GroundingError)


def test_unknown_nouns_and_colours_are_never_mapped_to_something_else() -> None:
    """150 phrases, written with those of ``unseen.txt``: none is guessed, each is answered."""
    _, *unknown = Path(__file__).with_name("unknown.txt").read_text().splitlines()
    assert len(unknown) == 150
    for text in unknown:
        found = asked(SCENES["blocks"], text)
        assert isinstance(found, GroundingError), text
        assert "for example" in str(found) or "There is: " in str(found), (text, str(found))


def test_of_unseen_instructions_most_are_understood_and_none_is_guessed() -> None:
    unseen = rows("unseen.txt")
    assert len(unseen) == 40
    said = [outcome(SCENES[scene], text)[0] for scene, text, *_ in unseen]
    right = [as_meant(*row) for row in unseen]
    assert sum(right) >= 24
    assert all(ok or text.startswith("!") for ok, text in zip(right, said, strict=True))


@pytest.mark.parametrize("scene", SCENES)
def test_the_examples_of_an_answer_are_understood_in_their_scene(scene: str) -> None:
    examples = SCENES[scene].examples()
    assert len(examples) == 3
    for text in examples:
        assert not isinstance(asked(SCENES[scene], text), GroundingError), text


def test_a_misspelt_word_names_the_nearest() -> None:
    with pytest.raises(GroundingError, match=r"'bleu' is not known here\. Did you mean 'blue'"):
        ground("put the bleu cube into the box", SCENES["blocks"])


def test_what_is_not_understood_says_what_is() -> None:
    with pytest.raises(GroundingError, match=r"'slowly'.*for example: 'put the red cube"):
        ground("put the cube into the box slowly", SCENES["cube"])
    with pytest.raises(GroundingError, match=r"nobody here can 'juggle'.*for example: 'put"):
        ground("juggle the ducks", SCENES["ducks"])


@settings(max_examples=60, deadline=None)
@given(st.permutations(["red", "green", "blue"]), st.sampled_from(["then", "and then", ". Then"]))
def test_then_orders_and_and_does_not(colours: list[str], then: str) -> None:
    parts = [f"put the {colour} cube into the box" for colour in colours]
    found = ground(f" {then} ".join(parts), SCENES["blocks"])
    assert found.order == tuple(f"{colour}_cube" for colour in colours)
    assert found.is_order_given
    assert not ground(" and ".join(parts), SCENES["blocks"]).is_order_given


ODD = ("5 cm", "-3", "0", "nan", "\x00", "🙂", "__import__('os')", "{}", "%s", "’", "ﬁ", "\u202e")
words = st.sampled_from([*sorted({word for row in ROWS for word in row[1].split()}), *ODD])


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(sorted(SCENES)), st.lists(words, max_size=25))
def test_no_words_in_any_order_do_harm(scene: str, said: list[str]) -> None:
    _understood_or_explained(SCENES[scene], " ".join(said))


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(sorted(SCENES)), st.text(max_size=200))
def test_no_text_does_harm(scene: str, text: str) -> None:
    _understood_or_explained(SCENES[scene], text)


def _understood_or_explained(scene: Vocabulary, text: str) -> None:
    found = asked(scene, text)
    if isinstance(found, GroundingError):
        assert f"`{found.kind}`" in DOCS
        assert found.exit_code == 2
        assert str(found)
        return
    moved = {goal["object"] for goal in found.goals}
    assert moved
    assert moved == set(found.order)
    assert all(scene.things[key].movable for key in moved)


@pytest.mark.parametrize(
    "text",
    [
        "put the cube into the box " * 400,
        "a" * 10_000,
        "the " * 499,
        "and " * 499,
        "of the " * 280,
        "red " * 290 + "cube",
    ],
)
def test_long_texts_end(text: str) -> None:
    with pytest.raises(GroundingError):
        ground(text, SCENES["cube"])


def test_an_instruction_beyond_the_limit_is_too_long() -> None:
    with pytest.raises(GroundingError, match=f"{MAX_CHARACTERS} is the most") as caught:
        ground("x" * (MAX_CHARACTERS + 1), SCENES["cube"])
    assert caught.value.kind == "too_long"


@pytest.mark.parametrize(
    ("said", "gap_m"),
    [
        ("with a gap of 2 cm", [0.015, 0.025]),
        ("with a gap of 10 to 12 mm", [0.01, 0.012]),
        ("with a gap of 1-3 centimetres", [0.01, 0.03]),
        ("", None),
    ],
)
def test_a_gap_is_the_one_that_was_said(said: str, gap_m: list[float] | None) -> None:
    (goal,) = ground(f"put the cube left of the box {said}", SCENES["cube"]).goals
    assert (goal.get("gap_m"), goal["direction"]) == (gap_m, "left")


def test_a_movement_says_how_far() -> None:
    for way in ("5 cm to the right", "to the right by 50 mm", "right 0.05 m"):
        (goal,) = ground(f"move the cube {way}", SCENES["cube"]).goals
        assert goal == {"kind": "moved", "object": "cube", "by_m": 0.05, "direction": "right"}
    with pytest.raises(GroundingError, match="does not say how far"):
        ground("move the cube to the right", SCENES["cube"])


def test_what_is_chosen_or_not_kept_is_said() -> None:
    two = ground("Put two ducks into the basket", SCENES["ducks"])
    assert two.choices[0].among == tuple(f"duck_{n}" for n in range(1, 6))
    assert any("planner's choice" in line for line in two.explanation)
    thrown = ground("Throw the sloth into the basket", SCENES["sloth"])
    assert any("carried there and let go" in line for line in thrown.explanation)


def test_a_small_thing_is_smaller_than_the_others_of_its_name() -> None:
    small, large = (0.02, 0.02, 0.02), (0.05, 0.05, 0.05)
    things = {
        key: replace(thing, size_m=small if key.endswith("_1") else large)
        if thing.movable
        else thing
        for key, thing in SCENES["sorting"].things.items()
    }
    scene = Vocabulary(things=things)
    found = ground("Put the small red cube into the green bin", scene)
    assert found.order == ("red_cube_1",)
    found = ground("Put the large green cube into the red bin", scene)
    assert found.order == ("green_cube_2",)
    for alike in ("Put the small sloth into the basket", "Put the big duck into the basket"):
        with pytest.raises(GroundingError) as caught:
            ground(alike, SCENES["mixed"])
        assert caught.value.kind == "unknown_object"


@pytest.mark.parametrize(
    "name", ["cube_into_box", "cube_on_block", "five_ducks_into_basket", "stack_two_cubes",
             "sort_by_colour", "stack_and_pack", "sloth_into_basket"],
)  # fmt: skip
def test_the_instruction_of_a_task_that_ships_asks_for_what_the_task_does(name: str) -> None:
    task = TaskFile.read(datasets_folder() / "tasks" / f"{name}.toml").task()
    found = ground(task.instruction, vocabulary_of(task))
    for key in task.manipulated:
        (goal,) = [goal for goal in found.goals if goal["object"] == key]
        assert task.goal_of(key) == (goal["kind"], goal.get("container", goal.get("support")))
