"""Why a verdict says no: every cause that a factor or a check of I(tau) may name.

Beside these the factor ``terminal`` names the kinds of success predicates
(``bridge.task.predicate``).
"""

from enum import StrEnum


class Cause(StrEnum):
    """A failed factor's cause, as verdicts keep it."""

    UNREACHABLE = "unreachable"
    JOINTS_DISAGREE = "joints_disagree"
    JOINT_LIMIT = "joint_limit"
    JOINT_JUMP = "joint_jump"
    JOINT_SPEED = "joint_speed"
    SELF_COLLISION = "self_collision"
    COLLISION = "collision"
    TOO_CLOSE = "too_close"
    DEEP_CONTACT = "deep_contact"
    PRE_GRASP_PENETRATION = "pre_grasp_penetration"
    EXPLODED = "exploded"
    SHAPE = "shape"
    PROBABILITY = "probability"
    START_ELSEWHERE = "start_elsewhere"
    UNKNOWN_STAGE = "unknown_stage"
    REPEATED_STAGE = "repeated_stage"
    STAGE_TIMES = "stage_times"
    STAGE_ORDER = "stage_order"
    CONTACT_NOT_ALLOWED = "contact_not_allowed"
    JOINT_ACCELERATION = "joint_acceleration"
    JOINT_JERK = "joint_jerk"
    JOINT_TORQUE = "joint_torque"
    PAYLOAD = "over_payload"
    TOOL_SPEED = "tool_speed"
    ELBOW_SPEED = "elbow_speed"
    MOMENTUM = "momentum"
    POWER = "motor_power"
    STOP_TIME = "stop_time"
    TRACKING_ERROR = "tracking_error"
    CONTACT_FORCE = "contact_force"
