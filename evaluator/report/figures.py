"""The two figures of a report, written as SVG: rates beside each other, and sim against recorded.

Text stays text, and the same numbers give the same bytes. A file has the colours of print; a page
gives the names of colours its own values.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

from bridge.media import palette
from evaluator.compare.rows import Comparison, RateGroup
from evaluator.compare.success import WITH
from evaluator.report.views import shown_word
from evaluator.result import Measurement

NAMES = {"soft": "quiet", "line": "edge", "sim": "twin-planned"}
NAMES |= {"executed": "twin-executed", "rec": "recorded"}
"""Short names of colours, and what they mean in the palette."""
LIGHT = {**palette.LIGHT, **{name: palette.LIGHT[meaning] for name, meaning in NAMES.items()}}
"""Colours of the files."""
DARK = {**palette.DARK, **{name: palette.DARK[meaning] for name, meaning in NAMES.items()}}
"""The same names on a dark page."""
WIDTH = 440
HIGH = 0.94
"""Rates so near the edge that what belongs to a mark stands inside of it."""
MOST = 40
"""Groups drawn; a longer figure would not fit a page."""
NAMED = 6
"""Groups that the words for those who cannot see it name one by one."""

BOTH_KNOWN = ", over the trials where both sides are known; bars are 95 % intervals of both rates"
Px = float | int


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """One figure."""

    id: str
    """File name without its ending."""
    title: str
    caption: str
    """What the marks mean and what the figure does not say."""
    alt: str
    """What it shows, for someone who cannot see it."""
    height: int
    marks: tuple[str, ...]
    """SVG elements; a colour is the name of one in braces."""

    @property
    def svg(self) -> str:
        """A file of its own, in the colours of print."""
        style = '<style>text{font:12px "DejaVu Sans",Arial,sans-serif}</style>'
        return self._written('xmlns="http://www.w3.org/2000/svg"', style, LIGHT)

    @property
    def inline(self) -> str:
        """For a page that defines the colours; its ids start with the figure's."""
        attributes = f'role="img" aria-labelledby="{self.id}-title {self.id}-alt"'
        style = '<g font-size="12" font-family="var(--figure-font)">'
        meant = {name: f"var(--{NAMES.get(name, name)})" for name in LIGHT}
        return self._written(attributes, style, meant)

    def _written(self, attributes: str, style: str, colours: dict[str, str]) -> str:
        body = "\n".join(self.marks)
        for name, colour in colours.items():
            body = body.replace(f"{{{name}}}", colour)
        end = "</g>" if style.startswith("<g") else ""
        return (
            f'<svg class="fig" {attributes} viewBox="0 0 {WIDTH} {self.height}" width="{WIDTH}" '
            f'height="{self.height}"><title id="{self.id}-title">{escape(self.title)}</title>'
            f'<desc id="{self.id}-alt">{escape(self.alt)}</desc>{style}{body}{end}</svg>'
        )


def drawings_of(comparison: Comparison) -> list[Drawing]:
    """Return the figures that have data, in the order of the report."""
    groups, word = comparison.groups, shown_word(comparison.recorded_word)
    return [each for each in (success(groups, word), scatter(groups, word)) if each is not None]


def success(groups: Sequence[RateGroup], word: str) -> Drawing | None:
    """Draw both rates of every group, one group below the other, with their intervals."""
    known = [g for g in groups if g.shown_sim.value is not None or g.recorded.value is not None]
    if not known:
        return None
    shown = known[:MOST]
    has_twin = any(group.shown_sim.value is not None for group in known)
    step = 52 if has_twin else 38
    bottom = 40 + step * len(shown)
    marks = [*_axis(12, 340, bottom, 30)]
    if has_twin:
        marks += ('<circle cx="17" cy="16" r="5" fill="{sim}"/>', _text(28, 20, "twin", "ink"))
        marks.append('<rect x="78" y="11" width="10" height="10" fill="{rec}"/>')
        marks.append(_text(94, 20, word, "ink"))
    for index, group in enumerate(shown):
        y = 50 + step * index
        marks.append(_text(12, y, group.label, "ink"))
        marks += _rate(group.shown_sim, y + 14, "sim") if has_twin else ()
        marks += _rate(group.recorded, y + step - 22, "rec")
    more = len(known) - len(shown)
    rest = f" The first {MOST} of {len(known)} groups; the table has all." if more else ""
    side = "planned" if any(group.executed is None for group in known) else "executed"
    return Drawing(
        id="success",
        title=f"Success rates in the twin and {word}" if has_twin else f"Success rates, {word}",
        caption=f"{f'Circle: {side}-in-twin; square: {word}. ' if has_twin else ''}Bars "
        f"are 95 % intervals; the counts stand at the right.{rest}",
        alt=_alt("Rates", word, [(g.label, g.shown_sim, g.recorded) for g in known]),
        height=bottom + 42,
        marks=tuple(marks),
    )


def scatter(groups: Sequence[RateGroup], word: str) -> Drawing | None:
    """Draw sim against recorded rates with both intervals and the identity line."""
    drawn = [group for group in groups if all(rate.value is not None for rate in group.pair)]
    if not drawn:
        return None
    left, top, side = 56, 12, 340
    marks = [
        *_axis(left, side, top + side, top, "success rate in the twin (%)"),
        *(
            _text(left - 6, top + side * (1 - s / 4) + 4, f"{25 * s}", "soft", "end")
            for s in range(5)
        ),
        f'<text transform="translate(14 {top + side // 2}) rotate(-90)" text-anchor="middle" '
        f'fill="{{ink}}">{escape(word)} success rate (%)</text>',
        f'<line x1="{left}" y1="{top + side}" x2="{left + side}" y2="{top}" stroke="{{soft}}" '
        'stroke-dasharray="4 3"/>',
    ]
    places = [tuple(rate.value or 0.0 for rate in group.pair) for group in drawn]
    # What is solid comes last, smaller: where both coincide a dot stands in a ring.
    for group, at in sorted(
        zip(drawn, places, strict=True), key=lambda it: it[0].condition == WITH
    ):
        sim, real = group.pair
        x, y = left + side * at[0], top + side * (1 - at[1])
        if sim.interval is not None:
            ends = [left + side * end for end in (sim.interval.low, sim.interval.high)]
            marks.append(_line(ends[0], y, ends[1], y))
        if real.interval is not None:
            ends = [top + side * (1 - end) for end in (real.interval.low, real.interval.high)]
            marks.append(_line(x, ends[0], x, ends[1]))
        fill, size = ("{sim}", 3) if group.condition == WITH else ("{paper}", 5)
        marks.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{size}" fill="{fill}" stroke="{{sim}}" '
            f'stroke-width="2"><title>{escape(group.label)}</title></circle>'
        )
    for at, together in Counter(places).items():
        if together > 1:
            x, y = left + side * at[0], top + side * (1 - at[1]) + (20 if at[1] > HIGH else -8)
            aside, anchor = (-8, "end") if at[0] > HIGH else (8, "start")
            marks.append(_text(x + aside, y, f"\u00d7{together}", "ink", anchor))
    with_too = any(group.condition == WITH for group in drawn)
    filled = " Ring: without replanning; dot: with." if with_too else ""
    each = [n for n in ("task", "condition", "policy") if any(getattr(g, n) for g in drawn)]
    bars = any(rate.interval for group in drawn for rate in group.pair)
    drawn_as = f"One mark per group ({', '.join(each)}){BOTH_KNOWN if bars else ''}. Below the"
    alike = " \u00d72: two at one place." if len({*places}) < len(places) else ""
    return Drawing(
        id="scatter",
        title=f"Success in the twin against {word} success",
        caption=f"{drawn_as} dashed line the twin is optimistic, above it pessimistic.{alike}"
        f"{filled}",
        alt=_alt("Scatter", word, [(group.label, *group.pair) for group in drawn]),
        height=top + side + 48,
        marks=tuple(marks),
    )


def _axis(left: int, side: int, y: int, top: int, name: str = "success rate (%)") -> Iterable[str]:
    for step in range(5):
        x = left + side * step / 4
        yield _line(x, top, x, y, "line", 1)
        yield _text(x, y + 16, f"{25 * step}", "soft", "middle")
    yield _text(left + side / 2, y + 34, name, "ink", "middle")


def _rate(rate: Measurement, y: Px, name: str) -> Iterable[str]:
    if rate.value is None:
        yield _text(12, y + 4, "undefined", "soft")
        return
    x = 12 + 340 * rate.value
    if rate.interval is not None:
        yield _line(12 + 340 * rate.interval.low, y, 12 + 340 * rate.interval.high, y, name, 2.5)
    if name == "sim":
        yield f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="{{sim}}"/>'
    else:
        yield f'<rect x="{x - 5:.1f}" y="{y - 5:.1f}" width="10" height="10" fill="{{rec}}"/>'
    yield _text(366, y + 4, _counted(rate), "ink")


def _line(x1: Px, y1: Px, x2: Px, y2: Px, name: str = "soft", width: Px = 1.2) -> str:
    return (
        f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{{{name}}}" '
        f'stroke-width="{width}"/>'
    )


def _text(x: Px, y: Px, text: str, name: str, anchor: str = "start") -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{{{name}}}">'
        f"{escape(text)}</text>"
    )


def _counted(rate: Measurement) -> str:
    if rate.value is None:
        return "undefined"
    return f"{100 * rate.value:.0f} %" if rate.k is None or not rate.n else f"{rate.k}/{rate.n}"


def _alt(kind: str, word: str, pairs: Sequence[tuple[str, Measurement, Measurement]]) -> str:
    named = [f"{label}: twin {_counted(a)}, {word} {_counted(b)}" for label, a, b in pairs[:NAMED]]
    more = f"; and {len(pairs) - NAMED} more" if len(pairs) > NAMED else ""
    return (
        f"{kind} of {len(pairs)} group{'' if len(pairs) == 1 else 's'}: {'; '.join(named)}{more}."
    )
