"""gst verdict v1: the acceptance indicator I(tau) with its three factors and first failure."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from bridge.task.record import check_record, made_of, parse_record

SCHEMA_VERSION = 1
STAND_IN_ENGINE = "mujoco"  # moves the stand-in cell
SAME_ENGINE = "same engine as the cell"  # among the warnings of such a verdict


def is_same_engine(engine: str | None, *, stand_in: bool) -> bool:
    """Whether a verdict comes, wholly or in part, from the engine that moved the cell itself.

    Such a verdict agrees with what was recorded for a reason that no real cell gives: it is shown
    and never counted.
    """
    return stand_in and STAND_IN_ENGINE in (engine or "")


@dataclass(frozen=True, kw_only=True)
class Factor:
    """One factor of I(tau). ``value`` is None when it could not be decided."""

    value: bool | None
    first_t_ns: int | None = None
    cause: str | None = None
    bodies: tuple[str, ...] = ()
    detail: str | None = None


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """I(tau) = ik x clearance x terminal, times further checks, each with its first failure."""

    plan_id: str
    trajectory: str
    mode: str
    ik: Factor
    clearance: Factor
    terminal: Factor
    engine: str
    seed: int
    scene_hash: str | None = None
    calibration_id: str | None = None
    p_success: dict[str, int | float] | None = None
    samples: Mapping[str, Any] | None = None
    """Of each varied replay, in columns (the schema); None where there are none."""
    reason: str | None = None
    warnings: tuple[str, ...] = ()
    """What does not change the verdict but a reader should know: the goal held before anything
    moved, a shape that was stood in for."""
    findings: tuple[dict[str, Any], ...] = ()
    """What each predicate said, by side: kind, object, value, detail, short_m (the schema)."""
    checks: Mapping[str, Factor] = field(default_factory=dict)
    """Further factors, see docs/gate.md: start, task, limits, audit; absent: not asked for."""
    grasps: tuple[dict[str, Any], ...] = ()
    """What became of each grasp in the simulation: object, held (yes or no), and T_base_object,
    where it was at the end; a planner steers by them."""
    nearest: Mapping[str, Any] | None = None
    """Where the smallest clearance was, of the pairs that may not touch: t_ns, distance_m, bodies.
    None where nothing was measured."""
    basis: Mapping[str, Any] | None = None
    """What a yes holds for: plan_sha256 of the bytes that were judged, joints_rad, objects (p_m and
    margin_m of each), judged_ns on the cell's clock, and valid_s from then on."""

    def factors(self) -> dict[str, Factor]:
        """All factors by name, in the order in which a plan is examined."""
        three = {"ik": self.ik, "clearance": self.clearance, "terminal": self.terminal}
        known = {**self.checks, **three}
        order = ("start", "task", "ik", "clearance", "limits", "terminal", "audit")
        return {name: known[name] for name in (*order, *known) if name in known}

    @property
    def accepted(self) -> bool | None:
        """The product of the factors in three-valued logic; never yes by default."""
        values = [factor.value for factor in self.factors().values()]
        if False in values:
            return False
        return None if None in values else True

    @property
    def first_failing(self) -> str | None:
        """Name of the first factor that is false, in the order of ``factors``."""
        return next((name for name, item in self.factors().items() if item.value is False), None)

    def to_json(self) -> bytes:
        """Serialise, refusing what the schema refuses."""
        record = {"schema_version": SCHEMA_VERSION, "accepted": self.accepted, **asdict(self)}
        record = json.loads(json.dumps(record))
        if not record["grasps"]:
            del record["grasps"]
        for name in ("nearest", "basis", "samples"):
            if record[name] is None:
                del record[name]
        check_record(record, name="verdict")
        return json.dumps(record, separators=(",", ":")).encode()

    @staticmethod
    def from_json(data: bytes) -> "Verdict":
        """Parse and check. Raises ``InvalidRecordError`` naming what does not fit."""
        record = parse_record(data, name="verdict")
        said = {name: value for name, value in record.items() if value is not None}
        return made_of(
            Verdict, {"trajectory": "planned", "mode": "dynamic", **said}, name="verdict"
        )
