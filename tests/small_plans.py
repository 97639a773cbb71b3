"""The smallest plan that the schema accepts, but for what a test says."""

from typing import Any

import numpy as np

from bridge.geometry import se3
from bridge.task.plan import Plan, Waypoint

STANDS = Waypoint(t_ns=0, p_m=(0.4, 0.0, 0.3), q_wxyz=(1.0, 0.0, 0.0, 0.0), g=0)


def plan_of(plan_id: str = "p", **more: Any) -> Plan:
    said = {
        "planner": "test",
        "policy": "scripted",
        "condition": "without_replanning",
        "robot": "ur5",
        "frame": "base_link",
        "instruction": "",
        "stages": (),
        "tau": (STANDS,),
    }
    return Plan(id=plan_id, **{**said, **more})


def waypoint(t_s: float, T_base_tcp: np.ndarray, width_m: float | None, g: int = 0) -> Waypoint:
    q, p = se3.split(T_base_tcp)
    return Waypoint(
        t_ns=round(t_s * 1e9), p_m=tuple(p.tolist()), q_wxyz=tuple(q.tolist()), g=g, width_m=width_m
    )
