"""Numbers and outcomes as words: what a page prints, and nothing it computes."""

from collections.abc import Mapping
from typing import Any

from bridge.task.verdict import Factor, Verdict
from evaluator.report import wording as report
from evaluator.result import Measurement
from twin.replay.deciding import goes_with_success

MISSING = "missing"
NARROW = "\u00a0"
"""A space that never breaks a line."""


def outcome_word(value: bool | None) -> str:
    """Name an outcome with a sign, so that colour is never needed."""
    return {True: "✓ success", False: "✗ failure", None: "? unknown"}[value]


def verdict_word(value: bool | None) -> str:
    """Name a verdict with a sign."""
    return {True: "✓ accepted", False: "✗ refused", None: "? undecided"}[value]


def factor_word(factor: Factor) -> str:
    """Name one factor of the acceptance indicator with a sign."""
    return {True: "✓ holds", False: "✗ fails", None: "? undecided"}[factor.value]


def event_words(event: Mapping[str, Any]) -> tuple[str, str]:
    """Say what happened, and to which stage and plan, with its note, outcome and data."""
    parts = [str(event[name]) for name in ("stage_id", "plan_id", "text") if event.get(name)]
    for name in ("outcome", "data"):
        if event.get(name):
            parts += [", ".join(f"{k} {v}" for k, v in event[name].items() if v not in ("", None))]
    return str(event["type"]).replace("_", " "), " · ".join(parts)


def verdict_text(verdict: Verdict) -> str:
    """Write a verdict as one line, with the first factor that fails and why."""
    text = f"{verdict_word(verdict.accepted)}: {verdict.plan_id}, {verdict.trajectory}"
    text += f", {verdict.mode}, {verdict.engine}"
    name = verdict.first_failing
    if name is not None:
        factor = verdict.factors()[name]
        why = factor.detail or factor.cause
        text += f"; {name} {factor_word(factor)}" + (f" ({why})" if why else "")
    elif verdict.accepted is None and verdict.reason:
        text += f"; {verdict.reason}"
    if verdict.p_success:
        text += "; ".join(["", success_share(verdict.p_success), *goes_with_success(verdict)])
    return text


def tone(value: bool | None) -> str:
    """Return the CSS class that goes with a yes, a no or a neither."""
    return {True: "good", False: "bad", None: "unknown"}[value]


def answer_tone(answer: str) -> str:
    """Return the CSS class of an answer on whether the twin can stand for the recordings."""
    return {"yes": "good", "not for this": "bad"}.get(answer, "unknown")


def length_text(length_m: float | None) -> str:
    """Print a length [m] in millimetres, or that it is missing."""
    return MISSING if length_m is None else unbroken(report.number(length_m, "m"))


def unbroken(text: str) -> str:
    """Keep a number with its unit and its sign."""
    return report.minus(text).replace(" ", NARROW)


def measured(measurement: Measurement) -> str:
    """Print a value as the report does, or that it is undefined."""
    return unbroken(report.value_text(measurement))


def evidence(measurement: Measurement) -> str:
    """Print what a value rests on: its count, its interval, or why there is none."""
    if measurement.value is None:
        return measurement.reason_if_undefined or ""
    parts = [report.count_text(measurement)]
    if measurement.interval is not None:
        lies = "without the noise of counting " if measurement.is_beyond else ""
        ends, how = report.ends_text(measurement), report.method_text(measurement)
        parts.append(f"{lies}{report.minus(ends)} ({how})")
    elif measurement.reason_without_interval:
        parts.append(f"no interval: {measurement.reason_without_interval}")
    return ", ".join(filter(None, parts))


def success_share(p_success: Mapping[str, float]) -> str:
    """Print how many varied replays succeeded, and how probable success is by that."""
    low, high = (round(100 * p_success[name]) for name in ("low", "high"))
    counts = f"{p_success['k']:g} of {p_success['n']:g} varied replays succeed"
    return f"{counts}: {100 * p_success['value']:.0f}{NARROW}%, {low} to {high}{NARROW}%"


def size_text(num_bytes: int) -> str:
    """Print a file size."""
    size = float(num_bytes)
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.2f} GB"


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
