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
    """The plan's own joints put the tool elsewhere than its own pose."""
    JOINT_LIMIT = "joint_limit"
    """A joint is beyond its limits of angle."""
    JOINT_JUMP = "joint_jump"
    """A joint changes by too much within one step of the path."""
    JOINT_SPEED = "joint_speed"
    """A joint moves faster than the robot can."""
    SELF_COLLISION = "self_collision"
    COLLISION = "collision"
    TOO_CLOSE = "too_close"
    """Two bodies that may not touch come nearer than is asked for."""
    DEEP_CONTACT = "deep_contact"
    """Bodies that may touch lie deep in each other."""
    PRE_GRASP_PENETRATION = "pre_grasp_penetration"
    """A link enters an object before the first grasp, where it was localised."""
    EXPLODED = "exploded"
    SHAPE = "shape"
    """A soft body is turned inside out, or torn, at the end."""
    PROBABILITY = "probability"
    """Too few varied replays succeed."""
    START_ELSEWHERE = "start_elsewhere"
    """The plan does not start where the robot is."""
    UNKNOWN_STAGE = "unknown_stage"
    REPEATED_STAGE = "repeated_stage"
    STAGE_TIMES = "stage_times"
    """A stage begins before the one before it, or ends before it begins."""
    STAGE_ORDER = "stage_order"
    """A stage that carries or releases begins before the gripper has closed."""
    CONTACT_NOT_ALLOWED = "contact_not_allowed"
    """The plan lets a pair touch in a stage in which the task does not."""
    JOINT_ACCELERATION = "joint_acceleration"
    """A joint is accelerated by more than the robot can."""
    TOOL_SPEED = "tool_speed"
    """The tool moves faster than the robot may."""
    TRACKING_ERROR = "tracking_error"
    """A joint is far from where it is commanded."""
    CONTACT_FORCE = "contact_force"
    """The arm is pressed harder than the robot bears."""
