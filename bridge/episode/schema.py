"""Message types and the schema of each. ``docs/episode_format.md`` explains them field by field."""

from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

_NAMES = {
    "builtin_interfaces": "Time Duration",
    "std_msgs": "Header String MultiArrayDimension MultiArrayLayout Float32MultiArray",
    "geometry_msgs": "Point Vector3 Quaternion Pose PoseStamped Wrench WrenchStamped Twist "
    "PoseWithCovariance TwistWithCovariance Transform TransformStamped",
    "nav_msgs": "Odometry",
    "sensor_msgs": "Imu JointState CompressedImage Image RegionOfInterest CameraInfo PointField "
    "PointCloud2",
    "tf2_msgs": "TFMessage",
    "trajectory_msgs": "JointTrajectoryPoint JointTrajectory",
}
ROS_TYPES = frozenset(
    f"{package}/msg/{name}" for package, names in _NAMES.items() for name in names.split()
)
"""The types of ROS 2 that are decoded here; messages of others are kept as they are."""


@cache
def ros_types() -> Any:
    """Definitions and layouts of ROS 2, made when they are first asked for."""
    from rosbags import typesys  # noqa: PLC0415  # a fifth of a second

    return typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)


def schema_text(name: str) -> str:
    """Return the ``ros2msg`` schema of a message with every type it is made of."""
    text: str = ros_types().generate_msgdef(name, ros_version=2)[0]
    return text


@dataclass(frozen=True, kw_only=True)
class StampedMessage:
    """One serialised message with the time its source made it."""

    topic: str
    type_name: str
    data: bytes
    stamp_ns: int


JOINT_STATE = "sensor_msgs/msg/JointState"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
IMAGE = "sensor_msgs/msg/Image"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
STRING = "std_msgs/msg/String"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
ODOMETRY = "nav_msgs/msg/Odometry"
IMU = "sensor_msgs/msg/Imu"
PLAN = "gst/Plan"
VERDICT = "gst/Verdict"
CONTACT = "gst/Contact"
DIVERGENCE = "gst/Divergence"
LOCALISATION = "gst/Localisation"
EVENT = "gst/Event"
DROPS = "recorder/Drops"
CLOCKS = "recorder/Clocks"
STATUS = "recorder/Status"
COMPRESSED_VIDEO = "foxglove.CompressedVideo"

_JSON_SCHEMAS = {
    PLAN: ("bridge.task", "schemas/plan.schema.json"),
    VERDICT: ("bridge.task", "schemas/verdict.schema.json"),
    CONTACT: ("bridge.task", "schemas/contact.schema.json"),
    DIVERGENCE: ("bridge.task", "schemas/divergence.schema.json"),
    LOCALISATION: ("bridge.task", "schemas/localisation.schema.json"),
    EVENT: ("bridge.episode", "schemas/event.schema.json"),
    DROPS: ("bridge.episode", "schemas/drops.schema.json"),
    CLOCKS: ("bridge.episode", "schemas/clocks.schema.json"),
    STATUS: ("bridge.episode", "schemas/status.schema.json"),
}


@dataclass(frozen=True, kw_only=True)
class Schema:
    """What the MCAP schema and channel records of one message type say."""

    name: str
    schema_encoding: str
    message_encoding: str
    data: bytes


@cache
def schema_for(name: str) -> Schema | None:
    """Return the schema of a type this project knows, or None."""
    if name in ROS_TYPES:
        definition, message, text = "ros2msg", "cdr", schema_text(name)
    elif name in _JSON_SCHEMAS:
        package, path = _JSON_SCHEMAS[name]
        text = resources.files(package).joinpath(path).read_text()
        definition, message = "jsonschema", "json"
    else:
        return None
    data = text.encode()
    return Schema(name=name, schema_encoding=definition, message_encoding=message, data=data)
