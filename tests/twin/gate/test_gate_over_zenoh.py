"""The gate on a real zenoh network on the loopback address, with a fake replay."""

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gate_fakes import JUDGED, accept
from joint_samples import at_positions
from own_process import ROOT
from small_plans import plan_of

from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    FrameTransform,
    string_to_cdr,
    transforms_to_cdr,
)
from bridge.episode.topics import type_of_topic
from bridge.geometry.camera import Camera
from bridge.media.color import encode_jpeg
from bridge.robots.default import ARM_JOINTS
from bridge.task.plan import Plan
from bridge.task.task_file import load_task
from bridge.task.verdict import Factor, Verdict
from bridge.terminal import Output
from bridge.wire.config import WireConfig
from bridge.wire.errors import RemoteError
from bridge.wire.session import WireSession, open_session
from twin.gate.config import GateConfig
from twin.gate.gate import Gate
from twin.gate.live import LiveView
from twin.gate.service import GateError, claim_gate, serve_gate, watch_cell

CAMERA = Camera(width=8, height=6, fx=10.0, fy=10.0, cx=4.0, cy=3.0)
S = 1_000_000_000


@pytest.fixture
def sessions(endpoint: str) -> Iterator[tuple[WireSession, WireSession]]:
    """A router, and a client of it that plays the cell."""
    with (
        open_session(WireConfig(mode="router", connect=(), listen=(endpoint,))) as router,
        open_session(WireConfig(connect=(endpoint,))) as cell,
    ):
        yield router, cell


def still_at(stamp_ns: int, names: tuple[str, ...] = ARM_JOINTS) -> bytes:
    sample = at_positions(stamp_ns, names, np.zeros(len(names)))
    return sample.to_cdr()


def publish_one_frame(cell: WireSession, stamp_ns: int = S) -> None:
    frames = [
        FrameTransform(
            stamp_ns=stamp_ns,
            parent="base_link",
            child=f"side_{k}_optical",
            T_parent_child=np.eye(4),
        )
        for k in ("color", "depth")
    ]
    image = encode_jpeg(np.full((6, 8, 3), 99, dtype=np.uint8))
    color = CompressedColor(stamp_ns=stamp_ns, frame_id="c", format="jpeg", data=image)
    depth = DepthImage(
        stamp_ns=stamp_ns, frame_id="d", depth_mm=np.full((6, 8), 700, dtype=np.uint16)
    )
    messages = [
        ("/robot_description", string_to_cdr('<robot name="arm"/>')),
        ("/tf_static", transforms_to_cdr(frames)),
        *(
            (
                f"/lab/cam/side/{k}/info",
                CameraInfo(stamp_ns=stamp_ns, frame_id=f"side_{k}_optical", camera=CAMERA).to_cdr(),
            )
            for k in ("color", "depth")
        ),
        ("/lab/joint_states", still_at(stamp_ns)),
        ("/lab/cam/side/color/image", color.to_cdr()),
        ("/lab/cam/side/depth/image", depth.to_cdr()),
    ]
    for topic, data in messages:
        cell.publisher(topic, type_of_topic(topic) or "").put(data, source_ns=stamp_ns)


def plan_for(robot: str, plan_id: str = "plan_1") -> bytes:
    return plan_of(plan_id, robot=robot).to_json()


def test_a_plan_goes_in_and_a_verdict_comes_out_and_is_published(
    sessions: tuple[WireSession, WireSession],
) -> None:
    router, cell = sessions
    seen: dict[str, Any] = {}

    def localise(frames: Any, task: Any, ends_s: float) -> dict[str, Any]:
        seen["depth_m"] = float(frames[0].depth_m.max())
        item = SimpleNamespace(found=True, reason=None, T_base_object=np.eye(4))
        return dict.fromkeys(task.objects, item)

    def replay(plan: Plan, *_: Any) -> Verdict:
        return replace(accept(plan), terminal=Factor(value=False, cause="inside"))

    a_gate(router, LiveView("lab"), replay, localise)
    published: list[Any] = []
    cell.subscribe("lab/verdict", published.append)
    publish_one_frame(cell)

    answer = cell.query("lab/gate/verdict", plan_for("arm"), timeout_s=10.0)
    assert Verdict.from_json(answer).accepted is False
    assert seen["depth_m"] == pytest.approx(0.7)

    other = json.loads(cell.query("lab/gate/verdict", plan_for("another arm"), timeout_s=10.0))
    assert other["accepted"] is None
    assert "the cell's robot is 'arm'" in other["reason"]

    with pytest.raises(RemoteError, match="plan is invalid"):
        cell.query("lab/gate/verdict", b"{}", timeout_s=10.0)

    ends = time.monotonic() + 5
    while len(published) < 2 and time.monotonic() < ends:
        time.sleep(0.01)
    assert [sample.topic for sample in published] == ["/lab/verdict"] * 2
    assert published[0].data == answer
    assert published[0].source_ns == S


def a_gate(
    router: WireSession, perception: LiveView, replay: Any, found: Any, **settings: Any
) -> None:
    """Serve a gate whose cell has shown itself."""
    config = GateConfig(**{"cell": "lab", "frame_wait_s": 3.0, "deadline_s": 10.0, **settings})
    gate = Gate(
        tasks=JUDGED, config=config, perception=perception, localise=found, replay=replay,
        now_ns=router.now_ns,
    )  # fmt: skip
    watch_cell(router, "lab", perception.take)
    serve_gate(router, gate, perception, config, Output(quiet=True))


def everything_at(x_m: float = 0.0) -> dict[str, Any]:
    T = np.eye(4)
    T[0, 3] = x_m
    item = SimpleNamespace(found=True, reason=None, T_base_object=T, covariance=None)
    return dict.fromkeys(load_task("cube_into_box").objects, item)


def ask(cell: WireSession, payload: bytes | None = None) -> Verdict:
    data = plan_for("arm") if payload is None else payload
    return Verdict.from_json(cell.query("lab/gate/verdict", data, timeout_s=10.0))


ASKING = """
import sys, time
from bridge.wire.config import WireConfig
from bridge.wire.errors import NoReplyError
from bridge.wire.session import open_session
session, plan = open_session(WireConfig(connect=(sys.argv[1],))), sys.stdin.buffer.read()
while True:  # a session that has just been opened may not know of the service yet
    try:
        session.query("lab/gate/verdict", plan, timeout_s=60.0)
    except NoReplyError:
        time.sleep(0.1)
"""


def test_a_planner_that_dies_before_the_answer_leaves_the_gate_to_the_next(
    sessions: tuple[WireSession, WireSession], endpoint: str
) -> None:
    router, cell = sessions
    inside, go_on = threading.Semaphore(0), threading.Event()

    def replay(plan: Plan, *_: Any) -> Verdict:
        inside.release()
        go_on.wait(10)
        return accept(plan)

    a_gate(router, LiveView("lab"), replay, lambda *_: everything_at())
    published: list[Any] = []
    cell.subscribe("lab/verdict", published.append)
    publish_one_frame(cell)
    with subprocess.Popen(
        [sys.executable, "-c", ASKING, endpoint], stdin=subprocess.PIPE, cwd=ROOT
    ) as planner:
        try:
            assert planner.stdin is not None
            planner.stdin.write(plan_for("arm", "orphan"))
            planner.stdin.close()
            assert inside.acquire(timeout=30)
        finally:
            planner.kill()
            planner.wait(10)
    go_on.set()
    assert ask(cell, plan_for("arm", "next")).plan_id == "next"
    _until(lambda: len(published) == 2)
    assert [Verdict.from_json(item.data).plan_id for item in published] == ["orphan", "next"]


def test_a_second_gate_in_a_cell_is_refused_until_the_first_is_gone(
    sessions: tuple[WireSession, WireSession],
) -> None:
    """Of two answers the first one counts, and one of them may come from an older scene."""
    router, cell = sessions
    claim_gate(cell, "lab")
    _until(lambda: bool(router.query_alive("lab/gate/alive")))
    with pytest.raises(GateError, match=r"a gate answers on lab/gate/verdict already"):
        claim_gate(router, "lab")
    claim_gate(router, "another_lab")
    cell.close()
    _until(lambda: not router.query_alive("lab/gate/alive"))
    claim_gate(router, "lab")


def _until(holds: Callable[[], bool]) -> None:
    ends = time.monotonic() + 10
    while not holds() and time.monotonic() < ends:
        time.sleep(0.02)
