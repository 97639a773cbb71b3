"""Sessions on a wire in memory: what is published, when, and what is kept back."""

import json
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from standin_verdicts import verdict_on

from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    string_from_cdr,
    transforms_from_cdr,
)
from bridge.episode.topics import is_truth, type_of_topic
from bridge.media.color import decode_color
from bridge.sources.standin import decisions, operator
from bridge.sources.standin.cell import StandinCell
from bridge.sources.standin.kinematics import UnreachablePoseError
from bridge.sources.standin.operator import Operator, Treatment
from bridge.sources.standin.session import describe, run_session
from bridge.sources.standin.settings import SessionConfig
from bridge.sources.standin.streams import TRUTH_PARAMETERS
from bridge.task.plan import Plan
from bridge.task.verdict import Factor
from bridge.terminal import Output

QUIET = Output(quiet=True)


def verdict_record(plan: dict, accepted: bool | None) -> dict:
    return verdict_on(plan, Factor(value=accepted, cause="dropped"))


def settings(**more: Any) -> SessionConfig:
    values = {"seed": 9000, "trials": 1, "rate_hz": 0.0, "image_scale": 0.25, "scan": False}
    return SessionConfig(**{**values, **more})


def with_replanning(
    make_session: Callable[..., Any], gate: Callable[[dict], dict] | None, **more: Any
) -> tuple[Any, dict[str, Any]]:
    session = make_session(gate=gate)
    config = settings(conditions=("with_replanning",), **more)
    summary = run_session(session, config, QUIET, start_ns=1_700_000_000_000_000_000)
    return session, summary


@pytest.fixture(scope="module")
def looked_at(
    make_session: Callable[..., Any],
    make_cell: Callable[..., StandinCell],
    starts: dict[str, np.ndarray],
) -> tuple[Any, StandinCell]:
    """A cell that was announced and looked around for a moment, without moving."""
    session = make_session()
    cell = make_cell(session, rate_hz=10.0)
    cell.reset(starts)
    cell.announce()
    cell.cameras_running = True
    cell.wait(0.25)
    return session, cell


def test_every_topic_carries_the_type_the_format_names(looked_at: tuple[Any, StandinCell]) -> None:
    session, _ = looked_at
    for item in session.sent:
        named = type_of_topic(item.topic)
        assert named in (item.type_name, None), item.topic
    untyped = {item.topic for item in session.sent if type_of_topic(item.topic) is None}
    assert untyped == {"/standin/tcp/pose", TRUTH_PARAMETERS}


def test_stamps_never_run_backwards_and_rates_are_kept(looked_at: tuple[Any, StandinCell]) -> None:
    session, _ = looked_at
    stamps: dict[str, list[int]] = {}
    for item in session.sent:
        stamps.setdefault(item.topic, []).append(item.source_ns)
    for topic, series in stamps.items():
        assert series == sorted(series), topic
    assert np.diff(stamps["/standin/joint_states"]).tolist() == [8_000_000] * 30
    assert len(stamps["/standin/gripper/state"]) in (12, 13)
    assert len(stamps["/standin/cam/side/color/image"]) == 3


def test_frames_decode_and_their_calibration_fits_them(looked_at: tuple[Any, StandinCell]) -> None:
    session, _ = looked_at
    color = CompressedColor.from_cdr(session.of("/cam/wrist/color/image")[0].data)
    depth = DepthImage.from_cdr(session.of("/cam/wrist/depth/image")[0].data)
    info = CameraInfo.from_cdr(session.of("/cam/wrist/color/info")[0].data)
    assert decode_color(color.data).shape[:2] == depth.depth_mm.shape
    assert (info.camera.height, info.camera.width) == depth.depth_mm.shape
    assert color.stamp_ns == depth.stamp_ns
    assert info.frame_id == color.frame_id == "wrist_color_optical"
    # From home the wrist camera looks down at the table from about half a metre.
    assert np.median(depth.depth_mm) == pytest.approx(540, abs=30)


def test_camera_poses_are_the_believed_ones_not_the_true_ones(
    looked_at: tuple[Any, StandinCell],
) -> None:
    session, cell = looked_at
    static = [t for item in session.of("/tf_static") for t in transforms_from_cdr(item.data)]
    side = next(item for item in static if item.child == "side_color_optical")
    nominal = cell.file.cameras["side"].T_parent_camera
    np.testing.assert_allclose(side.T_parent_child, nominal, atol=1e-9)
    assert np.abs(cell.true_camera("side") - nominal).max() > 1e-4


def test_hidden_parameters_appear_under_truth_only(looked_at: tuple[Any, StandinCell]) -> None:
    session, cell = looked_at
    hidden = cell.hidden.to_record()
    numbers = [value for value in hidden.values() if isinstance(value, float)]
    numbers += hidden["joint_offset_rad"]
    numbers += [x for T in hidden["camera_errors"].values() for row in T for x in row]
    numbers = [value for value in numbers if value not in (0.0, 1.0)]
    assert len(numbers) > 30
    for item in session.sent:
        if is_truth(item.topic):
            continue
        for value in numbers:
            assert struct.pack("<d", value) not in item.data, item.topic
            assert repr(value).encode() not in item.data, item.topic
    truth = [item for item in session.sent if item.topic == TRUTH_PARAMETERS]
    assert json.loads(string_from_cdr(truth[0].data)) == hidden


def test_plans_refused_in_every_round_are_recorded_and_nothing_is_executed(
    make_session: Callable[..., Any],
) -> None:
    session, summary = with_replanning(make_session, lambda p: verdict_record(p, False), rounds=3)
    plans = [Plan.from_json(item.data) for item in session.of("/plan")]
    assert [plan.round for plan in plans] == [0, 1, 2]
    assert [plan.parent_id for plan in plans] == [None, plans[0].id, plans[1].id]
    assert len({plan.tau[40].p_m for plan in plans}) == 3
    assert session.asked == [plan.id for plan in plans]
    kinds = [event["type"] for event in session.events()]
    assert kinds == ["replan", "replan", "note", "label"]
    assert summary["outcomes"] == {"with_replanning": {"failure": 1}}
    verb, request = session.control[-1]
    assert verb == "stop"
    assert "refused 3 plans" in request["outcome"]["detail"]


def test_a_start_that_the_planner_cannot_plan_is_a_failed_trial_and_the_session_goes_on(
    make_session: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def out_of_reach(*_: Any, start_id: str, **__: Any) -> Plan:
        raise UnreachablePoseError(p_m=(0.4, 0.1, 0.2), residual_m=0.012)

    monkeypatch.setattr(decisions, "plan_pick_and_place", out_of_reach)
    session, summary = with_replanning(make_session, None, rounds=2, trials=2)
    assert summary["outcomes"] == {"with_replanning": {"failure": 2}}
    assert not session.of("/plan")
    assert [event["type"] for event in session.events()] == ["note", "note", "label"] * 2
    ends = [request for verb, request in session.control if verb == "stop"]
    for end in ends:
        assert not end["discard"]
        assert "nothing executed, the planner found no plan" in end["outcome"]["detail"]
        assert "(0.400, 0.100, 0.200)" in end["outcome"]["detail"]


def test_without_a_verdict_nothing_is_executed_and_the_trial_is_void(
    make_session: Callable[..., Any],
) -> None:
    session, summary = with_replanning(make_session, None)
    assert len(session.of("/plan")) == 1
    assert summary["outcomes"] == {"with_replanning": {"unknown": 1}}
    assert not [event for event in session.events() if event["type"] == "execution_started"]
    assert "nobody answered" in session.events()[0]["text"]
    assert "trial_0001 unknown: nothing executed, no verdict (nobody" in describe(summary)


def test_an_undecided_verdict_is_no_permission(make_session: Callable[..., Any]) -> None:
    session, summary = with_replanning(make_session, lambda plan: verdict_record(plan, None))
    assert summary["outcomes"] == {"with_replanning": {"unknown": 1}}
    assert len(session.asked) == 1


@pytest.mark.usefixtures("unchecked")
def test_without_replanning_the_gate_may_be_asked_but_is_not_obeyed(
    make_session: Callable[..., Any],
) -> None:
    session = make_session(gate=lambda plan: verdict_record(plan, False))
    config = settings(conditions=("without_replanning",), ask_always=True)
    run_session(session, config, QUIET, start_ns=1_700_000_000_000_000_000)
    assert len(session.asked) == len(session.of("/plan")) == 1
    assert [e["type"] for e in session.events()].count("execution_started") == 1


def test_a_verdict_on_another_plan_is_no_permission(make_session: Callable[..., Any]) -> None:
    def confused(plan: dict) -> dict:
        return verdict_record({"id": "somebody_else"}, True)

    session, summary = with_replanning(make_session, confused)
    assert summary["outcomes"] == {"with_replanning": {"unknown": 1}}
    assert "instead of" in session.events()[0]["text"]


def test_both_conditions_share_start_ids_but_not_the_exact_poses(
    make_session: Callable[..., Any], make_cell: Callable[..., StandinCell]
) -> None:
    session = make_session()
    operator = Operator(make_cell(session), session, settings(trials=2))
    assert operator.start_seeds(2) == [9_000_000, 9_000_001]
    without = operator.start_poses(9_000_000, "without_replanning")["cube"]
    with_ = operator.start_poses(9_000_000, "with_replanning")["cube"]
    assert 0 < np.linalg.norm(without[:3, 3] - with_[:3, 3]) < 0.01


def test_a_failed_execution_is_tried_anew_once_and_counts_in_no_trial(
    make_session: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(operator, "execute_plan", lambda cell, plan: None)  # the cube stays
    session = make_session()
    config = settings(conditions=("without_replanning",), retry=True)
    summary = run_session(session, config, QUIET, start_ns=1_700_000_000_000_000_000)
    started = [request for verb, request in session.control if verb == "start"]
    assert [each["id"] for each in started] == ["trial_0001", "retry_0001"]
    assert [each["info"]["kind"] for each in started] == ["trial", "retry"]
    assert started[1]["info"]["tags"] == ["retry_of:trial_0001"]
    assert started[1]["info"]["start_id"] == started[0]["info"]["start_id"]
    assert summary["outcomes"] == {"without_replanning": {"failure": 1}}
    assert summary["retries"] == {"without_replanning": {"failure": 1}}
    assert "1 retried after a failure, 1 failure" in describe(summary)
    first, second = (Plan.from_json(item.data) for item in session.of("/plan"))
    assert (first.id, second.id) == ("trial_0001.plan_0", "retry_0001.plan_0")
    assert first.tau != second.tau, "put back, looked at and planned anew"


def test_what_was_not_executed_is_not_tried_anew(make_session: Callable[..., Any]) -> None:
    session, summary = with_replanning(
        make_session, lambda plan: verdict_record(plan, False), retry=True, rounds=1
    )
    assert summary["outcomes"] == {"with_replanning": {"failure": 1}}
    assert summary["retries"] == {}
    assert [verb for verb, _ in session.control] == ["start", "stop"]


def listed(name: str, condition: str = "", start_seed: int = 0) -> dict[str, str]:
    start_id = f"cube_into_box/{start_seed}"
    return {"id": name, "condition": condition, "start_id": start_id, "policy": "perturbed"}


def test_a_second_session_goes_on_with_the_numbering_of_the_run(
    make_session: Callable[..., Any], make_cell: Callable[..., StandinCell]
) -> None:
    there = [listed("scan_0002"), listed("trial_0007"), listed("trial_0003"), listed("trial_x")]
    session = make_session(there=there)
    run_session(session, settings(conditions=("with_replanning",)), QUIET, start_ns=0)
    assert session.control[0][1]["id"] == "trial_0008"
    at_work = Operator(make_cell(session), session, settings())
    assert at_work._next_number("scan") == 3


def test_missing_records_only_what_the_recorder_does_not_have(
    make_session: Callable[..., Any], make_cell: Callable[..., StandinCell]
) -> None:
    there = [
        listed("trial_0001", "without_replanning", 9_000_000),
        listed("trial_0002", "with_replanning", 9_000_000),
        listed("trial_0004", "with_replanning", 9_000_001),
    ]
    session = make_session(there=there)
    operator = Operator(make_cell(session), session, settings(trials=2, missing=True))
    assert operator._wanted() == [(9_000_001, Treatment(condition="without_replanning"))]
    operator = Operator(make_cell(session), session, settings(trials=2))
    assert len(operator._wanted()) == 4


def test_the_limit_of_waiting_for_the_gate_is_named_when_it_strikes(
    make_session: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    ticks = iter(range(0, 10_000, 100))
    monkeypatch.setattr(decisions.time, "monotonic", lambda: float(next(ticks)))
    session, summary = with_replanning(make_session, None, gate_timeout_s=100.0)
    assert summary["outcomes"] == {"with_replanning": {"unknown": 1}}
    assert "wall-clock limit of 100 s (--gate-timeout-s)" in session.events()[0]["text"]


def test_a_stopped_session_finishes_its_episode(make_session: Callable[..., Any]) -> None:
    session = make_session()
    summary = run_session(session, settings(), QUIET, should_stop=lambda: len(session.sent) > 100)
    assert summary["stopped"]
    assert [verb for verb, _ in session.control] == ["start", "stop"]
    assert session.control[-1][1]["outcome"]["result"] == "unknown"


def test_a_session_that_fails_leaves_no_half_episode(
    make_session: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(cell: StandinCell) -> None:
        message = "no picture"
        raise ValueError(message)

    session = make_session()
    monkeypatch.setattr(StandinCell, "capture", broken)
    with pytest.raises(ValueError, match="no picture"):
        run_session(session, settings(trials=0, scan=True), QUIET, start_ns=0)
    assert [(verb, request.get("discard")) for verb, request in session.control] == [
        ("start", None),
        ("stop", True),
    ]


@pytest.mark.parametrize("rate_hz", [1.0, 1.7, 5.0])
def test_each_camera_sees_the_start_at_rest_before_a_plan_is_made(
    make_session: Callable[..., Any], rate_hz: float
) -> None:
    """The cell's clock stands still while a gate looks: an image must be there by then."""
    rest_ns = 40_000_000  # before and after an image that counts
    session, _ = with_replanning(
        make_session, lambda plan: verdict_record(plan, False), rounds=1, trials=4, rate_hz=rate_hz
    )
    stamps: dict[str, np.ndarray] = {
        topic: np.array([item.source_ns for item in session.sent if item.topic == topic])
        for topic in ("/standin/plan", "/standin/joint_states")
    }
    joints = stamps["/standin/joint_states"]
    begins = joints[np.flatnonzero(np.diff(joints, prepend=0) > 1_000_000_000)]
    plans = stamps["/standin/plan"]
    assert len(plans) == 4
    for camera in ("side", "wrist"):
        topic = f"/standin/cam/{camera}/color/image"
        images = np.array([item.source_ns for item in session.sent if item.topic == topic])
        for plan_ns in plans:
            begin_ns = begins[begins < plan_ns].max()
            at_rest = (images >= begin_ns + rest_ns) & (images <= plan_ns - rest_ns)
            assert at_rest.any(), (camera, rate_hz)


@pytest.mark.parametrize("rate_hz", [1.0, 1.7, 5.0])
def test_each_camera_sees_what_an_execution_left_at_rest(
    make_session: Callable[..., Any], rate_hz: float
) -> None:
    rest_ns = 40_000_000
    session, _ = with_replanning(
        make_session, lambda plan: verdict_record(plan, True), trials=2, rate_hz=rate_hz
    )
    ends = [
        (event["stamp_ns"], event["type"])
        for event in session.events()
        if event["type"] in ("execution_ended", "label")
    ]
    assert [kind for _, kind in ends] == ["execution_ended", "label"] * 2
    for camera in ("side", "wrist"):
        topic = f"/standin/cam/{camera}/color/image"
        images = np.array([item.source_ns for item in session.sent if item.topic == topic])
        for (still_ns, _), (over_ns, _) in zip(ends[::2], ends[1::2], strict=True):
            at_rest = (images >= still_ns + rest_ns) & (images <= over_ns - rest_ns)
            assert at_rest.any(), (camera, rate_hz)
