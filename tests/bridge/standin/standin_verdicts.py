"""What a gate answers about a plan that it was sent."""

import hashlib
import json
from typing import Any

from verdicts import verdict_of

from bridge.task.verdict import Factor


def verdict_on(plan: dict[str, Any], terminal: Factor) -> dict[str, Any]:
    as_sent = json.dumps(plan, separators=(",", ":")).encode()
    basis = {
        "plan_sha256": hashlib.sha256(as_sent).hexdigest(),
        "joints_rad": plan["tau"][0]["joints_rad"] if "tau" in plan else [0.0],
        "objects": {},
        "judged_ns": 0,
        "valid_s": 1e12,
    }
    return dict(json.loads(verdict_of(plan["id"], terminal=terminal, basis=basis).to_json()))
