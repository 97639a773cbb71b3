"""Why a verdict says no: every cause that a factor or a check of I(tau) may name.

Beside these the factor ``terminal`` names the kinds of success predicates
(``bridge.task.predicate``).
"""

from enum import StrEnum


class Cause(StrEnum):
    """A failed factor's cause, as verdicts keep it."""

    UNREACHABLE = "unreachable"
    """No joints within their limits reach a pose of the plan."""
    JOINTS_DISAGREE = "joints_disagree"
    JOINT_LIMIT = "joint_limit"
    JOINT_JUMP = "joint_jump"
    JOINT_SPEED = "joint_speed"
    SELF_COLLISION = "self_collision"
    COLLISION = "collision"
    TOO_CLOSE = "too_close"
    DEEP_CONTACT = "deep_contact"
    PRE_GRASP_PENETRATION = "pre_grasp_penetration"
    """A link enters an object before the first grasp, where it was localised."""
    EXPLODED = "exploded"
    SHAPE = "shape"
    """A soft body is turned inside out, or torn, at the end."""
    PROBABILITY = "probability"
    START_ELSEWHERE = "start_elsewhere"
    UNKNOWN_STAGE = "unknown_stage"
    REPEATED_STAGE = "repeated_stage"
    STAGE_TIMES = "stage_times"
    """A stage begins before the one before it, or ends before it begins."""
    STAGE_ORDER = "stage_order"
    """A stage that carries or releases begins before the gripper has closed."""
    CONTACT_NOT_ALLOWED = "contact_not_allowed"
    """The plan lets a pair touch in a stage in which the task does not."""
    JOINT_ACCELERATION = "joint_acceleration"
    JOINT_JERK = "joint_jerk"
    JOINT_TORQUE = "joint_torque"
    PAYLOAD = "payload"
    TOOL_SPEED = "tool_speed"
    ELBOW_SPEED = "elbow_speed"
    MOMENTUM = "momentum"
    POWER = "power"
    STOP_TIME = "stop_time"
    """Like those before it: more than the robot may."""
    TRACKING_ERROR = "tracking_error"
    CONTACT_FORCE = "contact_force"
