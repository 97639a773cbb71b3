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

_DISTANCES = (
    (
        "mean_over_pairs_m",
        "m",
        "distance over normalised time, mean over all (recorded, simulated) pairs of runs",
    ),
    ("between_mean_curves_m", "m", "distance of the two mean curves, mean over normalised time"),
    ("max_between_mean_curves_m", "m", "largest distance of the two mean curves"),
    ("end_point_over_pairs_m", "m", "distance of the end points, mean over all pairs of runs"),
    ("end_point_between_means_m", "m", "distance of the mean end points"),
    (
        "turned_over_pairs_rad",
        "rad",
        "angle between what both turned since they began, over normalised time, mean over all (recorded, simulated) pairs of runs",
    ),
)
WHOLE = "whole recordings, waiting at their ends included"
MOVING = f"the moving part only, from leaving the start to arriving at the end, each within {trajectory.MOVING_THRESHOLD_M * 1000:.0f} mm"
_PARTS = (("", WHOLE), ("moving_", MOVING))
_BAND = "bands.{task}.{engine}."
BAND_DISTANCES = {
    prefix: {
        name: _new(
            f"{_BAND}{prefix}{name}",
            unit,
            "lower",
            trajectory.band_distance,
            f"{{what}}: {words}; {part}",
        )
        for name, unit, words in _DISTANCES
    }
    for prefix, part in _PARTS
}
"""By ``moving_`` or nothing, then by the field of ``BandDistance``."""
BAND_MEDIAN = {
    prefix: _new(
        f"{_BAND}{prefix}median_over_recorded_m",
        "m",
        "lower",
        trajectory.band_distance,
        f"{{what}}: median over recorded runs of the mean distance to these simulated runs, so where another recorded run would lie; {part}",
    )
    for prefix, part in _PARTS
}
BAND_ALONG_PATH = _new(
    f"{_BAND}moving_along_path_m",
    "m",
    "lower",
    trajectory.path_distance_m,
    f"{{what}}: distance at equal shares of the way, whatever the speed, mean over all (recorded, simulated) pairs of runs; {MOVING}",
)
BAND_WITHOUT_OFFSET = _new(
    f"{_BAND}moving_without_offset_m",
    "m",
    "lower",
    trajectory.without_rigid_motion,
    f"{{what}}: distance of the two mean curves after the best rigid motion is taken out, mean over normalised time; {MOVING}",
)
BAND_WIDTH = 2.0
"""The recorded band reaches this many of its root mean square distances from its mean curve."""
INSIDE_BAND = _new(
    f"{_BAND}moving_inside_band",
    "1",
    "higher",
    trajectory.band_distance,
    f"share of normalised time in which the simulated mean curve is nearer to the recorded one than {BAND_WIDTH:g} root mean square distances of the recorded runs from it; {MOVING}",
)
REPEATABILITY = {
    name: _new(
        f"repeatability.{{task}}.{{side}}.{name}",
        "m",
        "lower",
        trajectory.repeatability,
        f"end effector, spread of {{count}} {{side}} runs: {words}",
    )
    for name, words in (
        ("mean_m", "root mean square distance from the mean curve, mean over normalised time"),
        ("worst_m", "root mean square distance from the mean curve at its worst instant"),
        ("end_point_m", "root mean square distance from the mean end point"),
    )
}
"""By the field of ``Repeatability``."""

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
