"""Predicted final states: which poses are compared, modulo what, and what has no interval."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from state_samples import (
    IN_BOX_M,
    PLAN_ID,
    Seen,
    localised_episode,
    plan_of,
    posed,
    recorded_episode,
    replay_episode,
)

from bridge.episode.reader import Episode
from bridge.task.task_file import ObjectModel
from evaluator.compare.states import StateSummary, state_results, summarise_states
from evaluator.compare.summaries import recorded_task
from evaluator.metrics.state import turn_between_rad, turns_alike

LIFTED_M = (0.45, -0.1, 0.25)
Made = Callable[..., tuple[StateSummary, ...]]


def in_box(x_m: float = 0.0, y_m: float = 0.0, yaw_rad: float = 0.0) -> np.ndarray:
    return posed((IN_BOX_M[0] + x_m, IN_BOX_M[1] + y_m, IN_BOX_M[2]), yaw_rad)


def model(shape: str, size_m: tuple[float, float, float], **fields: str) -> ObjectModel:
    return ObjectModel(id="x", shape=shape, size_m=size_m, color_srgb=(0, 0, 0), **fields)


@pytest.mark.parametrize(
    ("thing", "count"),
    [
        (model("box", (0.04, 0.04, 0.04)), 24),
        (model("box", (0.04, 0.04, 0.08)), 8),
        (model("box", (0.04, 0.05, 0.08)), 4),
        (model("open_box", (0.2, 0.2, 0.1)), 4),
        (model("open_box", (0.2, 0.3, 0.1)), 2),
        (model("mesh", (0.2, 0.3, 0.1), mesh="basket"), 2),
        (model("mesh", (0.1, 0.1, 0.1), mesh="duck"), 1),
        (model("scanned", (0.1, 0.1, 0.1)), 1),
        (model("scanned", (0.1, 0.1, 0.1), symmetry="cube"), 24),
    ],
)
def test_each_shape_has_its_turns(thing: ObjectModel, count: int) -> None:
    turns = turns_alike(thing)
    assert len(turns) == count
    np.testing.assert_array_equal(turns[0], np.eye(3))
    for R in turns:  # a group: every inverse is among them
        assert np.abs(turns - R.T).max(axis=(1, 2)).min() == 0


@settings(max_examples=30)
@given(st.integers(0, 1000), st.integers(0, 23), st.integers(0, 23))
def test_turns_that_cannot_be_seen_change_nothing(seed: int, i: int, j: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = Rotation.random(2, rng=rng).as_matrix()
    turns = turns_alike(model("box", (0.04, 0.04, 0.04)))
    plain = turn_between_rad(first, second, turns)
    assert turn_between_rad(first @ turns[i], second @ turns[j], turns) == pytest.approx(plain)
    # No two rotations of a cube are farther apart than this.
    assert plain <= np.deg2rad(62.8)


@pytest.fixture
def cube(tmp_path: Path) -> Made:
    """Two stages of a cube: the plan, two replays and the localisation all differ a little."""

    def make(
        *, seen: Seen | None = None, task: str = "cube_into_box", live: bool = False
    ) -> tuple[StateSummary, ...]:
        plan = plan_of({"grasp": {"cube": posed(LIFTED_M)}, "place": {"cube": posed(IN_BOX_M)}})
        start = posed((0.45, -0.1, 0.02))
        moved = {
            "planned": [start, posed(LIFTED_M), in_box(0.01), in_box()],
            "executed": [start, posed(LIFTED_M, 0.1), in_box(0.0, 0.02, np.pi / 2)],
        }
        found = Seen().add("cube", in_box(0.003, 0.004, 0.2))
        seen = found if seen is None else seen
        recorded = recorded_episode(
            tmp_path / "t.mcap", plan, task=task, seen=seen if live else None
        )
        replays: dict[str, Episode] = {
            name: replay_episode(tmp_path / f"{name}.mcap", plan, {"cube": poses})
            for name, poses in moved.items()
        }
        localised = None if live else localised_episode(tmp_path / "l.mcap", seen)
        return summarise_states(
            recorded, replays, localised, plan_id=PLAN_ID, task=recorded_task(recorded)
        )

    return make


def pick(found: tuple[StateSummary, ...], by: str) -> StateSummary:
    (state,) = (s for s in found if s.predicted_by == by)
    return state


def test_final_states_are_those_after_settling(cube: Made) -> None:
    found = cube()
    assert [s.predicted_by for s in found] == ["plan", "planned", "executed"]
    # The planned replay ends a second after the last stage, exactly where the plan says.
    planned = pick(found, "planned")
    assert planned.position_m == pytest.approx(0.005)
    assert planned.rotation_rad == pytest.approx(0.2)
    # A quarter turn of a cube cannot be seen.
    executed = pick(found, "executed")
    assert executed.rotation_rad == pytest.approx(0.2)
    assert executed.position_m == pytest.approx(np.hypot(0.003, 0.004 - 0.02))


def test_the_cells_own_localisation_counts_without_the_twins(cube: Made) -> None:
    found = cube(live=True)
    assert pick(found, "plan").position_m == pytest.approx(0.005)


def test_what_is_not_known_says_why(cube: Made) -> None:
    lost = pick(cube(seen=Seen().add("cube", None)), "plan")
    assert lost.position_m is None
    assert "hidden behind the box" in str(lost.reason)


def test_an_object_that_was_not_looked_for_says_so(cube: Made) -> None:
    state = pick(cube(seen=Seen()), "plan")
    assert state.reason == "it was not localised after the execution"


def test_what_a_replay_does_not_show_says_so(tmp_path: Path) -> None:
    plan = plan_of({"place": {"cube": posed(IN_BOX_M)}})
    found = summarise_states(
        recorded_episode(tmp_path / "t.mcap", plan),
        {"planned": replay_episode(tmp_path / "r.mcap", plan, {"duck": [posed(LIFTED_M)]})},
        localised_episode(tmp_path / "l.mcap", Seen().add("cube", in_box())),
        plan_id=PLAN_ID,
        task=None,
    )
    assert pick(found, "planned").reason == "the replay holds no poses of it"
    assert pick(found, "plan").position_m == pytest.approx(0.0, abs=1e-9)


def test_an_unknown_task_has_positions_but_no_rotation(cube: Made) -> None:
    state = pick(cube(task="../etc/passwd"), "plan")
    assert state.position_m == pytest.approx(0.005)
    assert state.rotation_rad is None


def test_a_plan_that_is_not_there_or_predicts_nothing_gives_nothing(tmp_path: Path) -> None:
    recorded = recorded_episode(tmp_path / "t.mcap", plan_of({"grasp": {}}))
    assert summarise_states(recorded, {}, None, plan_id=PLAN_ID, task=None) == ()
    assert summarise_states(recorded, {}, None, plan_id="another", task=None) == ()


def states(count: int, *, condition: str = "with_replanning") -> list[StateSummary]:
    rng = np.random.default_rng(0)
    return [
        StateSummary(
            episode=f"{condition}_{index // 2}",
            task="cube_into_box",
            condition=condition,
            object_id=f"cube_{index % 2}",
            predicted_by="plan",
            position_m=float(value),
            rotation_rad=0.1,
        )
        for index, value in enumerate(rng.uniform(0.002, 0.02, size=count))
    ]


def test_an_episode_counts_once_and_conditions_stay_apart() -> None:
    found = [*states(24), *states(8, condition="without_replanning")]
    by_id = {m.id: m for m in state_results(found).measurements}
    first = "state.plan_to_recorded.cube_into_box"
    median = by_id[f"{first}.with_replanning.position_median_m"]
    of_episode = [
        (a.position_m + b.position_m) / 2
        for a, b in zip(found[0:24:2], found[1:24:2], strict=True)
        if a.position_m is not None and b.position_m is not None
    ]
    assert median.value == pytest.approx(np.median(of_episode))
    assert (median.n, len(median.episodes)) == (24, 12)
    assert median.interval is not None
    assert median.interval.method == "order-statistics"
    assert (median.interval.low, median.interval.high) == (
        sorted(of_episode)[2],
        sorted(of_episode)[-3],
    )
    few = by_id[f"{first}.without_replanning.position_median_m"]
    assert few.interval is None
    assert "4 values" in str(few.reason_without_interval)


def test_what_is_missing_is_named() -> None:
    lost = replace(states(1)[0], position_m=None, rotation_rad=None, reason="not found: behind it")
    part = state_results([lost])
    (exclusion,) = part.exclusions
    assert "behind it" in exclusion.reason
    median = part.measurements[0]
    assert median.value is None
    assert "behind it" in str(median.reason_if_undefined)


def test_an_unknown_symmetry_says_so() -> None:
    found = [replace(state, rotation_rad=None) for state in states(4)]
    ids = {m.id: m for m in state_results(found).measurements}
    turned = ids["state.plan_to_recorded.cube_into_box.with_replanning.rotation_median_rad"]
    assert "symmetry" in str(turned.reason_if_undefined)


def test_no_state_is_no_data() -> None:
    part = state_results([])
    assert part.measurements == ()
    assert "no data" in part.missing[0]
