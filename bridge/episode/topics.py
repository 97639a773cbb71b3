"""The topics of an episode: their names, the type each carries, and how each travels.

The only place that spells them. A name that begins after the cell (``/joint_states`` of
``/lab/joint_states``) goes through ``cell_topic``; readers look for topics that end with it.
``docs/episode_format.md`` explains the topics field by field.
"""

import re
from functools import lru_cache
from typing import Literal

from bridge.episode import schema
from bridge.errors import UsageError

Service = Literal["control", "camera", "reliable"]
"""Small, frequent and never waits; large, the newest counts; nothing may be lost."""

TF = "/tf"
TF_STATIC = "/tf_static"
ROBOT_DESCRIPTION = "/robot_description"
DROPS = "/recorder/drops"
CLOCKS = "/recorder/clocks"
OF_RECORDER = frozenset((DROPS, CLOCKS))
TRUTH = "standin/truth"
"""Takes the place of the cell in topics that hold a stand-in cell's ground truth."""

JOINT_STATES = "/joint_states"
JOINT_TARGETS = "/joint_targets"
GRIPPER_STATE = "/gripper/state"
SPEED_SCALING = "/speed_scaling"
TCP_POSE = "/tcp/pose"
TCP_WRENCH = "/tcp/wrench"
WRENCH = "/wrench"
IMU = "/imu"
ODOMETRY = "/odometry"
POINTS = "/points"
PLAN = "/plan"
EVENT = "/event"
VERDICT = "/verdict"
GATE = "/gate/verdict"
"""A service, not a topic: a plan is asked, a verdict is answered."""
LOCALISE = "/gate/localise"
"""A service, not a topic: the name of a task is asked, where its objects are is answered."""
POLICY = "/policy"
"""A service, not a topic: who acts under a policy's name is answered, and a trial is begun."""
POLICY_TARGETS = "/policy/targets"
"""Joint positions and the distance between the pads, as a policy's runner sends them."""
STOPPED_BY_OPERATOR = "operator: the episode was ended"
"""A runner says so of a trial whose episode a person ended."""
LOCALISATION = "/localisation"
CLEARANCE = "/replay/clearance"
CONTACT = "/replay/contact"
DIVERGENCE = "/replay/divergence"
CAMERAS = "/cam/"
OBJECTS = "/object/"
TACTILE = "/tactile/"

COLOR_IMAGE = "/color/image"
COLOR_INFO = "/color/info"
DEPTH_IMAGE = "/depth/image"
DEPTH_INFO = "/depth/info"
TARGET_POSE = "/target/pose"
"""Of a calibration target in the frame of the camera."""
RENDERED_IMAGE = "/rendered/image"

COLOR_TOPIC = re.compile(f"{CAMERAS}([^/]+){COLOR_IMAGE}$")
RECORDED_TOPIC = re.compile(r"/cam/([^/]+)/(?:color|recorded)(?:/image)?$")
RENDERED_TOPIC = re.compile(r"/cam/([^/]+)/(?:color/)?(?:rendered|replayed)(?:/image)?$")
MASK_TOPIC = re.compile(r"/cam/([^/]+)/mask/([a-z_]+)(?:/image)?$")
RECORDED_DEPTH_TOPIC = re.compile(r"/cam/([^/]+)/recorded/depth(?:_in_color)?$")
RENDERED_DEPTH_TOPIC = re.compile(r"/cam/([^/]+)/rendered/depth$")

_TYPES: tuple[tuple[str, str], ...] = (
    (COLOR_TOPIC.pattern, schema.COMPRESSED_IMAGE),
    (f"{CAMERAS}[^/]+{DEPTH_IMAGE}$", schema.IMAGE),
    (f"{CAMERAS}[^/]+({COLOR_INFO}|{DEPTH_INFO})$", schema.CAMERA_INFO),
    (f"{JOINT_STATES}$", schema.JOINT_STATE),
    (f"({GRIPPER_STATE}|{POLICY_TARGETS})$", schema.JOINT_STATE),
    (f"^({TF}|{TF_STATIC})$", schema.TF_MESSAGE),
    (f"^{ROBOT_DESCRIPTION}$", schema.STRING),
    (f"{PLAN}$", schema.PLAN),
    (f"{EVENT}$", schema.EVENT),
    (f"{VERDICT}$", schema.VERDICT),
    (f"{CONTACT}$", schema.CONTACT),
    (f"{DIVERGENCE}$", schema.DIVERGENCE),
    (f"{OBJECTS}[^/]+/pose$", schema.POSE_STAMPED),
    (f"{OBJECTS}[^/]+/nodes$", schema.POINT_CLOUD),
    (f"{LOCALISATION}$", schema.LOCALISATION),
    (f"^{DROPS}$", schema.DROPS),
    (f"^{CLOCKS}$", schema.CLOCKS),
)
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


def cell_topic(cell: str, ending: str) -> str:
    """Name a topic of a cell: ``cell_topic("lab", JOINT_STATES)`` is ``/lab/joint_states``."""
    return f"/{cell}{ending}"


def camera_topic(cell: str, camera_id: str, ending: str = "") -> str:
    """Name a topic of a camera: ``COLOR_IMAGE``, ``DEPTH_INFO`` ...; "" is what all begin with."""
    return f"/{cell}{CAMERAS}{camera_id}{ending}"


def policy_key(cell: str, policy: str) -> str:
    """Key on which the runner of a policy answers, whatever letters its name has."""
    return f"{cell}{POLICY}/{re.sub(r'[^A-Za-z0-9_-]', '-', policy)}"


def object_topic(cell: str, object_id: str, what: Literal["pose", "nodes"]) -> str:
    """Name the topic of an object's pose or, of a soft one, of its points."""
    return f"/{cell}{OBJECTS}{object_id}/{what}"


@lru_cache(maxsize=1024)
def type_of_topic(topic: str) -> str | None:
    """Return the message type a topic of ours carries, or None for a foreign topic."""
    return next((name for pattern, name in _TYPES if re.search(pattern, topic)), None)


def service_of_topic(topic: str) -> Service:
    """Say how a topic should travel when the network is behind; ``wire.qos`` has the presets."""
    if topic.endswith((COLOR_IMAGE, DEPTH_IMAGE, POINTS)) or TACTILE in topic:
        return "camera"
    control = (JOINT_STATES, JOINT_TARGETS, POLICY_TARGETS, GRIPPER_STATE, SPEED_SCALING, TCP_POSE)
    return "control" if topic.endswith((*control, WRENCH, TF, IMU, ODOMETRY)) else "reliable"


def is_truth(topic: str) -> bool:
    """Say whether a topic holds stand-in ground truth, which ``twin`` must never read."""
    return topic.startswith(f"/{TRUTH}/")


def is_latched(topic: str) -> bool:
    """Say whether the last message of a topic stays true until the next."""
    return topic in (TF_STATIC, ROBOT_DESCRIPTION) or topic.endswith("/info")


def refuse_bad_name(what: str, name: str) -> None:
    """Check that a name can stand between two slashes."""
    if not _NAME.fullmatch(name):
        raise UsageError(
            f"{what} name {name!r} cannot be part of a topic. "
            "Use letters, digits and '_', starting with a letter."
        )
