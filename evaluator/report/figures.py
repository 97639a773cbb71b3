"""Figures as plain SVG that works inside a page and as a file, in light and dark."""

from collections.abc import Sequence
from html import escape

from evaluator.compare.rows import RateCell
from evaluator.compare.success import WITH
from evaluator.result import Interval, Measurement

STYLE = """<style>
.fig{--ink:#1d2430;--soft:#6b7280;--line:#d5d9e0;--sim:#0072b2;--rec:#c4520a;--paper:#fff}
@media (prefers-color-scheme:dark){.fig{--ink:#e6e9ef;--soft:#9aa3b2;--line:#394150;
--sim:#56b4e9;--rec:#f0934b;--paper:#161b22}}
.fig text{font:13px system-ui,sans-serif;fill:var(--ink)}
.fig .soft{fill:var(--soft)}.fig .small{font-size:12px}
.fig .line{stroke:var(--line);fill:none}.fig .axis{stroke:var(--soft);fill:none}
.fig .ident{stroke:var(--soft);stroke-dasharray:4 4;fill:none}
.fig .whisker{stroke:var(--ink);stroke-opacity:.75;stroke-width:1.3;fill:none}
.fig .sim{fill:var(--sim)}.fig .rec{fill:var(--rec)}.fig .bar{fill-opacity:.7}
.fig .with{fill:var(--sim);stroke:var(--sim)}
.fig .without{fill:var(--paper);stroke:var(--sim);stroke-width:2}
</style>"""

SIDE = 340.0
"""Side of the scatter's square [px]."""
LEFT, TOP = 64.0, 16.0


def scatter_svg(cells: Sequence[RateCell], word: str) -> str | None:
    """Draw sim against recorded success rates with both Wilson intervals and the identity line."""
    drawn = [c for c in cells if all(rate.value is not None for rate in c.pair)]
    if not drawn:
        return None
    groups = list(dict.fromkeys((cell.task, cell.policy) for cell in drawn))
    parts = [_frame(word)]
    taken: dict[tuple[float, float], int] = {}
    for cell in drawn:
        sim, recorded = cell.pair
        place = (sim.value or 0.0, recorded.value or 0.0)
        nudge = 9.0 * taken.get(place, 0)
        taken[place] = taken.get(place, 0) + 1
        parts.append(_point(cell, groups.index((cell.task, cell.policy)), nudge))
    legend_top = TOP + SIDE + 58
    conditions = any(cell.condition == WITH for cell in drawn)
    for index, (task, policy) in enumerate(groups):
        name = ", ".join(part.replace("_", " ") for part in (task, policy) if part)
        y = legend_top + 20 * index
        parts.append(_marker(LEFT + 8, y - 4, index, "without"))
        parts.append(f'<text class="small" x="{LEFT + 22}" y="{y}">{escape(name)}</text>')
    height = legend_top + 20 * len(groups)
    if conditions:
        words = "hollow: without replanning, solid: with replanning"
        parts.append(f'<text class="soft small" x="{LEFT}" y="{height + 2}">{words}</text>')
        height += 16
    title = f"Success rate in the twin against {word} success rate, one mark per cell"
    return _svg(LEFT + SIDE + 24, height, title, parts)


def _frame(word: str) -> str:
    parts = []
    for step in range(0, 101, 20):
        x, y = _x(step / 100), _y(step / 100)
        parts.append(
            f'<path class="line" d="M{x:g} {_y(0.0):g}V{_y(1.0):g}M{_x(0.0):g} {y:g}H{_x(1.0):g}"/>'
        )
        parts.append(
            f'<text class="soft small" x="{x:g}" y="{_y(0.0) + 18:g}" text-anchor="middle">'
            f'{step}</text><text class="soft small" x="{_x(0.0) - 8:g}" y="{y + 4:g}" '
            f'text-anchor="end">{step}</text>'
        )
    parts.append(f'<path class="ident" d="M{_x(0.0)} {_y(0.0)}L{_x(1.0)} {_y(1.0)}"/>')
    parts.append(f'<path class="axis" d="M{_x(0.0)} {_y(1.0)}V{_y(0.0)}H{_x(1.0)}"/>')
    middle = TOP + SIDE / 2
    parts.append(
        f'<text x="{LEFT + SIDE / 2}" y="{TOP + SIDE + 38}" text-anchor="middle">'
        "sim success rate (%)</text>"
        f'<text transform="translate(18 {middle}) rotate(-90)" text-anchor="middle">'
        f"{escape(word)} success rate (%)</text>"
    )
    return "".join(parts)


def _point(cell: RateCell, group: int, nudge: float) -> str:
    sim, recorded = cell.pair
    x, y = _x(sim.value or 0.0) - nudge, _y(recorded.value or 0.0) + nudge
    whiskers = ""
    if sim.interval is not None:
        low, high = _x(sim.interval.low), _x(sim.interval.high)
        whiskers += f"M{low:.1f} {y:.1f}H{high:.1f}"
    if recorded.interval is not None:
        low, high = _y(recorded.interval.low), _y(recorded.interval.high)
        whiskers += f"M{x:.1f} {low:.1f}V{high:.1f}"
    tip = f"{cell.label}: sim {_percent(sim)}, recorded {_percent(recorded)}"
    return (
        f'<g><title>{escape(tip)}</title><path class="whisker" d="{whiskers}"/>'
        f"{_marker(x, y, group, 'with' if cell.condition == WITH else 'without')}</g>"
    )


def _marker(x: float, y: float, group: int, style: str) -> str:
    shapes = (
        f'<circle class="{style}" cx="{x:.1f}" cy="{y:.1f}" r="6"/>',
        f'<rect class="{style}" x="{x - 5.5:.1f}" y="{y - 5.5:.1f}" width="11" height="11"/>',
        f'<path class="{style}" d="M{x:.1f} {y - 7:.1f}l7 12h-14z"/>',
        f'<path class="{style}" d="M{x:.1f} {y - 7.5:.1f}l7.5 7.5l-7.5 7.5l-7.5 -7.5z"/>',
    )
    return shapes[group % len(shapes)]


def success_svg(cells: Sequence[RateCell], word: str) -> str | None:
    """Draw the success rate of every cell as two bars with Wilson whiskers."""
    if not cells:
        return None
    labels, bar, row = 250.0, 360.0, 54.0
    width = labels + bar + 130
    parts = []
    bottom = 34 + row * len(cells)
    for step in range(0, 101, 20):
        x = labels + bar * step / 100
        parts.append(f'<path class="line" d="M{x} 26V{bottom}"/>')
        parts.append(
            f'<text class="soft small" x="{x}" y="18" text-anchor="middle">{step}'
            f"{' %' if step == 100 else ''}</text>"
        )
    for index, cell in enumerate(cells):
        y = 34 + row * index
        condition = cell.condition.replace("_", " ")
        second = ", ".join(part for part in (condition, cell.policy) if part)
        parts.append(
            f'<text x="{labels - 12}" y="{y + 17}" text-anchor="end">'
            f"{escape(cell.task.replace('_', ' '))}</text>"
            f'<text class="soft small" x="{labels - 12}" y="{y + 34}" text-anchor="end">'
            f"{escape(second)}</text>"
        )
        for line, (side, style, name) in enumerate(
            ((cell.sim, "sim", "sim"), (cell.recorded, "rec", word))
        ):
            parts.append(_bar(side, style, name, labels, y + 4 + 20 * line, bar))
    title = f"Success rate in the twin (sim) and {word}, with 95 % Wilson intervals"
    return _svg(width, bottom + 8, title, parts)


def _bar(side: Measurement, style: str, name: str, left: float, top: float, full: float) -> str:
    if side.value is None:
        words = f"{name}: undefined, {side.reason_if_undefined}"
        return f'<text class="soft small" x="{left + 6}" y="{top + 13}">{escape(words)}</text>'
    parts = [
        f'<rect class="bar {style}" x="{left}" y="{top}" width="{full * side.value:.1f}" '
        f'height="17" rx="2"/>'
    ]
    if isinstance(side.interval, Interval):
        low, high = left + full * side.interval.low, left + full * side.interval.high
        middle = top + 8.5
        parts.append(
            f'<path class="whisker" d="M{low:.1f} {middle}H{high:.1f}'
            f'M{low:.1f} {middle - 4}v8M{high:.1f} {middle - 4}v8"/>'
        )
    parts.append(
        f'<text class="small" x="{left + full + 8}" y="{top + 13}">'
        f"{escape(name)} {escape(_percent(side))}</text>"
    )
    return "".join(parts)


def _percent(side: Measurement) -> str:
    if side.value is None:
        return "undefined"
    if side.k is None or side.n is None:
        return f"{100 * side.value:.0f} %"
    return f"{side.k}/{side.n}"


def _x(value: float) -> float:
    return LEFT + SIDE * value


def _y(value: float) -> float:
    return TOP + SIDE * (1 - value)


def _svg(width: float, height: float, title: str, parts: Sequence[str]) -> str:
    return (
        f'<svg class="fig" xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" '
        f'width="{width:g}" height="{height:g}" role="img"><title>{escape(title)}</title>'
        f"{STYLE}{''.join(parts)}</svg>"
    )
