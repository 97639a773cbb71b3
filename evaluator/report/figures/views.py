"""Image metrics of all views as distributions, and the worst views as pictures."""

from collections.abc import Sequence

from evaluator.compare.drawn import Shares, shares_of
from evaluator.compare.view_quality import ViewQuality
from evaluator.report.figures.spreads import Panel, Subject
from evaluator.report.pairs import ViewPair

METRICS = (
    ("psnr_db", "PSNR (dB), higher is better"),
    ("ssim", "SSIM, higher is better"),
    ("lpips", "LPIPS, lower is better"),
)
"""First part of a metric's name, and the label of its axis."""
WORST_BY = "psnr_db"

SUBJECT = Subject(
    id="views",
    title="Image metrics over all views",
    caption="Raw values over the full frame; gain: after one fitted gain per image and channel. "
    "Their protocols stand with each number.",
    reason="no rendered view has a recorded image",
)


def view_panels(views: Sequence[ViewQuality]) -> tuple[Subject, list[Panel]]:
    """Return one panel for each metric that any view has, a line for each method."""
    methods = list(dict.fromkeys(view.method for view in views))
    known = sorted({name for view in views for name in view.values})
    panels = []
    for start, label in METRICS:
        name = start if start in known else next((n for n in known if n.startswith(start)), None)
        if name is None:
            continue
        lines = [(method, method, name) for method in methods]
        if len(methods) == 1:
            lines += [
                (f"{methods[0]}, {variant}", methods[0], other)
                for variant, other in (("gain", _gain_of(name)),)
                if other in known
            ]
        shown = label if name == start else f"{label} ({name})"
        groups = [_shares(views, *line) for line in lines]
        panels.append(Panel(label=shown, groups=tuple(g for g in groups if g is not None)))
    return SUBJECT, panels


def _gain_of(name: str) -> str:
    return f"{name.removesuffix('_db')}_gain{'_db' if name.endswith('_db') else ''}"


def _shares(views: Sequence[ViewQuality], label: str, method: str, name: str) -> Shares | None:
    values = [v.values[name] for v in views if v.method == method and name in v.values]
    return shares_of(label, values)


def worst_pairs(views: Sequence[ViewQuality]) -> list[ViewPair]:
    """Return the views that hold pictures, worst first."""
    found = []
    for view in views:
        if view.recorded_u8 is None or view.rendered_u8 is None:
            continue
        score = view.values.get(WORST_BY)
        text = "no PSNR" if score is None else f"PSNR {score:.2f} dB"
        name = " · ".join(part for part in (view.method, view.episode, view.view_id) if part)
        pair = ViewPair(
            name=name, score=text, recorded_u8=view.recorded_u8, rendered_u8=view.rendered_u8
        )
        found.append((score if score is not None else float("inf"), pair))
    return [pair for _, pair in sorted(found, key=lambda item: item[0])]
