"""What phrases mean among things made by hand: where they are is known."""

from unittest.mock import Mock

import numpy as np
import pytest

from bridge.geometry import se3
from twin.naming.phrases import Asker
from twin.naming.things import Instance, SemanticScene, SemanticsError
from twin.naming.words import names_of, words_of

THINGS = {
    "red cube": ((0.0, -0.2, 0.02), (0.04, 0.04, 0.04), (200, 20, 20)),
    "green cube": ((0.2, 0.2, 0.12), (0.05, 0.05, 0.04), (20, 160, 40)),
    "blue open container": ((0.2, 0.2, 0.05), (0.2, 0.2, 0.1), (20, 50, 190)),
    "yellow ball": ((-0.2, 0.0, 0.03), (0.06, 0.06, 0.06), (220, 200, 20)),
    "grey cylinder": ((-0.2, 0.3, 0.05), (0.08, 0.08, 0.1), (170, 172, 170)),
    "red box": ((0.0, 0.05, 0.03), (0.1, 0.05, 0.06), (190, 30, 30)),
    "brown thing": ((0.3, -0.3, 0.05), (0.26, 0.1, 0.1), (110, 80, 50)),
    "cyan block": ((0.5, -0.6, 0.05), (0.12, 0.09, 0.09), (0, 190, 200)),
}
PARTS = {"blue open container": ("rim", "floor", "walls"), "grey cylinder": ("handle",)}
EYE = np.array([-1.0, 0.0, 0.8])
"""Looks along +x: left is +y."""


def asker() -> Asker:
    instances = []
    for number, (label, (place, size, color)) in enumerate(THINGS.items(), start=1):
        mask = np.arange(30) // 4 == number - 1
        T = np.eye(4)
        T[:3, 3] = place
        instances.append(
            Instance(
                id=number,
                label=label,
                mask=mask,
                score=1.0,
                source="test",
                color_srgb=color,
                T_base_instance=T,
                size_m=size,
                parts=dict.fromkeys(PARTS.get(label, ()), mask),
            )
        )
    labels = (np.arange(30) // 4 + 1).astype(np.uint16)
    T_base_camera = se3.look_at(EYE, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    scene = SemanticScene(instances=tuple(instances), labels=labels, source="test")
    return Asker(scene=scene, T_base_camera=T_base_camera)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("red cube", {"red cube"}),
        ("the red block", {"red cube", "red box"}),
        ("the basket", {"blue open container"}),
        ("every object", set(THINGS)),
        ("everything", set(THINGS)),
        ("the small cube", {"red cube"}),
        ("the large cube", {"green cube"}),
        ("the white mug", {"grey cylinder"}),  # in shade white is grey
        ("the recycling bin", {"blue open container"}),  # what for, it does not show
        ("the lime cube", {"green cube"}),
        ("the parcel", {"brown thing"}),  # noisy depth hides its shape; the block may be a cup
        ("a cyan cup", {"cyan block"}),
        ("yellow", {"yellow ball"}),
        ("the left cube", {"green cube"}),
        ("the right cube", {"red cube"}),
        ("the nearest thing", {"grey cylinder"}),
        ("the cube right of the red box", {"red cube"}),
        ("the ball to the left of the cube", {"yellow ball"}),
        ("the thing left of the red cube", {"red box"}),
        ("the things left of the yellow ball", {"green cube", "blue open container",
                                                "grey cylinder", "red box"}),
        ("the cube on the container", {"green cube"}),
        ("the container under the green cube", {"blue open container"}),
        ("the thing in front of the red box", {"yellow ball"}),
        ("the box behind the ball", {"red box"}),
    ],
)  # fmt: skip
def test_a_phrase_means_what_a_person_means(text: str, expected: set[str]) -> None:
    answer = asker().find(text)
    assert {each.item.label for each in answer.found} == expected
    assert answer.why == ""


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("handle of the mug", {("grey cylinder", "handle")}),
        ("the bin's rim", {("blue open container", "rim")}),
        ("rim", {("blue open container", "rim")}),
        ("the walls of the blue box", {("blue open container", "walls")}),
    ],
)
def test_parts_are_found_with_their_things(text: str, expected: set[tuple[str, str]]) -> None:
    found = asker().find(text).found
    assert {(each.item.label, each.part) for each in found} == expected
    assert all((each.mask == each.item.parts[each.part]).all() for each in found)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("the purple cube", "there is blue open container, brown thing"),
        ("red frobnicator", "not known here: frobnicator; there is"),
        ("the lime", "not known here: lime"),
        ("the wall", "say whose wall"),
        ("the floor", "say whose floor"),
        ("the handle of the cube", "nothing like that has a handle"),
        ("the yellow duck", "there is"),  # a ball is none
        ("the book", "there is"),
        ("the cube in the ball", "none of 2 is in that"),
        ("the ball on the cube", "none of 1 is on that"),
        ("the cube left of the sofa", "not known here: sofa"),
        ("the cube left of", "names nothing"),
    ],
)
def test_what_is_not_there_is_answered_no_and_why(text: str, why: str) -> None:
    answer = asker().find(text)
    assert answer.found == ()
    assert why in answer.why


def test_a_text_that_names_nothing_is_refused() -> None:
    with pytest.raises(SemanticsError, match="names nothing"):
        asker().find("the of a")


def test_an_empty_scene_answers_with_nothing() -> None:
    scene = SemanticScene(instances=(), labels=np.zeros(3, dtype=np.uint16), source="test")
    assert Asker(scene=scene).find("the left cube").found == ()


def test_a_model_answers_with_its_shades_and_its_own_words() -> None:
    plain = asker()
    meaning = Mock(return_value=[0.1, 0.0, 0.9, 0.0, 0.6, 0.2, 0.0, 0.0])
    model = Asker(scene=plain.scene, T_base_camera=plain.T_base_camera, meaning=meaning)
    found = model.find("the shiny frobnicator").found
    meaning.assert_called_once_with("shiny frobnicator")
    assert [(each.item.id, each.score) for each in found] == [(3, 0.9), (5, 0.6)]


def test_words_are_lower_case_singular_and_without_articles() -> None:
    assert words_of("The Duck's two boxes, glass feet!") == ["duck", "two", "box", "glass", "foot"]


@pytest.mark.parametrize(
    ("label", "word", "answers"),
    [
        ("blue open box", "mug", False),
        ("blue open box", "bowl", False),
        ("blue open box", "tray", True),
        ("white bowl", "mug", False),
        ("white bowl", "bowl", True),
        ("grey open container", "mug", True),
    ],
)
def test_what_somebody_named_is_nothing_else(label: str, word: str, answers: bool) -> None:
    assert (word in names_of(label)) is answers


def test_what_no_hand_holds_is_no_book() -> None:
    assert "book" in names_of("black slab", 0.3) - names_of("black slab", 0.6)
