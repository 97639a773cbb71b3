"""Verdicts that all is well, but for what a test says."""

from typing import Any

from bridge.task.verdict import Factor, Verdict


def verdict_of(plan_id: str = "p", **more: Any) -> Verdict:
    """Of a plan; of a factor that is no ``Factor`` the value is enough."""
    parts = {"ik": True, "clearance": True, "terminal": True, **more}
    for name in ("ik", "clearance", "terminal"):
        if not isinstance(parts[name], Factor):
            parts[name] = Factor(value=parts[name])
    said = {"trajectory": "planned", "mode": "dynamic", "engine": "test", "seed": 0}
    return Verdict(plan_id=plan_id, **{**said, **parts})
