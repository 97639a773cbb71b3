"""The topics of the cell on the wire, with their types; knows nothing of physics."""

import json
from collections.abc import Iterable, Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from bridge.episode import schema, topics
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    FrameTransform,
    JointSample,
    PointCloudSample,
    PoseSample,
    string_to_cdr,
    transforms_to_cdr,
)
from bridge.geometry.camera import Camera
from bridge.media.color import encode_jpeg
from bridge.robots.default import ARM_JOINTS, BASE_FRAME
from bridge.robots.robot import GRIPPER_WIDTH
from bridge.task.plan import Plan
from bridge.task.record import check_record
from bridge.wire.qos import Qos

TRUTH_PARAMETERS = topics.cell_topic(topics.TRUTH, "/parameters")


class Publisher(Protocol):
    """The part of ``bridge.wire.session.WirePublisher`` that the cell uses."""

    def put(self, data: bytes, *, source_ns: int) -> None:
        """Send one message of its topic."""


@runtime_checkable
class Session(Protocol):
    """The part of ``bridge.wire.session.WireSession`` that the cell uses."""

    def publisher(self, topic: str, type_name: str, *, qos: Qos = Qos.RELIABLE) -> Publisher:
        """Announce a topic."""

    def query(self, key: str, payload: bytes, *, timeout_s: float) -> bytes:
        """Ask and wait."""

    def subscribe(self, key_expression: str, callback: Any) -> Any:
        """Receive what matches."""


def color_frame(camera_id: str) -> str:
    """Frame in which colour images are taken."""
    return f"{camera_id}_color_optical"


def depth_frame(camera_id: str) -> str:
    """Frame in which depth images are taken."""
    return f"{camera_id}_depth_optical"


class Streams:
    """One method per kind of message; a topic is announced when it is first used."""

    def __init__(self, session: Session, cell: str) -> None:
        """Publish under ``/<cell>/``."""
        self._session = session
        self._cell = cell
        self._publishers: dict[str, Publisher] = {}
        self._latest_joints: tuple[bytes, int] | None = None

    def _put(self, topic: str, data: bytes, stamp_ns: int, type_name: str | None = None) -> None:
        publisher = self._publishers.get(topic)
        if publisher is None:
            known = type_name or topics.type_of_topic(topic)
            publisher = self._session.publisher(topic, known or schema.STRING, qos=Qos.RELIABLE)
            self._publishers[topic] = publisher
        publisher.put(data, source_ns=stamp_ns)

    def description(self, urdf: str, stamp_ns: int) -> None:
        """Publish the robot's URDF."""
        self._put(topics.ROBOT_DESCRIPTION, string_to_cdr(urdf), stamp_ns)

    def camera_poses(
        self, poses: Mapping[str, Float[np.ndarray, "4 4"]], stamp_ns: int, *, static: bool
    ) -> None:
        """Publish where the colour cameras are believed to be in ``base_link``."""
        items = [
            FrameTransform(
                stamp_ns=stamp_ns, parent=BASE_FRAME, child=color_frame(camera_id), T_parent_child=T
            )
            for camera_id, T in poses.items()
        ]
        if items:
            self._put(topics.TF_STATIC if static else topics.TF, transforms_to_cdr(items), stamp_ns)

    def depth_frames(self, camera_ids: Iterable[str], stamp_ns: int) -> None:
        """Publish that depth is aligned: each depth frame coincides with its colour frame."""
        items = [
            FrameTransform(
                stamp_ns=stamp_ns,
                parent=color_frame(camera_id),
                child=depth_frame(camera_id),
                T_parent_child=np.eye(4),
            )
            for camera_id in camera_ids
        ]
        self._put(topics.TF_STATIC, transforms_to_cdr(items), stamp_ns)

    def camera_info(self, camera_id: str, camera: Camera, stamp_ns: int) -> None:
        """Publish the intrinsics of colour and (aligned) depth."""
        for stream, frame in (("color", color_frame(camera_id)), ("depth", depth_frame(camera_id))):
            info = CameraInfo(stamp_ns=stamp_ns, frame_id=frame, camera=camera)
            topic = topics.camera_topic(self._cell, camera_id, f"/{stream}/info")
            self._put(topic, info.to_cdr(), stamp_ns)

    def frame(
        self,
        camera_id: str,
        image_u8: UInt8[np.ndarray, "height width 3"],
        depth_mm: UInt16[np.ndarray, "height width"],
        stamp_ns: int,
    ) -> None:
        """Publish colour and depth of one instant, aligned; a depth of 0 is "no measurement"."""
        color = CompressedColor(
            stamp_ns=stamp_ns,
            frame_id=color_frame(camera_id),
            format="jpeg",
            data=encode_jpeg(image_u8),
        )
        depth = DepthImage(stamp_ns=stamp_ns, frame_id=depth_frame(camera_id), depth_mm=depth_mm)
        prefix = topics.camera_topic(self._cell, camera_id)
        self._put(f"{prefix}{topics.COLOR_IMAGE}", color.to_cdr(), stamp_ns)
        self._put(f"{prefix}{topics.DEPTH_IMAGE}", depth.to_cdr(), stamp_ns)

    def joints(
        self,
        position: Float[np.ndarray, "6"],
        velocity: Float[np.ndarray, "6"],
        effort: Float[np.ndarray, "6"],
        stamp_ns: int,
    ) -> None:
        """Publish what the encoders say."""
        sample = JointSample(
            stamp_ns=stamp_ns, names=ARM_JOINTS, position=position, velocity=velocity, effort=effort
        )
        self._latest_joints = sample.to_cdr(), stamp_ns
        self._put(topics.cell_topic(self._cell, topics.JOINT_STATES), *self._latest_joints)

    def joints_again(self) -> None:
        """Publish the latest joint states once more: time stands still, and so does the arm."""
        if self._latest_joints is not None:
            self._put(topics.cell_topic(self._cell, topics.JOINT_STATES), *self._latest_joints)

    def gripper(self, width_m: float, stamp_ns: int) -> None:
        """Publish the distance between the pads."""
        sample = JointSample(
            stamp_ns=stamp_ns,
            names=(GRIPPER_WIDTH,),
            position=np.array([width_m]),
            velocity=np.zeros(0),
            effort=np.zeros(0),
        )
        self._put(topics.cell_topic(self._cell, topics.GRIPPER_STATE), sample.to_cdr(), stamp_ns)

    def tcp(self, T_base_tcp: Float[np.ndarray, "4 4"], stamp_ns: int) -> None:
        """Publish the controller's own forward kinematics."""
        sample = PoseSample(stamp_ns=stamp_ns, frame_id=BASE_FRAME, T_frame_body=T_base_tcp)
        topic = topics.cell_topic(self._cell, topics.TCP_POSE)
        self._put(topic, sample.to_cdr(), stamp_ns, schema.POSE_STAMPED)

    def truth_object(
        self, object_id: str, T_base_object: Float[np.ndarray, "4 4"], stamp_ns: int
    ) -> None:
        """Publish a true pose, for tests and the evaluator's perception metrics only."""
        sample = PoseSample(stamp_ns=stamp_ns, frame_id=BASE_FRAME, T_frame_body=T_base_object)
        self._put(topics.object_topic(topics.TRUTH, object_id, "pose"), sample.to_cdr(), stamp_ns)

    def truth_nodes(
        self, object_id: str, points_m: Float[np.ndarray, "num_points 3"], stamp_ns: int
    ) -> None:
        """Publish where the points of a soft object really are, in ``base_link``."""
        sample = PointCloudSample(stamp_ns=stamp_ns, frame_id=BASE_FRAME, points_m=points_m)
        self._put(topics.object_topic(topics.TRUTH, object_id, "nodes"), sample.to_cdr(), stamp_ns)

    def truth_parameters(self, record: Mapping[str, Any], stamp_ns: int) -> None:
        """Publish the hidden parameters as JSON text, under truth only."""
        self._put(TRUTH_PARAMETERS, string_to_cdr(json.dumps(record)), stamp_ns, schema.STRING)

    def plan(self, plan: Plan, stamp_ns: int) -> None:
        """Publish a plan."""
        self._put(topics.cell_topic(self._cell, topics.PLAN), plan.to_json(), stamp_ns)

    def event(self, kind: str, stamp_ns: int, **fields: Any) -> None:
        """Publish one event; the schema lists the kinds and the fields."""
        record = {"schema_version": 1, "stamp_ns": stamp_ns, "type": kind, **fields}
        check_record(record, name="event", package="bridge.episode")
        self._put(
            topics.cell_topic(self._cell, topics.EVENT), json.dumps(record).encode(), stamp_ns
        )
