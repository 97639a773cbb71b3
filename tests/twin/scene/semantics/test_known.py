"""Objects that a task names keep their names and their Gaussians."""

from dataclasses import replace

import numpy as np
import pytest
from table_scene import World

from twin.naming.phrases import Asker
from twin.naming.things import NAMED, SemanticScene
from twin.naming.words import kind_of, label_of, names_of
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.semantics.describe import MIN_SPLATS, numbered, scene_by_default


def test_a_known_object_takes_what_the_segmenter_joined_with_it_and_no_more() -> None:
    # Thing 1 is mostly the duck's, thing 2 hardly, thing 3 not at all.
    labels = np.repeat([0, 1, 2, 3], [40, 50, 60, 30]).astype(np.uint16)
    duck = np.zeros(180, dtype=bool)
    duck[10:20] = True  # the segmenter saw background here
    duck[40:75] = True
    duck[90:100] = True
    keys, others, found = numbered(labels, {"duck": duck, "nowhere": np.zeros(180, dtype=bool)})
    assert (keys, others) == (["duck"], [2, 3])
    assert np.all(found[duck] == 1)
    assert np.all(found[40:90] == 1)
    assert np.all(found[100:150] == 2)
    assert np.all(found[150:] == 3)
    assert not found[:10].any()


def test_two_known_objects_in_one_thing_share_it_by_their_own_gaussians() -> None:
    labels = np.ones(100, dtype=np.uint16)
    first, second = np.arange(100) < 55, np.arange(100) >= 70
    keys, others, found = numbered(labels, {"a": first, "b": second})
    assert (keys, others) == (["a", "b"], [])
    assert np.bincount(found).tolist() == [0, 70, 30]


def test_without_known_objects_nothing_changes() -> None:
    labels = np.array([0, 2, 1, 2], dtype=np.uint16)
    keys, others, found = numbered(labels, {})
    np.testing.assert_array_equal(found, labels)
    assert (keys, others) == ([], [1, 2])


def test_a_handful_of_gaussians_is_no_object() -> None:
    few = np.arange(60) < MIN_SPLATS - 1
    keys, others, found = numbered(np.zeros(60, dtype=np.uint16), {"duck": few})
    assert (keys, others) == ([], [])
    assert not found.any()


@pytest.mark.parametrize(
    ("key", "is_open", "label", "kind", "called"),
    [
        ("duck_1", False, "yellow duck", "animal", "toy"),
        ("box", True, "yellow open box", "container", "container"),
        ("box", False, "yellow box", "other", "box"),
        ("basket", True, "yellow basket", "container", "container"),
        ("red_cube", False, "red cube", "other", "cube"),
    ],
)
def test_names_say_what_parts_to_look_for(
    key: str, is_open: bool, label: str, kind: str, called: str
) -> None:
    found = label_of(key, "yellow", is_open=is_open)
    assert found == label
    assert kind_of(found) == kind
    assert {called, "object"} <= names_of(found)


@pytest.fixture(scope="module")
def scene(tabletop: World) -> SemanticScene:
    truth = tabletop.true_instances()
    number = {name: key for key, name in tabletop.names.items()}
    known = {"tub": truth == number["blue open container"], "cube_7": truth == number["red cube"]}
    return scene_by_default(
        tabletop.cloud,
        [shot.viewpoint for shot in tabletop.train[:2]],
        Rasteriser(RasterConfig(threads=1)),
        known=known,
    )


def test_known_things_come_first_and_the_others_are_still_found(
    scene: SemanticScene, tabletop: World
) -> None:
    labels = [item.label for item in scene.instances]
    assert labels[:2] == ["blue tub", "red cube"]
    assert set(labels[2:]) == set(tabletop.names.values()) - {"blue open container", "red cube"}
    assert [item.source == NAMED for item in scene.instances[:3]] == [True, True, False]


def meant(scene: SemanticScene, text: str) -> list[int]:
    return [each.item.id for each in Asker(scene=scene).find(text).found]


def test_a_question_finds_the_task_s_own_words(scene: SemanticScene) -> None:
    assert meant(scene, "the cube") == [scene.instances[1].id]
    assert meant(scene, "tub") == [scene.instances[0].id]


def test_what_the_task_names_is_meant_and_not_what_looks_like_it(scene: SemanticScene) -> None:
    cube = scene.instances[1]
    double = replace(cube, id=99, source="default segmenter")
    both = replace(scene, instances=(*scene.instances, double))
    assert meant(both, "the red cube") == [cube.id]
    assert meant(both, "red thing") == [cube.id, 99]


def test_a_known_thing_without_a_table_is_named_all_the_same(tabletop: World) -> None:
    alone = tabletop.cloud.take(tabletop.true_instances() == 1)
    known = {"cube": np.ones(len(alone), dtype=bool)}
    found = scene_by_default(alone, [], Rasteriser(RasterConfig(threads=1)), known=known)
    assert [item.label for item in found.instances] == ["red cube"]


def test_a_container_has_its_parts_under_any_name(scene: SemanticScene) -> None:
    assert {"rim", "floor", "walls"} <= set(scene.instances[0].parts)
