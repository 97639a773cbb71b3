"""Objects that were localised into each other: little is resolved, much is refused."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bridge.geometry import se3
from twin.replay.config import ReplayConfig
from twin.replay.dynamics import free_start, lifted, outline_m
from twin.replay.failure import NotEvaluatedError
from twin.replay.scene import ReplayScene
from twin.replay.verdict import replay_plan


def with_cubes(script: SimpleNamespace, gap_m: float) -> ReplayScene:
    """Two cubes side by side along x, this far apart."""
    scene = script.scene()
    model = scene.task.objects["cube"]
    objects = {**scene.task.objects, "other": replace(model, id="other")}
    poses = dict(scene.Ts_base_object)
    for name, x in (("cube", 0.45), ("other", 0.45 + 0.04 + gap_m)):
        poses[name] = se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([x, -0.1, 0.02]))
    return replace(scene, task=replace(scene.task, objects=objects), Ts_base_object=poses)


def test_objects_apart_stay_where_they_are(script: SimpleNamespace) -> None:
    scene = with_cubes(script, 0.001)
    free = free_start(scene, {})
    for name, T in scene.Ts_base_object.items():
        assert np.array_equal(free.Ts_base_object[name], T)


@pytest.mark.parametrize("depth_m", [0.001, 0.003, 0.0055])
def test_a_small_overlap_is_parted_by_half_each(script: SimpleNamespace, depth_m: float) -> None:
    scene = with_cubes(script, -depth_m)
    free = free_start(scene, {})
    first, second = (free.Ts_base_object[name][:3, 3] for name in ("cube", "other"))
    assert second[0] - first[0] == pytest.approx(0.04, abs=6e-4)
    middle = 0.45 + 0.02 - depth_m / 2
    assert (first[0] + second[0]) / 2 == pytest.approx(middle, abs=1e-4)
    assert np.array_equal(scene.Ts_base_object["cube"][:3, 3], [0.45, -0.1, 0.02]), "not altered"


def test_a_large_overlap_is_refused_with_both_names_and_the_depth(script: SimpleNamespace) -> None:
    with pytest.raises(NotEvaluatedError, match=r"^cube starts 10 mm inside other"):
        free_start(with_cubes(script, -0.01), {})


def test_a_container_does_not_give_way(script: SimpleNamespace) -> None:
    scene = script.scene()
    box = scene.Ts_base_object["box"]
    model = scene.task.objects["box"]
    wall = box[:3, 3] + np.array([model.size_m[0] / 2, 0.0, 0.03])
    T = se3.transform_from(np.array([1.0, 0, 0, 0]), wall + np.array([0.017, 0.0, 0.0]))
    scene = replace(scene, Ts_base_object={"box": box, "cube": T})
    free = free_start(scene, {})
    assert np.array_equal(free.Ts_base_object["box"], box)
    moved = free.Ts_base_object["cube"][0, 3] - T[0, 3]
    assert moved == pytest.approx(0.003, abs=6e-4)


def test_a_replay_that_starts_deep_in_another_object_is_not_evaluated(
    script: SimpleNamespace,
) -> None:
    scene = with_cubes(script, -0.02)
    with pytest.raises(NotEvaluatedError, match="20 mm inside"):
        replay_plan(script.plan(script.scene()), scene, ReplayConfig())


def test_what_reaches_into_the_table_is_lifted_onto_it(script: SimpleNamespace) -> None:
    model = script.scene().task.objects["cube"]
    T = se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([0.5, 0.0, 0.005]))
    height = lifted(T, outline_m(model, None), 0.0)[2, 3]
    assert height == pytest.approx(0.0202, abs=1e-9)
    assert lifted(T, outline_m(model, None), -0.1)[2, 3] == T[2, 3]
