"""How numbers are written for people: rounding happens here and nowhere earlier."""

from collections.abc import Sequence

from evaluator.result import Cell, Measurement, Results

HEADLINES: tuple[tuple[str, str], ...] = (
    ("agreement.sim_planned.rate", "Sim and outcome agree"),
    ("agreement.sim_planned.phi", "phi"),
    ("agreement.sim_planned.ppv", "Success when sim says success (PPV)"),
    ("agreement.sim_planned.npv", "Failure when sim says failure (NPV)"),
    ("agreement.verdict.ppv", "Success when the gate accepted (PPV)"),
    ("agreement.pearson_r", "Pearson r over cells"),
    ("agreement.pearson_r.without_replanning", "Pearson r without replanning"),
    ("agreement.pearson_r.with_replanning", "Pearson r with replanning"),
    ("agreement.bias_pp", "Bias of sim"),
    ("agreement.mmrv_recorded_gap", "MMRV (gap of recorded rates)"),
    ("gain.pp.recorded.average", "Replanning gain, mean of tasks"),
    ("gain.relative.recorded.average", "The same, relative"),
    ("paired.mcnemar_p_mid.recorded", "Replanning, paired starts (McNemar mid-p)"),
    ("tcp.planned.position_mean_m", "Tool: recorded to planned replay"),
    ("tcp.executed.position_mean_m", "Tool: recorded to executed replay"),
    ("views.all.psnr_db", "PSNR of held-out views, raw"),
    ("views.all.psnr_gain_db", "The same after a gain per image and channel"),
    ("views.all.psnr_pose_gain_db", "The same after pose and gain fitted per image"),
    ("views.all.ssim", "SSIM of held-out views"),
    ("views.all.depth_mean_abs_m", "Depth of held-out views, mean error"),
    ("views.all.lpips", "LPIPS of held-out views"),
)


def number(value: float, unit: str) -> str:
    """Write a value in the unit a reader thinks in."""
    if unit == "m":
        return f"{1000 * value:.2f} mm"
    if unit == "rad":
        return f"{value * 57.29577951308232:.2f}°"
    if unit == "dB":
        return f"{value:.2f} dB"
    if unit == "pp":
        return f"{value:+.1f} pp"
    return f"{value:.3f}"


def measurement_text(measurement: Measurement) -> str:
    """Write value, count and interval, or why there is none."""
    if measurement.value is None:
        return f"undefined: {measurement.reason_if_undefined}"
    if measurement.k is not None and measurement.n is not None:
        text = f"{measurement.k}/{measurement.n} = {100 * measurement.value:.1f} %"
    elif measurement.id.startswith("gain.relative."):
        text = f"{100 * measurement.value:+.1f} % relative"
    else:
        text = number(measurement.value, measurement.unit)
        if measurement.n is not None and measurement.counted:
            text += f" (n = {measurement.n} {measurement.counted}s)"
    return text + interval_text(measurement)


def interval_text(measurement: Measurement) -> str:
    """Write the interval with its level, method and least coverage at this n, or nothing."""
    interval = measurement.interval
    if interval is None:
        return ""
    if measurement.k is not None and measurement.unit == "1":
        ends = f"[{100 * interval.low:.1f}, {100 * interval.high:.1f}] %"
    else:
        ends = f"[{interval.low:.3g}, {interval.high:.3g}]"
    known = interval.worst_coverage
    worst = "" if known is None else f", worst case {100 * known:.1f} %"
    return f" {ends} ({100 * interval.level:.0f} % {interval.method}{worst})"


def headlines(results: Results) -> list[tuple[str, str, Measurement]]:
    """Return (label, text, measurement) of the numbers to read first, those that are there."""
    by_id = {measurement.id: measurement for measurement in results.measurements}
    found = [(label, by_id[name]) for name, label in HEADLINES if name in by_id]
    return [(label, measurement_text(m), m) for label, m in found]


def stand_in_sentence(results: Results) -> str | None:
    """Return the warning every page made from a simulated laboratory carries."""
    if not results.stand_in:
        return None
    return (
        "Stand-in: every recorded outcome here comes from a simulated laboratory, "
        "not from a real robot."
    )


def cell_text(cell: Cell) -> str:
    """Write one table cell; unknown is a dash."""
    if cell is None:
        return "–"
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    return f"{cell:g}" if isinstance(cell, float) else str(cell)


def texts(row: Sequence[Cell]) -> list[str]:
    """Write one table row."""
    return [cell_text(cell) for cell in row]
