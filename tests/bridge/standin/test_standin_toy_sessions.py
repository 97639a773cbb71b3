"""Sessions with soft toys: which cell, what is drawn for it, what the operator does and says."""

import json
from collections.abc import Callable
from typing import Any

import numpy as np
from standin_hidden import nominal_hidden

from bridge.sources.standin.cell import CellConfig, StandinCell, TruthLog
from bridge.sources.standin.cell_file import CellFile, HiddenParameters, draw_hidden, load_cell
from bridge.sources.standin.operator import Operator, label_trial, void_trial
from bridge.sources.standin.session import describe, run_session
from bridge.sources.standin.settings import SessionConfig
from bridge.sources.standin.streams import Streams
from bridge.task.task_file import Task, load_task
from bridge.terminal import Output

SEED = 9_000_000
TOYS = ("sloth_into_basket", "five_ducks_into_basket")


def test_a_duck_beside_the_basket_costs_one_of_five(ducks: Task) -> None:
    truth = TruthLog()
    basket = np.eye(4)
    basket[:3, 3] = [0.48, 0.22, 0.0]
    for step in range(40):
        truth.stamps_ns.append(step * 33_000_000)
        truth.poses.setdefault("basket", []).append(basket)
        for key in ducks.manipulated:
            T = basket.copy()
            T[2, 3] = 0.04 if step != 20 else 0.2
            if key == "duck_4":
                T[0, 3] += 0.3
            truth.poses.setdefault(key, []).append(T)
            truth.contact.setdefault(key, []).append(False)
            size = np.array(ducks.objects[key].size_m)
            truth.extents_m.setdefault(key, []).append(size)
    outcome = label_trial(ducks, truth, executed=True)
    assert (outcome.result, outcome.unit, outcome.k, outcome.n) == ("failure", "object", 4, 5)
    assert outcome.detail is not None
    assert "duck_4" in outcome.detail
    assert "duck_1" not in outcome.detail
    results = {stage["id"]: stage["result"] for stage in outcome.stages}
    assert results["pick_4"] == "success"
    assert results["carry_4"] == results["release_4"] == "failure"
    assert results["carry_1"] == results["release_1"] == "success"
    assert (void_trial(ducks, "nobody").unit, void_trial(ducks, "nobody").n) == ("object", 5)


def test_toys_need_their_own_cell_and_a_session_takes_the_one_its_task_names(
    make_session: Callable[..., Any],
) -> None:
    assert load_task("cube_into_box").cell == "standin"
    assert {load_task(name).cell for name in TOYS} == {"standin_toys"}
    session = make_session()
    config = SessionConfig(task="sloth_into_basket", seed=9_000, scan=False, trials=1, rate_hz=0.0)
    stop_after = 200
    summary = run_session(
        session, config, Output(quiet=True), should_stop=lambda: len(session.sent) > stop_after
    )
    assert summary["task"] == "sloth_into_basket"
    parameters = session.of("truth/parameters")
    assert "stiffness_scale" in parameters[0].data.decode(errors="replace")
    assert session.control[-1][1]["outcome"]["unit"] == "trial"


def test_a_summary_counts_objects_where_they_are_the_unit() -> None:
    summary = {
        "cell": "standin",
        "scan": False,
        "outcomes": {"without_replanning": {"failure": 2}},
        "objects": {"without_replanning": {"k": 7, "n": 10}},
        "stopped": False,
    }
    assert "2 trials, 2 failure; 7 of 10 objects" in describe(json.loads(json.dumps(summary)))


def test_the_operator_puts_toys_down_a_little_off(
    toys_cell: CellFile, sloth: Task, make_session: Callable[..., Any]
) -> None:
    session = make_session()
    cell = StandinCell(
        toys_cell,
        sloth,
        nominal_hidden(toys_cell),
        Streams(session, "standin"),
        config=CellConfig(),
        seed=SEED,
        start_ns=0,
    )
    operator = Operator(cell, session, SessionConfig(task=sloth.name, seed=9_000))
    declared = sloth.draw_start(np.random.default_rng(SEED))
    for key, T in operator.start_poses(SEED, "without_replanning").items():
        assert 0 < np.linalg.norm(T[:3, 3] - declared[key][:3, 3]) < 0.01


def test_hidden_stiffness_is_drawn_only_where_a_cell_has_it(toys_cell: CellFile) -> None:
    drawn: HiddenParameters = draw_hidden(toys_cell, SEED)
    assert drawn.stiffness_scale is not None
    assert 0.6 <= drawn.stiffness_scale <= 1.6
    assert "stiffness_scale" in drawn.to_record()
    assert "stiffness_scale" not in draw_hidden(load_cell("standin"), SEED).to_record()
