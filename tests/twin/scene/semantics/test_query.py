from collections.abc import Sequence

import numpy as np
import pytest

from twin.naming.things import Instance, SemanticScene, SemanticsError
from twin.naming.words import kind_of, words_of
from twin.scene.semantics.language import Query, query

SIZES_M = {
    "red cube": (0.04, 0.04, 0.04),
    "blue open container": (0.2, 0.2, 0.1),
    "yellow toy": (0.07, 0.05, 0.06),
    "brown toy": (0.16, 0.1, 0.06),
    "red box": (0.1, 0.05, 0.05),
}
PARTS = {"blue open container": ("rim", "handle", "floor"), "yellow toy": ("body", "head"),
         "brown toy": ("body", "head", "limbs")}  # fmt: skip


def scene() -> SemanticScene:
    instances = []
    for number, (label, size) in enumerate(SIZES_M.items(), start=1):
        mask = np.arange(20) // 4 == number - 1
        instances.append(
            Instance(
                id=number,
                label=label,
                mask=mask,
                support=5,
                seen=5,
                score=1.0,
                source="test",
                color_srgb=(1, 2, 3),
                T_base_instance=np.eye(4),
                size_m=size,
                parts=dict.fromkeys(PARTS.get(label, ()), mask),
            )
        )
    labels = (np.arange(20) // 4 + 1).astype(np.uint16)
    return SemanticScene(instances=tuple(instances), labels=labels, source="test")


def found(answer: Query) -> set[str]:
    names = dict(enumerate(SIZES_M, start=1))
    return {names[number] for number, value in answer.objects.items() if value > 0.5}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("red cube", {"red cube"}),
        ("the red block", {"red cube", "red box"}),
        ("basket", {"blue open container"}),
        ("the blue bowl", {"blue open container"}),
        ("all ducks", {"yellow toy"}),
        ("sloth", {"brown toy"}),
        ("toys", {"yellow toy", "brown toy"}),
        ("every object", set(SIZES_M)),
        ("small red thing", {"red cube"}),
        ("green cube", set()),
        ("yellow", {"yellow toy"}),
        ("gray box", set()),
    ],
)
def test_the_lexicon_finds_what_a_person_means(text: str, expected: set[str]) -> None:
    answer = query(scene(), text)
    assert found(answer) == expected
    assert answer.source == "lexicon"
    assert set(answer.objects.values()) <= {0.0, 1.0}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("handle of the basket", {(2, "handle")}),
        ("the duck's head", {(3, "head")}),
        ("heads of toys", {(3, "head"), (4, "head")}),
        ("sloth legs", {(4, "limbs")}),
        ("rim", {(2, "rim")}),
    ],
)
def test_parts_are_found_with_their_objects(text: str, expected: set[tuple[int, str]]) -> None:
    answer = query(scene(), text)
    assert {key for key, value in answer.parts.items() if value > 0} == expected


def test_a_text_without_a_part_has_no_part_activations() -> None:
    assert query(scene(), "the duck").parts == {}


def test_words_nobody_knows_are_named() -> None:
    answer = query(scene(), "red frobnicator")
    assert answer.remark == "not in the lexicon: frobnicator"
    assert answer.best() is None


def test_a_text_that_names_nothing_is_refused() -> None:
    with pytest.raises(SemanticsError, match="names nothing"):
        query(scene(), "the of a")


def test_an_empty_scene_answers_with_nothing() -> None:
    empty = SemanticScene(instances=(), labels=np.zeros(3, dtype=np.uint16), source="test")
    answer = query(empty, "cube")
    assert answer.objects == {}
    assert answer.best() is None


class Encoder:
    """Texts on axes: "duck" is the second axis, phrases that mean anything are the first."""

    source = "made model"

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        return np.array(
            [[0.0, 1.0, 0.0] if "duck" in text else [1.0, 0.0, 0.0] for text in texts],
            dtype=np.float32,
        )


def test_a_model_answers_with_its_name_and_shades() -> None:
    embeddings = np.array(
        [[1, 0.0, 0], [0.9, 0.1, 0], [0.2, 0.9, 0], [0.7, 0.7, 0], [1, 0, 0.1]], dtype=np.float32
    )
    answer = query(scene(), "the duck's head", embeddings=embeddings, encoder=Encoder())
    assert answer.source == "made model"
    assert answer.best() == 3
    assert answer.objects[4] == pytest.approx(0.5, abs=1e-6)
    assert answer.parts[3, "head"] == answer.objects[3] > 0.99
    longer = query(scene(), "duck", embeddings=7 * embeddings, encoder=Encoder())
    assert longer.objects == pytest.approx(answer.objects)


def test_embeddings_of_another_scene_are_refused() -> None:
    with pytest.raises(SemanticsError, match=r"5 instances and embeddings of shape \(2, 3\)"):
        query(scene(), "duck", embeddings=np.ones((2, 3), dtype=np.float32), encoder=Encoder())


def test_words_are_lower_case_singular_and_without_articles() -> None:
    assert words_of("The Duck's two boxes, glass feet!") == ["duck", "two", "box", "glass", "foot"]


@pytest.mark.parametrize(
    ("label", "kind"),
    [
        ("blue open container", "container"),
        ("wicker basket", "container"),
        ("yellow toy", "animal"),
        ("rubber duck", "animal"),
        ("red cube", "other"),
        ("red box", "other"),
    ],
)
def test_the_label_says_which_parts_to_look_for(label: str, kind: str) -> None:
    assert kind_of(label) == kind
