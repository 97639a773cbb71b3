"""Probes: what they do to the object, where they may, and that nothing else has changed."""

import hashlib
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.robots.default import MAX_WIDTH_M
from bridge.sources.standin import operator
from bridge.sources.standin.cell import StandinCell
from bridge.sources.standin.operator import execute_plan
from bridge.sources.standin.probes import PROBES, NoSpaceForProbeError, plan_probe
from bridge.sources.standin.session import run_session
from bridge.sources.standin.settings import SessionConfig
from bridge.task.plan import Plan
from bridge.task.task_file import load_task
from bridge.terminal import Output

BOX = se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([0.5, 0.19, 0.0]))
YAW = 0.25
START_NS = 1_700_000_000_000_000_000


def cube(x: float = 0.47, y: float = -0.11) -> np.ndarray:
    q = np.array([np.cos(YAW / 2), 0, 0, np.sin(YAW / 2)])
    return se3.transform_from(q, np.array([x, y, 0.02]))


def planned(kind: str, cell: StandinCell, T: np.ndarray, turn: int = 1) -> Plan:
    return plan_probe(
        kind,
        cell.task,
        {"cube": T, "box": BOX},
        kinematics=cell.kinematics,
        joints_start_rad=cell.home_rad,
        max_joint_speed_rad_s=cell.file.max_joint_speed_rad_s,
        plan_id=f"probe.{kind}",
        start_id="test",
        turn=turn,
    )


def executed(cell: StandinCell, plan: Plan) -> np.ndarray:
    """Carry out the part of a plan that is near the table; poses of the cube over time."""
    cell.reset({"cube": cube(), "box": BOX})
    low = [k for k, waypoint in enumerate(plan.tau) if waypoint.p_m[2] < 0.1]
    first, last = low[0], low[-1]
    start_ns = plan.tau[first].t_ns
    tau = tuple(replace(w, t_ns=w.t_ns - start_ns) for w in plan.tau[first : last + 1])
    joints = np.array(tau[0].joints_rad)
    cell.world.reset(joints - cell.hidden.joint_offset_rad, {"cube": cube(), "box": BOX})
    cell.grip(0.0 if tau[0].g else MAX_WIDTH_M)
    cell.follow(np.array([0, 600_000_000]), np.stack([joints, joints]))
    end_ns = tau[-1].t_ns
    stage = replace(plan.stages[0], t_start_ns=0, t_end_ns=end_ns)
    execute_plan(cell, replace(plan, tau=tau, stages=(stage,)))
    return np.array(cell.truth.poses["cube"])


@pytest.mark.parametrize("kind", PROBES)
def test_plans_follow_the_schema_and_the_joints_speed(
    kind: str, make_session: Callable[..., Any], make_cell: Callable[..., StandinCell]
) -> None:
    plan = planned(kind, make_cell(make_session()), cube())
    assert Plan.from_json(plan.to_json()) == plan
    joints = np.array([waypoint.joints_rad for waypoint in plan.tau])
    speeds = np.abs(np.diff(joints, axis=0)) / np.diff(plan.times_ns() * 1e-9)[:, None]
    assert speeds.max() <= 1.6 + 1e-6
    np.testing.assert_allclose(joints[-1], joints[0], atol=1e-4)
    heights = plan.positions_m()[:, 2]
    assert heights.min() >= 0.016
    assert [stage.id for stage in plan.stages] == [kind]


def test_fingers_close_slowly_in_a_squeeze_and_at_once_elsewhere(
    make_session: Callable[..., Any], make_cell: Callable[..., StandinCell]
) -> None:
    cell = make_cell(make_session())
    widths = {
        kind: sorted({waypoint.width_m for waypoint in planned(kind, cell, cube()).tau})
        for kind in ("squeeze", "drop")
    }
    assert widths["drop"] == [0.0, MAX_WIDTH_M]
    assert len(widths["squeeze"]) > 20


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
def test_a_slide_leaves_the_fingers_behind(
    make_session: Callable[..., Any], make_cell: Callable[..., StandinCell], nominal: Any
) -> None:
    session = make_session()
    cell = make_cell(session, hidden=nominal)
    plan = planned("slide", cell, cube())
    poses = executed(cell, plan)
    moved = np.linalg.norm(poses[-1][:2, 3] - poses[0][:2, 3])
    # 8 + 145 mm from where the fingers touched it; the rest it slid on by itself.
    assert 0.16 < moved < 0.24
    assert poses[-1][2, 3] == pytest.approx(0.02, abs=1e-3)


def test_no_room_is_said_instead_of_pushed_off_the_table(
    make_session: Callable[..., Any], make_cell: Callable[..., StandinCell]
) -> None:
    cell = make_cell(make_session())
    with pytest.raises(NoSpaceForProbeError, match="put the object elsewhere"):
        planned("slide", cell, cube(x=0.6, y=0.25))


def test_soft_objects_are_refused(
    make_session: Callable[..., Any], make_cell: Callable[..., StandinCell]
) -> None:
    cell = make_cell(make_session())
    cell.task = load_task("sloth_into_basket")
    with pytest.raises(UsageError, match="soft"):
        planned("push", cell, cube())


def settings(**more: Any) -> SessionConfig:
    values = {"seed": 9000, "trials": 1, "rate_hz": 0.0, "image_scale": 0.25, "scan": False}
    return SessionConfig(**{**values, "conditions": ("without_replanning",), **more})


@pytest.mark.usefixtures("unchecked")
def test_probes_come_after_the_trials_and_change_nothing_of_them(
    make_session: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        operator,
        "execute_plan",
        lambda cell, plan: cell.streams.event("note", cell.now_ns, plan_id=plan.id),
    )

    def run(probes: int) -> tuple[Any, dict[str, Any]]:
        session = make_session()
        config = settings(probes=probes)
        summary = run_session(session, config, Output(quiet=True), start_ns=START_NS)
        return session, summary

    def digest(sent: list[Any]) -> str:
        parts = [item.topic.encode() + item.data for item in sent]
        return hashlib.sha256(b"".join(parts)).hexdigest()

    (plain, _), (probed, summary) = run(0), run(1)
    assert digest(plain.sent) == digest(probed.sent[: len(plain.sent)])
    assert summary["probes"] == len(PROBES)
    starts = [request for verb, request in probed.control if verb == "start"]
    kinds = [(request["id"], request["info"]["kind"]) for request in starts]
    assert kinds == [("trial_0001", "trial")] + [(f"probe_{n:04d}", "probe") for n in (1, 2, 3, 4)]
    assert [request["info"]["tags"] for request in starts[1:]] == [[f"probe:{k}"] for k in PROBES]
    stops = [request["outcome"] for verb, request in probed.control if verb == "stop"]
    assert stops[1:] == [None] * 4


def test_plans_that_only_open_and_close_are_cut_where_they_always_were(
    make_session: Callable[..., Any], make_cell: Callable[..., StandinCell]
) -> None:
    plan = planned("drop", make_cell(make_session()), cube())
    g = [waypoint.g for waypoint in plan.tau]
    changes = [k for k in range(1, len(g) - 1) if g[k + 1] != g[k]]
    assert operator._pieces(plan) == list(pairwise([0, *changes, len(g) - 1]))
