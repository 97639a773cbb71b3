"""Rollouts under varied conditions: what is drawn, what it changes, and what goes with failure."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bridge.errors import UsageError
from twin.policies.starts import Start
from twin.replay.config import FRICTIONS
from twin.replay.monte_carlo import sample_rng, wilson

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "rad": 1.0, "deg": np.pi / 180, "%": 1e-2}
LENGTHS, ANGLES, SHARES = ("m", "cm", "mm"), ("rad", "deg"), ("%",)
POSITION, ANGLE = ".position", ".angle"
LEAST_ROLLOUTS = 8
"""With fewer no effect is told."""


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """One thing that is varied, evenly up to a spread to either side."""

    name: str
    """light, mass, friction, objects.position, or camera.ID.position or .angle."""
    spread: float
    """In m, rad, or as a share of what it is."""
    unit: str
    """As it was given."""

    @property
    def size(self) -> int:
        """How many numbers are drawn."""
        if self.name.startswith("camera."):
            return 3
        return 2 if self.name.endswith(POSITION) else 1

    def amount(self, value: Sequence[float]) -> float:
        """What was drawn, as one number in its own unit: signed, of a vector its length."""
        one = value[0] if len(value) == 1 else float(np.linalg.norm(value))
        return one / UNITS[self.unit]


def read_quantities(wanted: Sequence[str]) -> tuple[Quantity, ...]:
    """Read what is to be varied, such as ``light=20%`` or ``camera.side.position=30mm``.

    Raises:
        UsageError: When a quantity is unknown, twice there, or its spread makes no sense.
    """
    found: dict[str, Quantity] = {}
    for text in ",".join(wanted).split(",") if wanted else ():
        match = re.fullmatch(r"\s*([\w.-]+)=(\d+(?:\.\d+)?)\s*(m|cm|mm|rad|deg|%)\s*", text)
        units = _units(match[1]) if match else None
        if match is None or units is None or match[3] not in units:
            raise UsageError(
                f"--vary {text!r}: give light, mass or friction in %, objects.position in mm, "
                "camera.ID.position in mm, camera.ID.angle in deg; such as light=20%"
            )
        name, spread = match[1], float(match[2]) * UNITS[match[3]]
        if name in found or spread <= 0 or (units == SHARES and spread >= 1):
            raise UsageError(f"--vary {text!r}: once each, more than 0, and less than 100 %")
        found[name] = Quantity(name=name, spread=spread, unit=match[3])
    return tuple(found.values())


def _units(name: str) -> tuple[str, ...] | None:
    if name in ("light", "mass", "friction"):
        return SHARES
    if name == f"objects{POSITION}" or re.fullmatch(r"camera\.[\w-]+\.position", name):
        return LENGTHS
    return ANGLES if re.fullmatch(r"camera\.[\w-]+\.angle", name) else None


Drawn = Mapping[str, tuple[float, ...]]
"""Values by quantity, in m, rad or shares."""


def draw(quantities: Sequence[Quantity], seed: int, start_id: str, number: int) -> Drawn:
    """The conditions of one rollout: the same for every policy, whatever else is varied."""
    found = {}
    for item in quantities:
        rng = sample_rng(seed, f"{start_id}/{item.name}", number)
        found[item.name] = tuple((item.spread * rng.uniform(-1.0, 1.0, item.size)).tolist())
    return found


def varied_start(start: Start, drawn: Drawn) -> Start:
    """A start with other masses, frictions and places of what can be moved."""
    share = {name: 1.0 + values[0] for name, values in drawn.items()}
    physics = start.config.physics
    for name in FRICTIONS:
        physics = replace(physics, **{name: getattr(physics, name) * share.get("friction", 1.0)})
    objects = {
        name: model
        if model.fixed
        else replace(model, mass_kg=model.mass_kg * share.get("mass", 1.0))
        for name, model in start.task.objects.items()
    }
    places = {name: T.copy() for name, T in start.scene.Ts_base_object.items()}
    for name in start.scene.movable():
        if name in places:
            places[name][:2, 3] += drawn.get(f"objects{POSITION}", (0.0, 0.0))
    task = replace(start.task, objects=objects)
    scene = replace(start.scene, task=task, Ts_base_object=places)
    return replace(start, scene=scene, config=replace(start.config, physics=physics))


def effects(
    rows: Sequence[Mapping[str, Any]], quantities: Sequence[Quantity]
) -> Iterator[dict[str, Any]]:
    """What each quantity did: success of the half that was varied most, less that of the other.

    Quantities are drawn independently, so the others average out. The 95 % interval is
    Newcombe's (1998, method 10), of two Wilson intervals.
    """
    judged = [row for row in rows if row["success"] is not None]
    if len(judged) < LEAST_ROLLOUTS:
        return
    done = np.array([bool(row["success"]) for row in judged])
    for item in quantities:
        amount = np.array([abs(row["varied"][item.name]) for row in judged])
        most = amount > np.median(amount)
        (k, n), (j, m) = ((int(done[half].sum()), int(half.sum())) for half in (most, ~most))
        if not n or not m:
            continue
        p, q = k / n, j / m
        (low, high), (below, above) = wilson(p, n), wilson(q, m)
        yield {
            "quantity": item.name,
            "varied_most": [k, n],
            "varied_least": [j, m],
            "from": float(np.median(amount)),
            "unit": item.unit,
            "difference": p - q,
            "low": p - q - float(np.hypot(p - low, above - q)),
            "high": p - q + float(np.hypot(high - p, q - below)),
        }


def describe_effect(effect: Mapping[str, Any]) -> str:
    """One line on a quantity."""
    (k, n), (j, m) = effect["varied_most"], effect["varied_least"]
    points = [100 * effect[key] for key in ("difference", "low", "high")]
    says = "goes with failure" if effect["high"] < 0 else "no effect is shown"
    return (
        f"{effect['quantity']}: beyond {effect['from']:.3g} {effect['unit']} {k} of {n} succeed, "
        f"within {j} of {m}: {points[0]:+.0f} points [{points[1]:+.0f}, {points[2]:+.0f}], {says}"
    )
