"""What a recording says by itself: who was held when, where things ended, inferred contacts."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bridge.robots.default import ROBOT
from bridge.task.predicate import evaluate_success
from bridge.task.task_file import SoftMaterial
from twin.replay.config import ReplayConfig
from twin.replay.execution import path_of_execution
from twin.replay.result import ReplayResult
from twin.replay.run_job import recorded_findings
from twin.replay.scene import StartState
from twin.replay.trace import Recording, states_of_recording, trace_of_recording
from twin.replay.verdict import replay_plan
from twin.robot.model import load_robot

CONFIG = ReplayConfig(mode="kinematic", sample_rate_hz=30)


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
    return {item["kind"]: item["value"] for item in recorded_findings(recording, CONFIG)}


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
    assert values["allowed_contacts"] is True
    assert values["settled"] is None, "one look says nothing of speed"
    assert said(recorded(script, good, placed=False))["inside"] is False


def test_an_object_not_found_afterwards_leaves_its_predicates_open(
    script: SimpleNamespace, good: ReplayResult
) -> None:
    recording = recorded(script, good)
    lost = replace(recording, end=StartState(reasons={"cube": "hidden"}))
    states = states_of_recording(lost, load_robot(lost.scene.urdf))
    assert {item.value for item in evaluate_success(lost.scene.task, states)} == {None}


def test_a_touch_that_no_stage_allows_is_inferred_from_the_joints(
    script: SimpleNamespace, good: ReplayResult
) -> None:
    """The cube is dragged through the wall of a box that the plan did not allow it to touch."""
    scene = script.scene()
    plan = script.plan(scene, carry_height_m=0.03)
    strict = replace(plan, stages=tuple(replace(s, allowed_contacts=()) for s in plan.stages))
    low = replay_plan(plan, scene, CONFIG)
    low = replace(low, width_m=np.where(low.width_m < 0.06, 0.04, low.width_m))
    track, widths = script.recorded_tracks(low)
    path = path_of_execution(track, widths, strict, CONFIG, ROBOT)
    dragged = replace(recorded(script, good, plan=strict), path=path)
    findings = recorded_findings(dragged, CONFIG)
    (contacts,) = [item for item in findings if item["kind"] == "allowed_contacts"]
    assert contacts["value"] is False
    assert contacts["detail"].startswith("inferred: ")


def test_what_a_soft_body_touches_in_the_hand_is_not_inferred_from_the_box_around_it(
    script: SimpleNamespace, good: ReplayResult
) -> None:
    recording = recorded(script, good)
    grip = replace(recording.plan.stages[0], allowed_contacts=(("gripper", "cube"),))
    recording = replace(recording, plan=replace(recording.plan, stages=(grip,)))
    sunk = recording.end.Ts_base_object["cube"].copy()
    sunk[2, 3] -= 0.03
    end = {**recording.end.Ts_base_object, "cube": sunk}
    recording = replace(recording, end=replace(recording.end, Ts_base_object=end))
    assert said(recording)["allowed_contacts"] is False, "rigid: it reaches into the table"
    task = recording.scene.task
    soft = SoftMaterial(young_pa=5e4, poisson=0.2, damping_s=0.01, cell_m=0.01)
    objects = {**task.objects, "cube": replace(task.objects["cube"], soft=soft)}
    bent = replace(recording.scene, task=replace(task, objects=objects))
    assert said(replace(recording, scene=bent))["allowed_contacts"] is True
