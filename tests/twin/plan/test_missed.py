"""A trial that failed steers the next plan by where its object was measured to end."""

import json
from dataclasses import replace

import numpy as np
import pytest
from planned_start import CUBE, problem_of_test
from scripted_plans import pick_and_place

from bridge.episode.catalogue import label_episode
from bridge.episode.metadata import EpisodeInfo, Outcome
from bridge.episode.run_folder import RunFolder
from bridge.episode.schema import EVENT, PLAN
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.task.plan import Plan
from twin.plan import missed
from twin.plan.loop.steer import steer_by, tried_in
from twin.scene.localise.result import LocalisedObject

PROBLEM = problem_of_test()
TASK = PROBLEM.scene.task
S = 1_000_000_000


def executed(run: RunFolder, plan: Plan, result: str) -> None:
    path = run.episodes_dir / "trial_0001.mcap"
    with EpisodeWriter(path) as writer:
        task = {"task": TASK.name, "task_sha256": CUBE.sha256}
        writer.describe(EpisodeInfo(id=path.stem, kind="trial", **task))
        writer.write("/lab/plans", plan.to_json(), type_name=PLAN, log_time_ns=S)
        for number, kind in enumerate(("execution_started", "execution_ended"), start=2):
            event = {"schema_version": 1, "type": kind, "stamp_ns": number * S, "plan_id": plan.id}
            data = json.dumps(event).encode()
            writer.write("/lab/events", data, type_name=EVENT, log_time_ns=number * S)
    label_episode(run, path.stem, Outcome(result=result))


@pytest.mark.parametrize("result", ["failure", "success"])
def test_the_next_plan_makes_up_for_a_measured_miss(
    result: str, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = RunFolder.create(tmp_path_factory.mktemp("missed") / "run")
    entities = {key: se3.pose_record(T) for key, T in PROBLEM.scene.Ts_base_object.items()}
    plan = replace(pick_and_place(PROBLEM.scene), entities=entities)
    executed(run, plan, result)
    T_end = tried_in(plan)[0].T_base_object
    assert T_end is not None
    T_end[:3, 3] += (0.006, 0.0, -0.1)
    T_end[:3, :3] = T_end[:3, :3] @ se3.rotation_from_vector(np.array([0.0, np.pi / 2, 0.0]))
    seen: dict[str, object] = {}

    def localised(*_: object, **asked: object) -> dict[str, LocalisedObject]:
        seen.update(asked)
        about = {"confidence": 1.0, "method": "test", "reason": None, "stamp_ns": 4 * S}
        return {"cube": LocalisedObject(object_id="cube", T_base_object=T_end, **about)}

    monkeypatch.setattr(missed, "localise_episode", localised)
    refused = missed.missed_before(run, TASK, CUBE.sha256)
    assert missed.missed_before(run, TASK, "another") == ()
    if result == "success":
        assert refused == ()
        return
    assert (seen["after_ns"], seen["before_ns"]) == (3 * S, None)
    steer = steer_by(refused, PROBLEM)
    assert (steer.change, steer.clause) == ("release", "terminal.inside")
    assert steer.miss is not None
    assert np.linalg.norm(steer.miss.shift_m) == pytest.approx(0.006)
    assert steer.miss.turn_rad == pytest.approx(0.0, abs=1e-6)  # a cube looks the same turned
