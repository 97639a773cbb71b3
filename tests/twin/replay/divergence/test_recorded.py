"""What a recording says by itself: who was held when, and where things ended."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bridge.robots.default import ROBOT
from bridge.task.predicate import evaluate_success
from twin.replay.config import ReplayConfig
from twin.replay.execution import path_of_execution
from twin.replay.result import ReplayResult
from twin.replay.run_job import recorded_findings
from twin.replay.scene import StartState
from twin.replay.trace import Recording, states_of_recording, trace_of_recording
from twin.robot.model import load_robot

CONFIG = ReplayConfig(mode="kinematic")


def recorded(
    script: SimpleNamespace, good: ReplayResult, *, placed: bool = True, plan: object = None
) -> Recording:
    """The replay that works, as if encoders and cameras had seen it."""
    scene = script.scene()
    plan = script.plan(scene) if plan is None else plan
    track, widths = script.recorded_tracks(good)
    end = {name: Ts[-1] for name, Ts in good.Ts_base_object.items()}
    if not placed:
        end["cube"] = scene.Ts_base_object["cube"]
    return Recording(
        plan=plan,
        path=path_of_execution(track, widths, plan, CONFIG, ROBOT),
        scene=scene,
        end=StartState(Ts_base_object=end),
        end_seen_ns=int(good.stamps_ns[-1]) + 300_000_000,
    )


def said(recording: Recording) -> dict[str, bool | None]:
    return {item["kind"]: item["value"] for item in recorded_findings(recording)}


def test_what_the_fingers_held_is_found_with_its_times(
    script: SimpleNamespace, good: ReplayResult
) -> None:
    recording = recorded(script, good)
    robot = load_robot(recording.scene.urdf)
    touch = recording.touches(robot)["cube"]
    assert touch is not None
    touching = good.stamps_ns[good.finger_contact["cube"]]
    assert touch[0] * 1e-9 == pytest.approx(touching[0] * 1e-9, abs=0.15)
    assert touch[1] * 1e-9 == pytest.approx(touching[-1] * 1e-9, abs=0.2)
    trace = trace_of_recording(recording, robot, 60)
    assert trace.touches["cube"] == touch
    assert len(trace.objects["cube"]) == 2, "known where it was localised, and no more"


def test_fingers_that_close_on_nothing_hold_nothing(
    script: SimpleNamespace, good: ReplayResult
) -> None:
    recording = recorded(script, good)
    path = recording.path
    sent = np.where(path.width_m < 0.06, 0.02, path.width_m)
    empty = replace(recording, path=replace(path, width_m=sent))
    assert empty.grasps() == []
    assert empty.touches(load_robot(empty.scene.urdf)) == {"cube": None}


def test_a_grasp_far_from_every_object_is_of_none_of_them(
    script: SimpleNamespace, good: ReplayResult
) -> None:
    recording = recorded(script, good)
    T = recording.scene.Ts_base_object["cube"].copy()
    T[0, 3] += 0.2
    away = replace(recording.scene, Ts_base_object={**recording.scene.Ts_base_object, "cube": T})
    elsewhere = replace(recording, scene=away)
    assert len(elsewhere.grasps()) == 1
    assert elsewhere.touches(load_robot(away.urdf)) == {"cube": None}


def test_the_predicates_on_the_recording_are_those_of_the_replay(
    script: SimpleNamespace, good: ReplayResult
) -> None:
    values = said(recorded(script, good))
    assert values["inside"] is True
    assert values["no_finger_contact"] is True
    assert "allowed_contacts" not in values, "nobody saw what touched what, and the task is silent"
    assert values["settled"] is None, "one look says nothing of speed"
    assert said(recorded(script, good, placed=False))["inside"] is False


def test_an_object_not_found_afterwards_leaves_its_predicates_open(
    script: SimpleNamespace, good: ReplayResult
) -> None:
    recording = recorded(script, good)
    lost = replace(recording, end=StartState(reasons={"cube": "hidden"}))
    states = states_of_recording(lost, load_robot(lost.scene.urdf))
    assert {item.value for item in evaluate_success(lost.scene.task, states)} == {None}
