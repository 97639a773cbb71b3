"""Soft bodies in a replay, and objects localised into each other: little is resolved."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bridge.geometry import se3
from twin.gate.gate import no_verdict
from twin.physics.soft import SoftHealth
from twin.physics.soft_world import SoftWorld
from twin.physics.world import World
from twin.replay.clearance.monitor import allowed_pairs
from twin.replay.config import ReplayConfig
from twin.replay.dynamics import free_start, lifted, outline_m, soft_models
from twin.replay.failure import NotEvaluatedError
from twin.replay.result import Burst, ReplayResult
from twin.replay.scene import ReplayScene
from twin.replay.verdict import replay_plan, terminal_factor

CONFIG = ReplayConfig()
SOUND = SoftHealth(num_inverted=0, max_stretch=1.1, is_finite=True)


def in_basket(script: SimpleNamespace) -> tuple[ReplayResult, object]:
    """States in which everything that is asked of the sloth holds."""
    scene = script.toy_scene()
    steps = 120
    stamps = (np.arange(steps) * 16_666_667).astype(np.int64)
    basket = scene.Ts_base_object["basket"]
    sloth = basket.copy()
    sloth[2, 3] += 0.04
    size = np.array(scene.task.objects["sloth"].size_m)
    result = ReplayResult(
        verdict=no_verdict(script.toy_plan(scene), ""),
        stamps_ns=stamps,
        joints_rad=np.zeros((steps, 6)),
        width_m=np.zeros(steps),
        Ts_base_tcp=np.tile(np.eye(4), (steps, 1, 1)),
        Ts_base_object={
            "sloth": np.tile(sloth, (steps, 1, 1)),
            "basket": np.tile(basket, (steps, 1, 1)),
        },
        finger_contact={"sloth": np.zeros(steps, dtype=bool)},
        clearance_m=np.zeros(steps),
        contacts=[],
        extents_m={"sloth": np.tile(size, (steps, 1))},
    )
    return result, scene


@pytest.fixture
def placed(script: SimpleNamespace) -> tuple[ReplayResult, object]:
    return in_basket(script)


def judged(result: ReplayResult, scene: object, burst: Burst | None = None) -> object:
    return terminal_factor(replace(result, burst=burst), scene, CONFIG, unreachable_ns=None)


def test_a_sound_toy_in_the_basket_passes(placed: tuple[ReplayResult, object]) -> None:
    assert judged(*placed).value is True


def test_a_toy_that_burst_never_passes_wherever_its_middle_is(
    placed: tuple[ReplayResult, object],
) -> None:
    burst = Burst(object_id="sloth", t_ns=1_500_000_000, found="it burst")
    factor = judged(*placed, burst=burst)
    assert (factor.value, factor.cause) == (False, "exploded")
    assert (factor.first_t_ns, factor.bodies) == (1_500_000_000, ("sloth",))


def test_a_toy_that_ends_inside_out_never_passes_although_its_extents_do(
    placed: tuple[ReplayResult, object],
) -> None:
    result, scene = placed
    broken = replace(result, broken={"sloth": "at the end: 3 of its tetrahedra are inside out"})
    factor = judged(broken, scene)
    assert (factor.value, factor.cause, factor.bodies) == (False, "shape", ("sloth",))
    task = replace(scene.task, success=({"kind": "no_finger_contact", "object": "sloth"},))
    assert judged(broken, replace(scene, task=task)).value is False, "whatever the task asks"


def test_extents_that_are_far_from_rest_or_no_numbers_fail(
    placed: tuple[ReplayResult, object],
) -> None:
    result, scene = placed
    for factor in (1.4, np.nan, np.inf):
        wide = {"sloth": result.extents_m["sloth"] * [factor, 1.0, 1.0]}
        judgement = judged(replace(result, extents_m=wide), scene)
        assert (judgement.value, judgement.cause) == (False, "shape")


@pytest.mark.parametrize(
    ("health", "bursts"),
    [
        (SOUND, False),
        (replace(SOUND, num_inverted=2), False),
        (replace(SOUND, max_stretch=3.0), False),
        (replace(SOUND, max_stretch=5.0), True),
        (replace(SOUND, max_stretch=float("nan")), True),
        (replace(SOUND, is_finite=False), True),
    ],
)
def test_what_counts_as_burst_while_it_moves(health: SoftHealth, bursts: bool) -> None:
    assert health.burst is bursts


def test_every_localised_toy_becomes_a_body_and_no_other(script: SimpleNamespace) -> None:
    scene = script.toy_scene("five_ducks_into_basket")
    assert set(soft_models(scene)) == {f"duck_{n}" for n in range(1, 6)}
    poses = {name: T for name, T in scene.Ts_base_object.items() if name != "duck_3"}
    assert "duck_3" not in soft_models(replace(scene, Ts_base_object=poses))
    assert soft_models(script.scene()) == {}
    body = soft_models(scene)["duck_1"]
    size = np.ptp(outline_m(scene.task.objects["duck_1"], body), axis=0)
    np.testing.assert_allclose(size, scene.task.objects["duck_1"].size_m, rtol=0.25)


@pytest.mark.slow
def test_a_sloth_is_picked_carried_and_put_into_the_basket(script: SimpleNamespace) -> None:
    scene = script.toy_scene()
    result = replay_plan(script.toy_plan(scene), scene, CONFIG)
    verdict = result.verdict
    assert verdict.accepted is True, verdict.reason
    assert "+xpbd" in verdict.engine
    assert result.nodes_m["sloth"].shape[::2] == (len(result.stamps_ns), 3)
    assert len(result.extents_m["sloth"]) == len(result.stamps_ns)
    kinds = {item["kind"] for item in verdict.findings}
    assert kinds == {"inside", "settled", "no_finger_contact", "shape", "allowed_contacts"}


def test_a_replay_ends_where_a_toy_bursts_and_is_rejected(
    script: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = script.toy_scene()
    calls = iter(range(10_000))
    monkeypatch.setattr(
        SoftWorld, "health", lambda self, name: replace(SOUND, is_finite=next(calls) < 20)
    )
    result = replay_plan(script.toy_plan(scene), scene, CONFIG)
    terminal = result.verdict.terminal
    assert (terminal.value, terminal.cause) == (False, "exploded")
    assert result.verdict.accepted is False
    assert len(result.stamps_ns) == 20, "what comes after is not kept"
    assert terminal.first_t_ns == pytest.approx(20 / 60 * 1e9, rel=1e-6)


def test_a_toy_whose_nodes_fly_apart_ends_the_replay_and_never_passes(
    script: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = script.toy_scene()
    steps, step = iter(range(100_000)), World.step

    def blown_up(self: World) -> None:
        if next(steps) == 100:
            solver = self.soft_bodies()._begun()
            apart = np.random.default_rng(0).normal(0.0, 1e4, solver.velocities(0).shape)
            solver.set_velocities(0, apart)
        step(self)

    monkeypatch.setattr(World, "step", blown_up)
    result = replay_plan(script.toy_plan(scene), scene, CONFIG)
    terminal = result.verdict.terminal
    assert (terminal.value, terminal.cause, terminal.bodies) == (False, "exploded", ("sloth",))
    assert result.verdict.accepted is False
    assert "sloth" in result.broken
    assert len(result.stamps_ns) < 60, "it ended where the toy burst"


def test_what_a_stage_put_down_may_go_on_lying_there_and_the_gripper_may_not(
    script: SimpleNamespace,
) -> None:
    stages = script.toy_plan(script.toy_scene("five_ducks_into_basket")).stages
    begins = {stage.id: stage.t_start_ns for stage in stages}
    duck, gripper = frozenset(("duck_1", "basket")), frozenset(("gripper", "basket"))
    assert duck not in allowed_pairs(stages, begins["carry_1"])
    assert {duck, gripper} <= allowed_pairs(stages, begins["release_1"])
    later = allowed_pairs(stages, begins["pick_2"])
    assert duck in later
    assert gripper not in later
    assert frozenset(("duck_1", "table")) not in later, "it was let go in the basket"


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
