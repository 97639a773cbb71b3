"""Numbers and outcomes as words: what a page prints, and nothing it computes."""

import re
from collections.abc import Mapping

from markupsafe import Markup, escape

from bridge.task.verdict import Factor
from evaluator.quantity import noun
from evaluator.result import Interval, Measurement

MISSING = "missing"


def outcome_word(value: bool | None) -> str:
    """Name an outcome with a sign, so that colour is never needed."""
    return {True: "✓ success", False: "✗ failure", None: "? unknown"}[value]


def verdict_word(value: bool | None) -> str:
    """Name a verdict with a sign."""
    return {True: "✓ accepted", False: "✗ refused", None: "? undecided"}[value]


def factor_word(factor: Factor) -> str:
    """Name one factor of the acceptance indicator with a sign."""
    return {True: "✓ holds", False: "✗ fails", None: "? undecided"}[factor.value]


def tone(value: bool | None) -> str:
    """Return the CSS class that goes with a yes, a no or a neither."""
    return {True: "good", False: "bad", None: "unknown"}[value]


def answer_tone(answer: str) -> str:
    """Return the CSS class of an answer on whether the twin can stand for the recordings."""
    return {"yes": "good", "not for this": "bad"}.get(answer, "unknown")


SHORT = 24
"""Characters of a name that fits any column."""


def breakable(text: str) -> Markup:
    """Let a long name break behind its joints, so that it never widens a page."""
    if len(text) <= SHORT:
        return escape(text)
    return Markup("<wbr>").join(re.split(r"(?<=[_./-])(?=\w)", text))


NARROW = "\u00a0"
"""A space that never breaks a line: a number stays with its unit."""
FORMS = {
    "fraction": ("{:.0f}", 100, "%"),
    "pp": ("{:+.0f}", 1, "pp"),
    "m": ("{:.1f}", 1000, "mm"),
    "rad": ("{:.4f}", 1, "rad"),
    "dB": ("{:.2f}", 1, "dB"),
    "count": ("{:.0f}", 1, ""),
    "1": ("{:.3f}", 1, ""),
}
"""How a unit is printed: format, factor to the printed unit, printed unit."""


def number(value: float, unit: str) -> str:
    """Print a value in its unit: fractions as percent, lengths in millimetres.

    Args:
        unit: Unit of the measurement: one of ``FORMS``, or another, which is printed as it is.
    """
    figure, shown = _figure(value, unit)
    return f"{figure}{NARROW}{shown}" if shown else figure


def _figure(value: float, unit: str) -> tuple[str, str]:
    form, factor, shown = FORMS.get(unit, ("{:.3g}", 1, unit))
    text = form.format(factor * value)
    if value != 0 and float(text) == 0:
        text = f"{factor * value:.1g}"  # small is not nothing
    return text.replace("-", "−"), shown


def length_text(length_m: float | None) -> str:
    """Print a length [m] in millimetres, or that it is missing."""
    return MISSING if length_m is None else number(length_m, "m")


SHARES = ("rate.", "rate_common.")
"""Rates that are means of shares have no count of their own."""


def shown_unit(measurement: Measurement) -> str:
    """Return the unit to print in: a k/n of unit 1 is a fraction."""
    if measurement.unit == "1" and (measurement.k is not None or measurement.id.startswith(SHARES)):
        return "fraction"
    return measurement.unit


def measured(measurement: Measurement | None) -> str:
    """Print a value, or that it is missing or undefined."""
    if measurement is None:
        return MISSING
    if measurement.value is None:
        return "undefined"
    return number(measurement.value, shown_unit(measurement))


def headline(measurement: Measurement) -> str:
    """Print a value in large: counts as k of n, because a percentage hides how few there are."""
    if measurement.value is not None and measurement.k is not None and measurement.n is not None:
        return f"{measurement.k} of {measurement.n}"
    return measured(measurement)


def bounds(interval: Interval | None, unit: str) -> str:
    """Print the two ends of an interval.

    Args:
        interval: The interval; None prints nothing.
    """
    if interval is None:
        return ""
    (low, shown), (high, _) = _figure(interval.low, unit), _figure(interval.high, unit)
    return NARROW.join(filter(None, (low, "to", high, shown)))


def method(interval: Interval) -> str:
    """Name an interval's level and method, Wilson and Newcombe with their capital."""
    return f"{100 * interval.level:.0f} % {interval.method[:1].upper()}{interval.method[1:]}"


def counted(measurement: Measurement) -> str:
    """Print what a value was counted over: "3 trials", "4 pairs of runs"."""
    if measurement.n is None:
        return ""
    return f"{measurement.n} {noun(measurement.counted or 'item', measurement.n)}"


def evidence(measurement: Measurement | None) -> str:
    """Print what a value rests on: its count, its interval, or why there is none."""
    if measurement is None:
        return ""
    if measurement.value is None:
        return measurement.reason_if_undefined or ""
    parts = []
    if measurement.k is not None and measurement.n is not None:
        parts.append(f"{measurement.k} of {counted(measurement)}")
    elif measurement.n is not None:
        parts.append(f"n = {counted(measurement)}")
    if measurement.interval is not None:
        ends = bounds(measurement.interval, shown_unit(measurement))
        lies = "without the noise of counting " if measurement.is_beyond else ""
        parts.append(f"{lies}{ends} ({method(measurement.interval)})")
    elif measurement.reason_without_interval:
        parts.append(f"no interval: {measurement.reason_without_interval}")
    return ", ".join(parts)


def headline_evidence(measurement: Measurement) -> str:
    """Print what stands below a large number: for k of n, the rate and its interval."""
    if measurement.value is None or measurement.k is None or measurement.interval is None:
        return evidence(measurement)
    interval = measurement.interval
    ends = bounds(interval, shown_unit(measurement))
    kind = noun(measurement.counted or "item", 0)
    return f"{measured(measurement)} of {kind}, {ends} ({method(interval)})"


def short_evidence(measurement: Measurement | None) -> str:
    """Print count and interval for a narrow column; the method stands elsewhere."""
    if measurement is None or measurement.value is None:
        return evidence(measurement)
    parts = []
    if measurement.k is not None and measurement.n is not None:
        parts.append(f"{measurement.k}/{measurement.n}")
    elif measurement.n is not None:
        parts.append(f"n = {counted(measurement)}")
    if measurement.interval is not None:
        parts.append(bounds(measurement.interval, shown_unit(measurement)))
    return ", ".join(parts)


def success_share(p_success: Mapping[str, float]) -> str:
    """Print how many varied replays succeeded, and the interval of that share."""
    low, high = (round(100 * p_success[name]) for name in ("low", "high"))
    counts = f"{p_success['k']:g} of {p_success['n']:g} varied replays succeed"
    return f"{counts}, {low} to {high}{NARROW}%"


def size_text(num_bytes: int) -> str:
    """Print a file size."""
    size = float(num_bytes)
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.2f} GB"


def percent(tick: str) -> str:
    """Print the label of a tick between 0 and 1 as percent."""
    return f"{100 * float(tick):.0f}"


def condition_word(condition: str) -> str:
    """Print a condition: ``with_replanning`` as "with replanning"."""
    return condition.replace("_", " ") or "no condition"


def image_title(measurement: Measurement) -> str:
    """Name an image number ``views.<part>.<metric>`` as its metric and part."""
    _, part, metric = [*measurement.id.split(".", 2), "", ""][:3]
    metric = metric.removesuffix("_db").removesuffix("_m")
    word, _, how = metric.replace("_", " ").partition(" ")
    first = word.capitalize() if word == "depth" else word.upper()
    name = " ".join(filter(None, (first, how))) or measurement.id
    return name if part == "all" else f"{name}, {part}"
