"""Measurements of motions, repeated runs and final states: how far both sides are apart."""

from evaluator.quantity import new_quantity as _new

# ruff: noqa: E501  # one line for each definition

MOTIONS = {
    name: _new(
        unit,
        "none" if name == "lag_s" else "lower",
        f"motion.{{against}}.{name}",
        f"tool centre point, {{meaning}}: {words}, mean over trials; aligned by {{how}}",
        (-0.2, 0.6) if name == "lag_s" else None,
    )
    for name, unit, words in (
        ("lag_s", "s", "delay of least distance, a rigid motion apart"),
        ("path_mean_m", "m", "mean distance over time after that delay is taken out"),
        ("path_max_m", "m", "largest distance over time after that delay is taken out"),
        ("position_mean_m", "m", "mean distance at equal times"),
        ("end_point_m", "m", "distance at the last common instant"),
        ("rotation_mean_rad", "rad", "mean angle over time"),
    )
}
"""By the field of ``MotionSummary`` they are the mean of."""

_BODY = "body.{task}.{engine}.{body}."
BODY_DISTANCES = {
    name: _new(
        unit,
        "none" if unit == "s" else "lower",
        f"{_BODY}{name.rpartition('_')[0]}_median_{unit}",
        f"{{what}}: {words}, median over recorded runs; replays against the run that they were made from, other simulated runs against every recorded one",
        (-0.2, 0.6) if unit == "s" else None,
    )
    for name, unit, words in (
        ("end_point_m", "m", "distance of the end points"),
        ("displacement_m", "m", "difference of the displacements from start to end"),
        (
            "path_mean_m",
            "m",
            "mean distance over time, clocks begun where the body leaves its start and the remaining lag taken out",
        ),
        ("lag_s", "s", "by how much the recorded body then comes later"),
    )
}
"""By what they measure."""

STATES = {
    name: _new(
        unit,
        "lower",
        f"state.{{by}}_to_{{against}}.{{task}}.{{condition}}.{name}_median_{unit}",
        "{quantity} after its last stage, {who} against where it was localised, in {where}: median over {count} episodes of each one's mean over its objects",
    )
    for name, unit in (("position", "m"), ("rotation", "rad"))
}
