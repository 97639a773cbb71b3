"""Instructions: those given, our own, and laws that hold for any."""

import json
import os
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from spoken_scenes import SCENES, as_meant, asked, outcome

from bridge.geometry import se3
from twin.plan.ground.grammar import ground
from twin.plan.ground.vocabulary import (
    KINDS,
    GroundingError,
    Vocabulary,
    vocabulary_from_labels,
)
from twin.plan.ground.words import MAX_CHARACTERS

ROOT = Path(__file__).parents[4]
SHARED = Path(os.environ.get("GST_SHARED_DATA", ROOT.parent / "shared" / "data"))
GIVEN = SHARED / "planning" / "instructions.json"


def rows() -> list[tuple[str, str, str, str]]:
    """Scene, instruction, what is expected, and the order or nothing."""
    found = []
    for line in Path(__file__).with_name("paraphrases.txt").read_text().splitlines():
        if line and not line.startswith("#"):
            scene, text, wanted, *order = (part.strip() for part in line.split(" | "))
            found.append((scene, text, wanted, order[0] if order else ""))
    return found


ROWS = rows()


@pytest.mark.parametrize(("scene", "text", "wanted", "order"), ROWS)
def test_our_own_instructions(scene: str, text: str, wanted: str, order: str) -> None:
    assert as_meant(scene, text, wanted, order), outcome(SCENES[scene], text)


def test_there_are_enough_of_our_own() -> None:
    errors = [row for row in ROWS if row[2].startswith("!")]
    assert len(ROWS) - len(errors) >= 60
    assert len(errors) >= 40


@pytest.mark.skipif(not GIVEN.is_file(), reason="the given instructions are not on this machine")
def test_all_given_instructions() -> None:
    given_file = json.loads(GIVEN.read_text())
    scenes = {name: vocabulary_from_labels(about) for name, about in given_file["scenes"].items()}
    wrong = [case["id"] for case in given_file["cases"] if not _scores(case, scenes)]
    assert wrong == []


def _scores(case: dict[str, Any], scenes: dict[str, Vocabulary]) -> bool:
    """The scoring that the file itself describes."""
    expected = case["expected"]
    try:
        found = ground(case["text"], scenes[case["scene"]])
    except GroundingError as error:
        fits = case["outcome"] == "error" and error.kind == expected["error"]
        return (
            fits
            and error.exit_code == 2
            and all(name in str(error) for name in expected["names_candidates"])
        )
    chosen = {key: f"any of {item.count}" for item in found.choices for key in item.chosen}
    goals = [
        dict(goal) | {"object": chosen.get(goal["object"], goal["object"])} for goal in found.goals
    ]
    mine = {json.dumps(goal, sort_keys=True) for goal in goals}
    theirs = Counter(json.dumps(goal, sort_keys=True) for goal in expected.get("goal", []))
    in_order = expected.get("order") in ("any", list(found.order))
    path_noted = "path:" not in expected.get("note", "") or bool(found.path)
    return Counter(mine) == theirs and in_order and path_noted


@pytest.mark.parametrize(("scene", "text", "wanted", "order"), ROWS[::3])
def test_neither_case_nor_spaces_nor_the_order_of_the_scene_matter(
    scene: str, text: str, wanted: str, order: str
) -> None:
    there = SCENES[scene]
    said = outcome(there, text)
    assert outcome(there, text.upper()) == said
    assert outcome(there, "  " + text.replace(" ", "\t \n")) == said
    turned = Vocabulary(things=dict(reversed(there.things.items())))
    assert outcome(turned, text)[0] == said[0] or "any" in said[0] or "tower" in text


ODD = ("5 cm", "-3", "0", "nan", "\x00", "🙂", "__import__('os')", "{}", "%s", "’", "ﬁ", "\u202e")
words = st.sampled_from([*sorted({word for row in ROWS for word in row[1].split()}), *ODD])


@settings(max_examples=120, deadline=None)
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
        assert found.kind in KINDS
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
        "put " + "the cube and " * 140 + "the cube into the box",
        "except " * 285,
        "'s " * 299,
    ],
)
def test_long_texts_end(text: str) -> None:
    with pytest.raises(GroundingError):
        ground(text, SCENES["cube"])


def test_an_instruction_beyond_the_limit_is_too_long() -> None:
    with pytest.raises(GroundingError, match=f"{MAX_CHARACTERS} is the most") as caught:
        ground("x" * (MAX_CHARACTERS + 1), SCENES["cube"])
    assert caught.value.kind == "too_long"


def camera_at(yaw_rad: float, *, down: bool = False) -> np.ndarray:
    """T_base_camera of a camera that looks along a yaw, a little or wholly downwards."""
    ahead = np.array([np.cos(yaw_rad), np.sin(yaw_rad), 0.0])
    right = np.array([ahead[1], -ahead[0], 0.0])
    z = np.array([0.0, 0.0, -1.0]) if down else ahead
    y = -ahead if down else np.array([0.0, 0.0, -1.0])
    T = np.eye(4)
    T[:3, :3] = np.stack([right, y, z], axis=1)
    return T


@pytest.mark.parametrize("down", [False, True])
@pytest.mark.parametrize("yaw", [0.0, 0.7, np.pi, -2.0])
def test_directions_may_be_those_a_camera_sees(yaw: float, down: bool) -> None:
    things = SCENES["cube"].things
    scene = Vocabulary(things=things, cameras={"side": camera_at(yaw, down=down)})
    for word, offset in (("left", np.pi / 2), ("right", -np.pi / 2), ("forwards", 0.0)):
        found = ground(f"move the cube 10 cm {word} as seen from the side camera", scene)
        wanted = [np.cos(yaw + offset), np.sin(yaw + offset), 0.0]
        np.testing.assert_allclose(found.goals[0]["direction"], wanted, atol=1e-6)
        assert any("camera side" in line for line in found.explanation)
    plain = ground("move the cube 10 cm left", scene)
    assert plain.goals[0]["direction"] == "left"
    assert any("as the robot sees" in line for line in plain.explanation)


def test_a_camera_that_is_not_there_is_named_with_those_that_are() -> None:
    scene = Vocabulary(
        things=SCENES["cube"].things, cameras={"side": np.eye(4), "wrist": np.eye(4)}
    )
    with pytest.raises(GroundingError, match="side, wrist") as caught:
        ground("put the cube left of the box as seen from the top camera", scene)
    assert caught.value.kind == "unknown_camera"


def test_limits_on_the_way_are_records_of_the_constraint_schema() -> None:
    found = ground(
        "Put the red cube into the box, stay at least 5 cm away from its walls until you are above "
        "it, keep it upright and slowly, no higher than 30 cm above the table",
        SCENES["blocks"],
    )
    kinds = {limit.constraint["kind"]: dict(limit.constraint) for limit in found.path}
    assert kinds["clearance"] == {
        "kind": "clearance",
        "obj": "red_cube",
        "against": "box",
        "min": 0.05,
    }
    assert kinds["upright"] == {"kind": "upright", "obj": "red_cube", "max_deg": 15.0}
    assert kinds["height"] == {"kind": "height", "obj": "red_cube", "max": 0.3}
    assert kinds["speed"] == {"kind": "speed", "max": 0.1}
    until = {limit.constraint["kind"]: limit.until_release for limit in found.path}
    assert until == {"clearance": True, "upright": False, "height": False, "speed": False}


def test_what_is_passed_over_or_chosen_is_said() -> None:
    odd = ground("Put the shiny red cube into the box", SCENES["blocks"])
    assert odd.remarks == ("not understood, and passed over: shiny",)
    two = ground("Put two ducks into the basket", SCENES["ducks"])
    assert two.choices[0].among == tuple(f"duck_{n}" for n in range(1, 6))
    assert any("planner's choice" in line for line in two.explanation)
    thrown = ground("Throw the sloth into the basket", SCENES["sloth"])
    assert any("letting go" in line for line in thrown.remarks)


def test_a_small_thing_is_smaller_than_the_others() -> None:
    small, large = (0.02, 0.02, 0.02), (0.05, 0.05, 0.05)
    things = dict(SCENES["sorting"].things)
    sized = {
        key: type(thing)(
            id=key,
            label=thing.label,
            colour=thing.colour,
            movable=thing.movable,
            container=thing.container,
            size_m=small if key.endswith("_1") else large,
        )
        for key, thing in things.items()
        if thing.movable
    }
    scene = Vocabulary(things={**things, **sized})
    found = ground("Put the small red cube into the green bin", scene)
    assert found.order == ("red_cube_1",)
    found = ground("Put the large green cube into the red bin", scene)
    assert found.order == ("green_cube_2",)


def test_a_turned_camera_does_not_change_what_is_where() -> None:
    turned = se3.transform_from(np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.1, 0.2, 0.3]))
    scene = Vocabulary(things=SCENES["cube"].things, cameras={"side": turned})
    assert ground("Put the cube into the box", scene).goals == (
        {"kind": "inside", "object": "cube", "container": "box"},
    )
