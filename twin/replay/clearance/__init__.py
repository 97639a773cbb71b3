"""The clearance delta(x_t) of I(tau): who comes too close to what (errata resolution 8)."""

from twin.replay.clearance.bodies import GRIPPER, SCENE, TABLE
from twin.replay.clearance.monitor import ClearanceMonitor, active_stage

__all__ = ["GRIPPER", "SCENE", "TABLE", "ClearanceMonitor", "active_stage"]
