"""Measurements of motions, repeated runs and final states: how far both sides are apart."""

from evaluator.metrics import state, trajectory
from evaluator.quantity import new_quantity as _new

# ruff: noqa: E501  # one line for each definition

TOOL = "tool centre point"
MOTIONS = {
    name: _new(
        f"motion.{{against}}.{name}",
        unit,
        "none" if name == "lag_s" else "lower",
        computed_by,
        f"{what}, {{meaning}}: {words}, mean over trials; aligned by {{how}}",
    )
    for name, unit, what, words, computed_by in (
        ("position_mean_m", "m", TOOL, "mean distance over time", trajectory.pose_errors),
        ("position_max_m", "m", TOOL, "largest distance over time", trajectory.pose_errors),
        ("end_point_m", "m", TOOL, "distance at the last common instant", trajectory.pose_errors),
        ("rotation_mean_rad", "rad", TOOL, "mean angle over time", trajectory.pose_errors),
        ("rotation_max_rad", "rad", TOOL, "largest angle over time", trajectory.pose_errors),
        ("end_point_rad", "rad", TOOL, "angle at the last common instant", trajectory.pose_errors),
        (
            "lag_s",
            "s",
            TOOL,
            "delay of least distance, a rigid motion apart",
            trajectory.find_lag_s,
        ),
        (
            "without_lag_mean_m",
            "m",
            TOOL,
            "mean distance after that delay is taken out",
            trajectory.position_errors,
        ),
        (
            "without_offset_mean_m",
            "m",
            TOOL,
            "mean distance after delay and best rigid motion are taken out",
            trajectory.without_rigid_motion,
        ),
        (
            "relative_mean_m",
            "m",
            TOOL,
            "mean difference of what both do within one second",
            trajectory.relative_errors,
        ),
        ("joint_rms_rad", "rad", "joints", "root mean square error", trajectory.joint_errors),
        ("joint_max_rad", "rad", "joints", "largest error of any joint", trajectory.joint_errors),
    )
}
"""By the field of ``MotionSummary`` they are the mean of."""

WHOLE = "whole recordings, waiting at their ends included"
MOVING = f"the moving part only, from leaving the start to arriving at the end, each within {trajectory.MOVING_THRESHOLD_M * 1000:.0f} mm"
_BODY = "body.{task}.{engine}.{body}."
BODY_DISTANCES = {
    name: _new(
        f"{_BODY}{name.removesuffix('_m')}_median_m",
        "m",
        "lower",
        None,
        f"{{what}}: {words}, median over recorded runs; replays against the run that they were made from, other simulated runs against every recorded one",
    )
    for name, words in (
        ("end_point_m", "distance of the end points"),
        ("displacement_m", "difference of the displacements from start to end"),
        ("over_time_m", f"mean distance over normalised time, {WHOLE}"),
        ("moving_over_time_m", f"mean distance over normalised time, {MOVING}"),
    )
}
"""By the field of ``BodyDistance``."""

_STATE = "state.{{by}}_to_{{against}}.{{task}}.{{condition}}.{name}"
_STATE_WORDS = "{{quantity}} after its last stage, {{who}} against {{other}}, in {{where}}: {kind} over {{count}} episodes of each one's mean over its objects"
STATES = {
    (name, kind): _new(
        _STATE.format(name=f"{name}_{kind}_{unit}"),
        unit,
        "lower",
        computed_by,
        _STATE_WORDS.format(kind=kind),
    )
    for name, kind, unit, computed_by in (
        ("position", "median", "m", None),
        ("position", "mean", "m", None),
        ("rotation", "median", "rad", state.turn_between_rad),
        ("extents", "median", "m", state.extents_difference_m),
    )
}
