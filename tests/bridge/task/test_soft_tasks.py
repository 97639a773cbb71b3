"""Tasks with soft toys: what their files say, and when a toy counts as put away."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from bridge.errors import UsageError
from bridge.task.predicate import Rollout, all_hold, evaluate_success, objects_done
from bridge.task.task_file import Task, load_task

SOFT = ("sloth_into_basket", "five_ducks_into_basket")


def rollout(
    task: Task, *, outside: str | None = None, stretch: float = 1.0, extents: bool = True
) -> Rollout:
    """Every toy at rest in the basket, one of them beside it, all of them stretched along x."""
    steps = 30
    still = np.tile(np.eye(4), (steps, 1, 1))
    still[:, :3, 3] = [0.5, 0.2, 0.0]
    poses = {"basket": still}
    for key in task.manipulated:
        poses[key] = still.copy()
        poses[key][:, 2, 3] = 0.04
        if key == outside:
            poses[key][:, 0, 3] += 0.3
    sizes = {key: np.array(task.objects[key].size_m) for key in task.manipulated}
    return Rollout(
        stamps_ns=np.arange(steps, dtype=np.int64) * 33_000_000,
        Ts_base_object=poses,
        finger_contact={key: np.zeros(steps, dtype=bool) for key in task.manipulated},
        extents_m={key: np.tile(size * [stretch, 1, 1], (steps, 1)) for key, size in sizes.items()}
        if extents
        else {},
    )


@pytest.mark.parametrize("name", SOFT)
def test_toys_at_rest_in_the_basket_are_a_success(name: str) -> None:
    task = load_task(name)
    assert all_hold(evaluate_success(task, rollout(task))) is True
    assert all_hold(evaluate_success(task, rollout(task, outside=task.manipulated[0]))) is False


@pytest.mark.parametrize(("stretch", "holds"), [(1.2, True), (1.3, False), (0.7, False)])
def test_a_toy_that_lost_its_shape_is_no_success(stretch: float, holds: bool) -> None:
    task = load_task("sloth_into_basket")
    findings = evaluate_success(task, rollout(task, stretch=stretch))
    shape = next(finding for finding in findings if finding.kind == "shape")
    assert shape.value is holds
    assert all_hold(findings) is holds


def test_an_unknown_shape_leaves_the_verdict_open() -> None:
    task = load_task("sloth_into_basket")
    findings = evaluate_success(task, rollout(task, extents=False))
    assert all_hold(findings) is None
    assert "not known" in next(f.detail for f in findings if f.kind == "shape")


def test_the_shape_of_a_rigid_object_holds() -> None:
    task = load_task("cube_into_box")
    spec = {"kind": "shape", "object": "cube", "tolerance_fraction": 0.1}
    changed = Task(**{**vars(task), "success": (spec,)})
    still = np.tile(np.eye(4), (2, 1, 1))
    state = Rollout(stamps_ns=np.array([0, 1]), Ts_base_object={"cube": still}, finger_contact={})
    assert all_hold(evaluate_success(changed, state)) is True


def test_ducks_are_counted_one_by_one() -> None:
    task = load_task("five_ducks_into_basket")
    done = objects_done(evaluate_success(task, rollout(task, outside="duck_2")), task.manipulated)
    assert done == {f"duck_{k}": k != 2 for k in range(1, 6)}


def test_five_ducks_take_fifteen_control_steps_in_order() -> None:
    stages = load_task("five_ducks_into_basket").stages
    assert len(stages) == 15
    verbs = [next(verb for verb in ("grasp", "carry", "release") if verb in s) for s in stages]
    assert verbs == ["grasp", "carry", "release"] * 5
    handled = [stage[verb] for stage, verb in zip(stages, verbs, strict=True)]
    assert handled == [f"duck_{k}" for k in range(1, 6) for _ in range(3)]


@pytest.mark.parametrize("name", SOFT)
def test_starts_never_overlap(name: str) -> None:
    task = load_task(name)
    reach = {
        key: float(np.hypot(*model.size_m[:2])) / 2 + (0.006 if model.fixed else 0.0)
        for key, model in task.objects.items()
    }
    for seed in range(200):
        poses = task.draw_start(np.random.default_rng(seed))
        for a, b in combinations(task.manipulated, 2):
            assert np.linalg.norm(poses[a][:2, 3] - poses[b][:2, 3]) > reach[a] + reach[b]
        for key in task.manipulated:
            gap = poses["basket"][1, 3] - poses[key][1, 3]
            # The basket is nearly parallel to y: half its depth, turned by its largest yaw.
            assert gap > 0.103 * np.cos(0.15) + 0.128 * np.sin(0.15) + reach[key] - 0.02
            assert poses[key][2, 3] == task.objects[key].size_m[2] / 2


def test_a_basket_is_stood_in_for_by_an_open_box_and_a_toy_by_the_box_around_it() -> None:
    task = load_task("sloth_into_basket")
    assert len(task.objects["basket"].panels()) == 5
    assert task.objects["basket"].inner_m == pytest.approx((0.24, 0.19, 0.085))
    assert task.objects["basket"].rest_height_m == 0.0
    ((centre, size),) = task.objects["sloth"].panels()
    np.testing.assert_array_equal(centre, np.zeros(3))
    assert tuple(size) == task.objects["sloth"].size_m


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('mesh = "sloth"', 'mesh = "elephant"', "'elephant' is unknown. Known: basket"),
        ('shape = "mesh"\nmesh = "sloth"', 'shape = "mesh"', '"mesh" is a required property'),
        ('shape = "mesh"\nmesh = "sloth"', 'shape = "box"', "unknown key 'soft'"),
        ("soft = {", "# soft = {", '"soft" is a required property'),
        ("young_pa", "young_kpa", "unknown key 'young_kpa'. Did you mean 'young_pa'"),
    ],
)
def test_half_a_toy_is_refused(tmp_path: Path, old: str, new: str, match: str) -> None:
    text = (Path("datasets") / "tasks" / "sloth_into_basket.toml").read_text()
    path = tmp_path / "broken.toml"
    path.write_text(text.replace(old, new))
    with pytest.raises(UsageError, match=match):
        load_task(str(path))
