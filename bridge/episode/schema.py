"""Message types and the schema of each. ``docs/episode_format.md`` explains them field by field."""

import json
from dataclasses import dataclass
from functools import cache
from importlib import resources

# ``rosbags`` carries the same definitions; ``tests/parity`` compares ours with them.

SEPARATOR = "=" * 80

DEFINITIONS: dict[str, str] = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
    "builtin_interfaces/msg/Duration": "int32 sec\nuint32 nanosec\n",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "std_msgs/msg/String": "string data\n",
    "geometry_msgs/msg/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/msg/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/msg/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/msg/Pose": (
        "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
    ),
    "geometry_msgs/msg/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose\n",
    "geometry_msgs/msg/Wrench": "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n",
    "geometry_msgs/msg/WrenchStamped": "std_msgs/Header header\ngeometry_msgs/Wrench wrench\n",
    "geometry_msgs/msg/Twist": ("geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n"),
    "geometry_msgs/msg/PoseWithCovariance": ("geometry_msgs/Pose pose\nfloat64[36] covariance\n"),
    "geometry_msgs/msg/TwistWithCovariance": (
        "geometry_msgs/Twist twist\nfloat64[36] covariance\n"
    ),
    "nav_msgs/msg/Odometry": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
        "geometry_msgs/TwistWithCovariance twist\n"
    ),
    "std_msgs/msg/MultiArrayDimension": "string label\nuint32 size\nuint32 stride\n",
    "std_msgs/msg/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim\nuint32 data_offset\n",
    "std_msgs/msg/Float32MultiArray": "std_msgs/MultiArrayLayout layout\nfloat32[] data\n",
    "sensor_msgs/msg/Imu": (
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\n"
        "float64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\n"
        "float64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\n"
        "float64[9] linear_acceleration_covariance\n"
    ),
    "geometry_msgs/msg/Transform": (
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
    ),
    "geometry_msgs/msg/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
    ),
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "sensor_msgs/msg/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
        "float64[] effort\n"
    ),
    "sensor_msgs/msg/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data\n",
    "sensor_msgs/msg/Image": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
        "uint8 is_bigendian\nuint32 step\nuint8[] data\n"
    ),
    "sensor_msgs/msg/RegionOfInterest": (
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n"
    ),
    "sensor_msgs/msg/CameraInfo": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\n"
        "float64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\n"
        "uint32 binning_y\nsensor_msgs/RegionOfInterest roi\n"
    ),
    "sensor_msgs/msg/PointField": "string name\nuint32 offset\nuint8 datatype\nuint32 count\n",
    "sensor_msgs/msg/PointCloud2": (
        "std_msgs/Header header\nuint32 height\nuint32 width\n"
        "sensor_msgs/PointField[] fields\nbool is_bigendian\nuint32 point_step\n"
        "uint32 row_step\nuint8[] data\nbool is_dense\n"
    ),
    "trajectory_msgs/msg/JointTrajectoryPoint": (
        "float64[] positions\nfloat64[] velocities\nfloat64[] accelerations\nfloat64[] effort\n"
        "builtin_interfaces/Duration time_from_start\n"
    ),
    "trajectory_msgs/msg/JointTrajectory": (
        "std_msgs/Header header\nstring[] joint_names\n"
        "trajectory_msgs/JointTrajectoryPoint[] points\n"
    ),
}


def full_name(name: str) -> str:
    """Turn ``std_msgs/Header`` into ``std_msgs/msg/Header``; full names pass through."""
    package, _, rest = name.partition("/")
    return name if rest.startswith("msg/") else f"{package}/msg/{rest}"


def schema_text(name: str) -> str:
    """Return the ``ros2msg`` schema of a message with every type it is made of."""
    parts = [DEFINITIONS[name]]
    for dependency in _dependencies(name):
        short = dependency.replace("/msg/", "/")
        parts.append(f"{SEPARATOR}\nMSG: {short}\n{DEFINITIONS[dependency]}")
    return "".join(parts)


def _dependencies(name: str) -> list[str]:
    found: list[str] = []
    queue = [name]
    while queue:
        for line in DEFINITIONS[queue.pop(0)].splitlines():
            type_name = line.split()[0].split("[")[0]
            if "/" in type_name and full_name(type_name) not in found:
                found.append(full_name(type_name))
                queue.append(full_name(type_name))
    return found


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
JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
PLAN = "gst/Plan"
VERDICT = "gst/Verdict"
CONTACT = "gst/Contact"
DIVERGENCE = "gst/Divergence"
LOCALISATION = "gst/Localisation"
EVENT = "gst/Event"
DROPS = "recorder/Drops"
CLOCKS = "recorder/Clocks"
STATUS = "recorder/Status"
POSES_IN_FRAME = "foxglove.PosesInFrame"
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
    POSES_IN_FRAME: ("bridge.episode", "schemas/poses_in_frame.schema.json"),
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
    if name in DEFINITIONS:
        text = schema_text(name)
        return Schema(
            name=name, schema_encoding="ros2msg", message_encoding="cdr", data=text.encode()
        )
    if name in _JSON_SCHEMAS:
        package, path = _JSON_SCHEMAS[name]
        text = resources.files(package).joinpath(path).read_text()
        return Schema(
            name=name, schema_encoding="jsonschema", message_encoding="json", data=text.encode()
        )
    return None


def json_schema_version(name: str) -> int:
    """Return the major version of one of our JSON schemas."""
    schema = schema_for(name)
    if schema is None or schema.schema_encoding != "jsonschema":
        raise KeyError(f"{name} has no JSON schema")
    return int(json.loads(schema.data).get("version", 1))
