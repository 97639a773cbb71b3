"""``--fail-under``: what must be reached for an evaluation to count as passed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from bridge.errors import UsageError
from evaluator.result import Results

SHORT = {
    "agreement": "agreement.sim_planned.rate",
    "phi": "agreement.sim_planned.phi",
    "ppv": "agreement.sim_planned.ppv",
    "npv": "agreement.sim_planned.npv",
    "r": "agreement.pearson_r",
    "rho": "agreement.spearman_rho",
    "psnr": "views.all.psnr_db",
    "ssim": "views.all.ssim",
}
"""Names that are quicker to write than ids. All are better when higher."""


@dataclass(frozen=True, kw_only=True)
class Threshold:
    """One number that must be reached."""

    name: str
    """As the user wrote it."""
    id: str
    limit: float


def parse_thresholds(text: str | float) -> list[Threshold]:
    """Read ``0.8``, ``r=0.8`` or ``r=0.8,ppv=0.9``; a bare number is the agreement of trials."""
    return [_parse(part.strip()) for part in str(text).split(",")]


def _parse(part: str) -> Threshold:
    name, equals, number = part.rpartition("=")
    name = name.strip() if equals else "agreement"
    try:
        limit = float(number)
    except ValueError as error:
        message = f"--fail-under {part!r} is not a number; write 0.8, r=0.8 or ID=0.8."
        raise UsageError(message) from error
    wrong = ""
    if not math.isfinite(limit):
        wrong = f"{part!r} is no limit that anything can reach or miss"
    elif name == "agreement" and not 0 <= limit <= 1:
        wrong = f"{limit} is not a fraction from 0 to 1, for example 0.8"
    elif "." not in name and name not in SHORT:
        wrong = f"knows no {name!r}; there are: {', '.join(SHORT)}, and every id"
    elif name in SHORT and name != "psnr" and abs(limit) > 1:
        wrong = f"{part!r} can never be reached: {name} is at most 1"
    if wrong:
        raise UsageError(f"--fail-under {wrong}.")
    return Threshold(name=name, id=SHORT.get(name, name), limit=limit)


def missed(thresholds: Sequence[Threshold], results: Results) -> list[str]:
    """Say what was not reached; an undefined number reaches nothing."""
    by_id = {measurement.id: measurement for measurement in results.measurements}
    found = []
    for threshold in thresholds:
        measurement = by_id.get(threshold.id)
        if measurement is None:
            shown = f"undefined: there is no {threshold.id} in these results"
        elif measurement.value is None:
            shown = f"undefined: {measurement.reason_if_undefined}"
        elif measurement.value >= threshold.limit:
            continue
        else:
            shown = f"{measurement.value:.4g}"
        name = "Agreement of twin and outcome" if threshold.name == "agreement" else threshold.name
        found.append(f"{name} is {shown}; the threshold is {threshold.limit:g}.")
    return found
