"""The operator's label beside the predicate on localised poses: agreement, and where it is not."""

from pathlib import Path

import numpy as np
from state_samples import (
    BOX_M,
    IN_BOX_M,
    PLAN_ID,
    Seen,
    localised_episode,
    plan_of,
    posed,
    recorded_episode,
)

from evaluator.compare.labels import PerceivedOutcome, label_results, perceive_outcome
from evaluator.compare.rows import TrialRow

CUBE_START = posed((0.45, -0.1, 0.02))


def witness(
    tmp_path: Path,
    seen: Seen,
    *,
    task: str = "cube_into_box",
    tool_m: tuple[float, float, float] | None = (0.4, 0.0, 0.4),
) -> PerceivedOutcome:
    plan = plan_of({"place": {"cube": posed(IN_BOX_M)}})
    recorded = recorded_episode(tmp_path / "t.mcap", plan, task=task, tool_m=tool_m)
    found = perceive_outcome(
        recorded, localised_episode(tmp_path / "l.mcap", seen), plan_id=PLAN_ID
    )
    assert found is not None
    return found


def started() -> Seen:
    return Seen().add("cube", CUBE_START, phase="start").add("box", posed(BOX_M), phase="start")


def test_a_cube_in_the_box_is_a_success_and_what_was_not_asked_is_named(tmp_path: Path) -> None:
    found = witness(tmp_path, started().add("cube", posed(IN_BOX_M)).add("box", posed(BOX_M)))
    assert found.says is True
    assert found.not_asked == ("settled",)  # one look does not say whether anything moves


def test_a_cube_beside_the_box_is_a_failure(tmp_path: Path) -> None:
    found = witness(tmp_path, started().add("cube", CUBE_START).add("box", posed(BOX_M)))
    assert found.says is False
    assert "outside box" in found.detail


def test_a_box_that_was_not_seen_again_is_where_it_was(tmp_path: Path) -> None:
    assert witness(tmp_path, started().add("cube", posed(IN_BOX_M)).add("box", None)).says is True


def test_a_cube_that_was_not_found_leaves_it_open(tmp_path: Path) -> None:
    found = witness(tmp_path, started().add("cube", None).add("box", posed(BOX_M)))
    assert found.says is None
    assert "cube was not localised" in found.detail


def test_a_toy_that_is_out_of_shape_is_no_success(tmp_path: Path) -> None:
    seen = Seen().add("basket", posed((0.48, 0.2, 0.0)), phase="start")
    inside = posed((0.48, 0.2, 0.04))
    good = seen.add("sloth", inside, extents_m=(0.16, 0.1, 0.055))
    assert witness(tmp_path, good, task="sloth_into_basket").says is True
    (tmp_path / "t.mcap").unlink()
    (tmp_path / "l.mcap").unlink()
    bad = Seen(records=good.records[:1]).add("sloth", inside, extents_m=(0.16, 0.05, 0.055))
    found = witness(tmp_path, bad, task="sloth_into_basket")
    assert found.says is False
    assert "differs by 50%" in found.detail


def test_two_ducks_outside_are_no_success(tmp_path: Path) -> None:
    seen = Seen().add("basket", posed((0.48, 0.22, 0.0)), phase="start")
    rest = (0.07, 0.05, 0.06)
    for index in range(1, 6):
        place = (0.44 + 0.02 * index, 0.22, 0.04) if index < 4 else (0.4, -0.2, 0.03)
        seen.add(f"duck_{index}", posed(place), extents_m=rest)
    found = witness(tmp_path, seen, task="five_ducks_into_basket")
    assert found.says is False


def test_without_localisation_or_task_there_is_no_witness(tmp_path: Path) -> None:
    plan = plan_of({"place": {"cube": posed(IN_BOX_M)}})
    recorded = recorded_episode(tmp_path / "a.mcap", plan)
    assert perceive_outcome(recorded, None, plan_id=PLAN_ID) is None
    unknown = recorded_episode(tmp_path / "b.mcap", plan, task="no_such_task")
    localised = localised_episode(tmp_path / "l.mcap", started())
    assert perceive_outcome(unknown, localised, plan_id=PLAN_ID) is None


def row(name: str, recorded: bool | None) -> TrialRow:
    return TrialRow(
        episode=name,
        task="cube_into_box",
        condition="with_replanning",
        policy="scripted",
        start_id=None,
        cell="standin",
        stand_in=True,
        recorded=recorded,
    )


def says(name: str, value: bool | None) -> PerceivedOutcome:
    return PerceivedOutcome(
        episode=name,
        task="cube_into_box",
        condition="with_replanning",
        plan_id="p",
        says=value,
        detail=f"what was found in {name}",
        not_asked=("settled",),
    )


def test_agreement_is_k_of_n_and_disagreements_are_listed() -> None:
    labels = [True, True, False, False, None, True]
    said = [True, False, False, True, True, None]
    rows = [row(f"t{i}", label) for i, label in enumerate(labels)]
    part = label_results([says(f"t{i}", value) for i, value in enumerate(said)], rows)
    by_id = {m.id: m for m in part.measurements}
    rate = by_id["label.localised.rate"]
    assert (rate.k, rate.n) == (2, 4)
    assert rate.interval is not None or rate.reason_without_interval
    assert "settled" in rate.definition
    assert by_id["label.localised.cube_into_box.rate"].k == 2
    tables = {table.id: table for table in part.tables}
    assert [r[0] for r in tables["label_disagreements"].rows] == ["t1", "t3"]
    assert tables["label_disagreements"].rows[0][-1] == "what was found in t1"
    (exclusion,) = part.exclusions
    assert exclusion.episode == "t5"


def test_no_witness_is_no_data_and_an_unlabelled_one_is_undefined() -> None:
    assert "no data" in label_results([], [row("t0", True)]).missing[0]
    part = label_results([says("t0", True)], [row("t0", None)])
    assert part.measurements[0].value is None
    assert np.isclose(part.measurements[0].n or 0, 0)
