"""How numbers are written for people: rounding happens here and nowhere earlier."""

import math
import re
from collections.abc import Mapping

from evaluator.compare.tables import METHOD_NAMES
from evaluator.quantity import noun
from evaluator.report.sections import HEADLINES
from evaluator.report.views import Shown
from evaluator.result import Measurement, Results

SIM_SIDE = "sim_planned"
"""The twin's side where there were plans: planned trajectory, dynamic, of the plan sent."""
SHOWN_UNITS: dict[str, tuple[float, str, str]] = {
    "m": (1000.0, " mm", ".2f"),
    "rad": (180.0 / math.pi, "°", ".2f"),
    "dB": (1.0, " dB", ".2f"),
    "pp": (1.0, " pp", "+.1f"),
    "count": (1.0, "", ".0f"),
    "s": (1000.0, " ms", "+.0f"),
}
"""Factor, unit and digits in which a reader thinks."""
PLAIN = (1.0, "", ".3f")
UNSIGNED = ("agreement.mae_pp", "decision.regret_pp", "decision.wrong_pairs_pp")
"""Sizes in percentage points that are never below 0: a plus would look like a direction."""
HUGE = 1e7
"""Nobody reads more digits before the point."""


def number(value: float, unit: str) -> str:
    """Write a value in the unit a reader thinks in."""
    _, name, _ = SHOWN_UNITS.get(unit, PLAIN)
    return f"{_figure(value, unit)}{name}"


def _figure(value: float, unit: str) -> str:
    factor, _, digits = SHOWN_UNITS.get(unit, PLAIN)
    if abs(value) >= HUGE and unit != "count":
        return f"{factor * value:.4g}"
    text = f"{factor * value:{digits}}"
    if float(text):
        return text
    return f"{factor * value:.1g}" if value else text.lstrip("+")  # small is not nothing


def is_share(measurement: Measurement) -> bool:
    """Say whether the value is a share of something, which people read in percent."""
    counted = measurement.k is not None and measurement.n is not None
    return measurement.unit == "1" and (counted or measurement.id.startswith("rate"))


def value_text(measurement: Measurement) -> str:
    """Write the value alone."""
    if measurement.value is None:
        return "undefined"
    if is_share(measurement):
        return f"{100 * measurement.value:.1f} %"
    text = number(measurement.value, measurement.unit)
    return text.lstrip("+") if measurement.id in UNSIGNED else text


def count_text(measurement: Measurement) -> str:
    """Write what the value rests on: ``5/6 trials`` or ``6 groups``."""
    if measurement.n is None:
        return ""
    named = f" {noun(measurement.counted, measurement.n)}" if measurement.counted else ""
    if measurement.k is not None and measurement.value is not None:
        return f"{measurement.k}/{measurement.n}{named}"
    return f"{measurement.n}{named}"


def ends_text(measurement: Measurement) -> str:
    """Write the ends of the interval in the unit that stands at the value, or nothing."""
    interval = measurement.interval
    if interval is None:
        return ""
    if is_share(measurement):
        return f"[{100 * interval.low:.1f}, {100 * interval.high:.1f}]"
    low, high = (_figure(end, measurement.unit) for end in (interval.low, interval.high))
    if measurement.id in UNSIGNED:
        low, high = low.lstrip("+"), high.lstrip("+")
    return f"[{low}, {high}]"


def method_text(measurement: Measurement) -> str:
    """Write level and method of the interval, or nothing."""
    interval = measurement.interval
    if interval is None:
        return ""
    return f"{100 * interval.level:.0f} % {METHOD_NAMES.get(interval.method, interval.method)}"


def measurement_text(measurement: Measurement) -> str:
    """Write value, count and interval, or why there is none."""
    if measurement.value is None:
        return f"undefined: {measurement.reason_if_undefined}"
    text = value_text(measurement)
    if measurement.k is not None and measurement.n is not None:
        text = f"{measurement.k}/{measurement.n} = {text}"
    elif measurement.n is not None and measurement.counted:
        text += f" (n = {count_text(measurement)})"
    if measurement.interval is None:
        return text
    beyond = "; without the noise of counting it lies in" if measurement.is_beyond else ""
    return f"{text}{beyond} {ends_text(measurement)} ({method_text(measurement)})"


def headlines(results: Results) -> list[tuple[str, str, Measurement]]:
    """Return (label, text, measurement) of the numbers to read first, those that are there."""
    by_id = {measurement.id: measurement for measurement in results.measurements}
    listed = HEADLINES
    if agreeing_side(by_id) == "sim_executed":
        listed = {
            name.replace("sim_planned", "sim_executed"): label.replace(
                "Twin ", "Executed in twin "
            ).replace("the twin says", "that says")
            for name, label in HEADLINES.items()
            if not name.startswith("motion.planned.")
        }
    found = [(label, by_id[name]) for name, label in listed.items() if name in by_id]
    if results.source not in ("run", "images"):  # who gave a table knows what is not in it
        found = [(label, m) for label, m in found if m.value is not None]
    return [(label, measurement_text(m), m) for label, m in found]


def agreeing_side(by_id: Mapping[str, Measurement]) -> str:
    """The side whose agreement is shown first: ``SIM_SIDE``, or sim_executed without any plan."""
    sides = (SIM_SIDE, "sim_executed")
    rates = {side: by_id.get(f"agreement.{side}.rate") for side in sides}
    return next((side for side, rate in rates.items() if rate is not None and rate.n), sides[0])


STAND_IN = (
    "Stand-in: every recorded outcome here comes from a simulated laboratory, not from a real "
    "robot."
)
"""The warning every page made from a simulated laboratory carries."""


def cell_text(cell: Shown) -> str:
    """Write one table cell; unknown is a dash."""
    if cell is None:
        return "–"
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    return f"{cell + 0.0:g}" if isinstance(cell, float) else str(cell)  # -0.0 is 0


def minus(text: str) -> str:
    """Write a minus as long as a plus is wide; keep together percent and number, and intervals."""
    text = re.sub(r"(?<![\w.])-(?=[\d.])", "−", text)
    return re.sub(r" %|\[\S+ \S+\]", lambda found: found[0].replace(" ", "\xa0"), text)
