"""The README of an exported dataset: what its numbers mean."""

from typing import Any

from bridge.exchange.lerobot import layout
from bridge.exchange.lerobot.sampling import ActionKind
from bridge.exchange.lerobot.writer import DatasetShape

_HEAD = """---
task_categories:
- robotics
tags:
- LeRobot
configs:
- config_name: default
  data_files: data/*/*.parquet
---

"""
_ACTIONS = {
    "plan": (
        "what the executed plan commands for the time of the next row (joints interpolated "
        "between waypoints, the gripper's width held until the next command)"
    ),
    "next_state": "the measured state of the next row; the last row repeats its own",
}


def card_text(shape: DatasetShape, kind: ActionKind, table: list[dict[str, Any]]) -> str:
    """Return the text; every choice that changes a number is in it."""
    cameras = ", ".join(shape.cameras) or "none"
    stand_in = sum(bool(row["stand_in"]) for row in table)
    origin = (
        f"{stand_in} of {len(table)} episodes come from a stand-in cell (simulated), not from a "
        "real robot."
        if stand_in
        else "Recorded from a real cell, as its episodes say."
    )
    success = (
        f"`{layout.SUCCESS}` is true in the last row of an episode whose operator said success."
        if shape.labelled
        else f"No `{layout.SUCCESS}`: not every episode is labelled success or failure; "
        "the labels there are stand in `robot_gst_export.json`."
    )
    return (
        f"{_HEAD}# {len(table)} episodes in LeRobotDataset {layout.VERSION}\n\n"
        f"Written by robot-gst. {origin}\n\n"
        f"- Rows are 1/{shape.fps} s apart, from the first instant at which joints and all cameras "
        "were there; `robot_gst_export.json` has that instant of every episode [ns].\n"
        f"- `{layout.STATE}`: {', '.join(shape.names)} as measured, linearly interpolated at the "
        "row's time [rad; m for the gripper's width].\n"
        f"- `{layout.ACTION}`: {_ACTIONS[kind]}.\n"
        f"- Cameras: {cameras}. A row has the image nearest in time, re-encoded as H.264 "
        f"(crf {shape.crf}, lossy).\n"
        f"- `{layout.DONE}` is true in the last row. {success}\n"
        "- Left out: depth (the format's videos hold 8-bit colour), plans, events, verdicts.\n"
        "- Image statistics look at every fourth pixel of both axes.\n"
    )
