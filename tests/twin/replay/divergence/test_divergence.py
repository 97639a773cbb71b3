"""Where three tellings of one execution part, and what a recording says by itself."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bridge.geometry.trajectory import PoseTrajectory
from bridge.robots.default import ROBOT
from bridge.task.predicate import evaluate_success
from twin.replay.config import ReplayConfig
from twin.replay.divergence import TOOL_M, diverge, lag_s
from twin.replay.execution import path_of_execution
from twin.replay.result import ReplayResult
from twin.replay.run_job import recorded_findings
from twin.replay.scene import StartState
from twin.replay.trace import Recording, Trace, states_of_recording, trace_of_recording
from twin.robot.model import load_robot

END_S = 4.0
UP = np.array([1.0, 0.0, 0.0, 0.0])


def ns(seconds: float) -> int:
    return round(seconds * 1e9)


def track(p_m: np.ndarray, times_ns: np.ndarray) -> PoseTrajectory:
    return PoseTrajectory(times_ns, p_m, np.tile(UP, (len(times_ns), 1)))


def telling(side: str, *, late_s: float = 0.0) -> Trace:
    """The tool goes to and fro along x, the fingers hold a cube from 1 s to 3 s."""
    times = np.arange(0, ns(END_S) + 1, ns(0.01))
    t = times * 1e-9 - late_s
    tool = np.stack([0.1 * np.sin(2.0 * t), np.zeros_like(t), 0.3 + 0 * t], axis=1)
    width = np.where((t > 1.0) & (t < 3.0), 0.04, 0.085)
    seen = times if side != "recorded" else times[[0, -1]]
    return Trace(
        side=side,
        tool=track(tool, times),
        width_times_ns=times,
        width_m=width,
        objects={"cube": track(np.tile([0.5, 0.0, 0.02], (len(seen), 1)), seen)},
        touches={"cube": (ns(1.0 + late_s), ns(3.0 + late_s))},
        end_ns=ns(END_S),
    )


def found(*traces: Trace, **more: object) -> list[tuple[tuple[str, str], str, str]]:
    quantities = diverge("p", traces, **more)["quantities"]
    return [(tuple(q["between"]), q["quantity"], q["attribution"]) for q in quantities]


def test_the_same_telling_three_times_parts_nowhere() -> None:
    sides = [telling(side) for side in ("planned", "executed", "recorded")]
    divergence = diverge("p", sides)
    assert divergence["first"] is None
    assert divergence["quantities"] == []
    assert divergence["lag_s"] == 0.0


@pytest.mark.parametrize("late_s", [0.03, 0.11, 0.4])
def test_a_constant_lag_is_found_and_is_no_divergence(late_s: float) -> None:
    planned, recorded = telling("planned"), telling("recorded", late_s=late_s)
    assert lag_s(planned, recorded) == pytest.approx(late_s, abs=0.011)
    divergence = diverge("p", [planned, recorded])
    assert divergence["lag_s"] == pytest.approx(late_s, abs=0.011)
    assert divergence["first"] is None


def bent(trace: Trace, from_s: float = 2.0, by_m: float = 0.03) -> Trace:
    p = trace.tool.p_m.copy()
    p[trace.tool.stamps_ns >= ns(from_s), 2] += by_m
    return replace(trace, tool=replace(trace.tool, p_m=p))


def test_a_tool_that_leaves_the_path_is_tracking_at_that_instant() -> None:
    divergence = diverge("p", [telling("planned"), bent(telling("recorded"))])
    first = divergence["first"]
    assert first is not None
    assert (first["quantity"], first["attribution"]) == ("tool_position", "tracking")
    assert first["first_t_ns"] * 1e-9 == pytest.approx(2.0, abs=0.05)
    assert first["size"] == pytest.approx(0.03, abs=2e-3)
    assert first["limit"] == TOOL_M


def test_a_difference_of_one_sample_is_noise() -> None:
    trace = telling("recorded")
    p = trace.tool.p_m.copy()
    p[200] += 0.05
    spike = replace(trace, tool=replace(trace.tool, p_m=p))
    assert diverge("p", [telling("planned"), spike])["first"] is None


def test_an_object_never_touched_in_one_telling_is_perception_against_the_recording() -> None:
    missed = replace(telling("recorded"), touches={"cube": None})
    assert found(telling("planned"), missed) == [(("planned", "recorded"), "contact", "perception")]
    inside = replace(telling("executed"), touches={"cube": None})
    assert found(telling("planned"), inside) == [(("planned", "executed"), "contact", "contact")]


def test_an_object_that_is_lost_earlier_is_contact_and_says_where() -> None:
    dropped = replace(telling("recorded"), touches={"cube": (ns(1.0), ns(2.2))})
    divergence = diverge("p", [telling("executed"), dropped])
    assert [item["attribution"] for item in divergence["quantities"]] == ["contact"]
    assert "let go of 0.80 s earlier in the recording" in divergence["quantities"][0]["detail"]
    assert divergence["quantities"][0]["first_t_ns"] == ns(2.2)


def test_fingers_that_hold_another_width_hold_another_part() -> None:
    trace = telling("recorded")
    wider = replace(trace, width_m=np.where(trace.width_m < 0.08, 0.05, trace.width_m))
    assert found(telling("planned"), wider) == [
        (("planned", "recorded"), "gripper_width", "perception")
    ]
    apart = replace(wider, touches={})
    free = replace(telling("planned"), touches={})
    assert found(free, apart)[0][2] == "tracking"


def test_an_object_that_lies_elsewhere_after_all_else_agreed_is_contact() -> None:
    trace = telling("recorded")
    end = trace.objects["cube"]
    p = end.p_m + np.array([[0, 0, 0], [0.05, 0, 0]])
    rolled = replace(trace, objects={"cube": replace(end, p_m=p)})
    divergence = diverge("p", [telling("planned"), rolled])
    (found,) = divergence["quantities"]
    assert (found["quantity"], found["attribution"], found["body"]) == (
        "object_position", "contact", "cube"
    )  # fmt: skip
    assert found["size"] == pytest.approx(0.05)


def test_what_parts_later_carries_the_name_of_what_parted_first() -> None:
    trace = bent(telling("recorded"), from_s=0.5)
    late = replace(trace, touches={"cube": None})
    said = found(telling("planned"), late)
    assert [item[1] for item in said] == ["tool_position", "contact"]
    assert {item[2] for item in said} == {"tracking"}


def test_only_a_predicate_that_differs_is_put_down_to_the_predicate() -> None:
    findings = {
        "planned": {("inside", "cube"): True, ("settled", "cube"): True},
        "recorded": {("inside", "cube"): False, ("settled", "cube"): None},
    }
    traces = (telling("planned"), telling("recorded"))
    assert found(*traces, findings=findings) == [
        (("planned", "recorded"), "predicate", "predicate")
    ]
    agree = {**findings, "recorded": {("inside", "cube"): True}}
    assert found(*traces, findings=agree) == []


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
