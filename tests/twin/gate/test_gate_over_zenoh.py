"""The gate on a real zenoh network on the loopback address, with a fake replay."""

import json
import socket
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bridge.episode import schema
from bridge.episode.records import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    FrameTransform,
    string_to_cdr,
    transforms_to_cdr,
)
from bridge.geometry.camera import Camera
from bridge.media.color import encode_jpeg
from bridge.task.plan import Plan, Stage, Waypoint
from bridge.task.task_file import load_task
from bridge.task.verdict import Factor, Verdict
from bridge.terminal import Output
from bridge.wire.config import WireConfig
from bridge.wire.errors import RemoteError
from bridge.wire.session import WireSession, open_session
from twin.gate.config import GateConfig
from twin.gate.judge import Gate
from twin.gate.service import serve_gate, watch_cell
from twin.scene.live import LiveView

CAMERA = Camera(width=8, height=6, fx=10.0, fy=10.0, cx=4.0, cy=3.0)
S = 1_000_000_000


@pytest.fixture
def sessions() -> Iterator[tuple[WireSession, WireSession]]:
    """A router, and a client of it that plays the cell."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with (
        open_session(WireConfig(mode="router", connect=(), listen=(endpoint,))) as router,
        open_session(WireConfig(connect=(endpoint,))) as cell,
    ):
        yield router, cell


def publish_one_frame(cell: WireSession) -> None:
    frames = [
        FrameTransform(
            stamp_ns=S, parent="base_link", child=f"side_{k}_optical", T_parent_child=np.eye(4)
        )
        for k in ("color", "depth")
    ]
    image = encode_jpeg(np.full((6, 8, 3), 99, dtype=np.uint8))
    color = CompressedColor(stamp_ns=S, frame_id="c", format="jpeg", data=image)
    depth = DepthImage(stamp_ns=S, frame_id="d", depth_mm=np.full((6, 8), 700, dtype=np.uint16))
    messages = [
        ("/robot_description", string_to_cdr('<robot name="arm"/>')),
        ("/tf_static", transforms_to_cdr(frames)),
        *(
            (
                f"/lab/cam/side/{k}/info",
                CameraInfo(stamp_ns=S, frame_id=f"side_{k}_optical", camera=CAMERA).to_cdr(),
            )
            for k in ("color", "depth")
        ),
        ("/lab/cam/side/color/image", color.to_cdr()),
        ("/lab/cam/side/depth/image", depth.to_cdr()),
    ]
    for topic, data in messages:
        cell.publisher(topic, schema.type_of_topic(topic) or "").put(data, source_ns=S)


def plan_for(robot: str) -> bytes:
    return Plan(
        id="plan_1",
        planner="test",
        policy="test",
        condition="with_replanning",
        robot=robot,
        frame="base_link",
        instruction="Put the red cube into the box.",
        stages=(Stage(id="grasp", text="Grasp the cube."),),
        tau=(Waypoint(t_ns=0, p_m=(0.4, 0.0, 0.3), q_wxyz=(1.0, 0.0, 0.0, 0.0), g=0),),
    ).to_json()


def test_a_plan_goes_in_and_a_verdict_comes_out_and_is_published(
    sessions: tuple[WireSession, WireSession],
) -> None:
    router, cell = sessions
    eyes, config = LiveView("lab"), GateConfig(cell="lab", frame_wait_s=3.0, deadline_s=10.0)
    seen: dict[str, Any] = {}

    def localise(frames: Any, task: Any, ends_s: float) -> dict[str, Any]:
        seen["depth_m"] = float(frames[0].depth_m.max())
        item = SimpleNamespace(found=True, reason=None, T_base_object=np.eye(4))
        return dict.fromkeys(task.objects, item)

    def replay(plan: Plan, poses: dict[str, Any], urdf: str, ends_s: float) -> Verdict:
        yes = Factor(value=True)
        return Verdict(
            plan_id=plan.id,
            trajectory="planned",
            mode="dynamic",
            ik=yes,
            clearance=yes,
            terminal=Factor(value=False, cause="inside"),
            engine="fake",
            seed=0,
        )

    gate = Gate(
        task=load_task("cube_into_box"),
        config=config,
        eyes=eyes,
        localise=localise,
        replay=replay,
        now_ns=router.now_ns,
    )
    watch_cell(router, "lab", eyes.take)
    serve_gate(router, gate, eyes, config, Output(quiet=True))
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
