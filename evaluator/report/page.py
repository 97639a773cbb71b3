"""``report.html``: one file, no outside requests, readable without JavaScript, light and dark."""

import json
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from importlib import resources
from typing import Any

from evaluator.report.figures.drawing import DARK, LIGHT, Drawing
from evaluator.report.html import figure_html, minus, numbers_html, table_html
from evaluator.report.pairs import ViewPair, pairs_html
from evaluator.report.sections import OTHER, SECTIONS, TRIALS, Section, numbers_of, section_of
from evaluator.report.wording import (
    count_text,
    ends_text,
    measurement_text,
    method_text,
    stand_in_sentence,
    value_text,
)
from evaluator.result import Measurement, Results, Table

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""The page forbids itself to load anything."""
SOURCES = {
    "run": "a run folder",
    "trials": "a table of trials",
    "rates": "a table of rates",
    "images": "folders of images",
}
CARDS = (
    ("agreement.sim_planned.rate", "Sim and outcome agree"),
    ("agreement.verdict.ppv", "Succeeds when the gate accepts"),
    ("agreement.pearson_r", "Pearson r over groups"),
    ("agreement.bias_pp", "Bias of sim"),
    ("gain.pp.recorded.average", "Gain with replanning"),
    ("motion.planned.position_mean_m", "Tool, recorded to planned"),
    ("views.all.psnr_db", "PSNR of held-out views"),
)
DRAWN = {
    "confusion": "confusion",
    "gate_costs": "costs",
    "reliability": "reliability",
    "funnel": "funnel",
}
"""Tables that say what a figure of the page shows; they are folded beside it."""
SHOWN_EXCLUSIONS = 200
SHOWN_MEASUREMENTS = 1500
SHOWN_ENTRIES = 12
"""Of a long part of the provenance."""

Shown = tuple[Drawing, str | None]
"""A figure, and its SVG for the page; None where nothing could draw it."""


def page(results: Results, figures: Sequence[Shown] = (), pairs: Sequence[ViewPair] = ()) -> str:
    """Build the page of the results, the figures made of them, and pictures of the worst views."""
    counted = _Counted()
    parts = [
        (section, text)
        for section in (*SECTIONS, OTHER)
        if (text := _section(section, results, figures, pairs, counted))
    ]
    trials = next((table for table in results.tables if table.id == TRIALS), None)
    names = [(section.id, section.title) for section, _ in parts]
    names += [("trials-part", "Every trial")] if trials else []
    names += [("left-out", "Left out, and missing"), ("numbers", "Every number")]
    names += [("provenance", "Where it came from")]
    banner = stand_in_sentence(results)
    body = [
        '<a class="skip" href="#main">Skip to the results</a>',
        f'<nav aria-label="Contents"><p>Contents</p><ol>{_contents(names)}</ol></nav>',
        '<main id="main" tabindex="-1">',
        _head(results, banner),
        *(text for _, text in parts),
        _trials(trials, counted) if trials else "",
        _left_out(results, counted),
        _measurements(results.measurements),
        _provenance(results),
        "</main>",
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{escape(results.run)}: how far to trust the twin</title><style>{_style()}</style>"
        f"</head><body>{''.join(body)}</body></html>\n"
    )


class _Counted:
    """Numbers tables and figures in the order in which they appear."""

    def __init__(self) -> None:
        self.tables = 0
        self.figures = 0

    def table(self) -> int:
        self.tables += 1
        return self.tables

    def figure(self) -> int:
        self.figures += 1
        return self.figures


def _style() -> str:
    """The style sheet with the palette of the figures, so that page and figures agree."""
    light = "".join(f"--{name}:{value};" for name, value in LIGHT.items())
    dark = "".join(f"--{name}:{value};" for name, value in DARK.items())
    text = resources.files("evaluator.report").joinpath("page.css").read_text()
    return (
        f":root{{{light}}}@media (prefers-color-scheme:dark){{:root{{{dark}}}}}"
        f"@media print{{:root{{{light}}}}}{text}"
    )


def _contents(names: Sequence[tuple[str, str]]) -> str:
    return "".join(f'<li><a href="#{name}">{escape(title)}</a></li>' for name, title in names)


def _head(results: Results, banner: str | None) -> str:
    source = SOURCES.get(results.source, results.source)
    warning = f'<p class="banner" role="note">{escape(banner)}</p>' if banner else ""
    return (
        f'<header><p class="kicker">How far to trust the twin</p><h1>{escape(results.run)}</h1>'
        f'<p class="soft">Made by robot-gst evaluate from {escape(source)}. Every number has its '
        "count, its interval or the reason why there is none, and its definition; sim is "
        f"planned-in-twin throughout.</p>{warning}{_cards(results)}</header>"
    )


def _cards(results: Results) -> str:
    by_id = {measurement.id: measurement for measurement in results.measurements}
    cards = [(label, by_id[name]) for name, label in CARDS if name in by_id][:6]
    if not cards and results.measurements:
        return ""
    if not cards:
        return "<p>Nothing could be measured; what is missing is listed below.</p>"
    return f'<dl class="cards">{"".join(_card(label, m) for label, m in cards)}</dl>'


def _card(label: str, measurement: Measurement) -> str:
    if measurement.value is None:
        why = escape(measurement.reason_if_undefined or "")
        inner = f'<dd class="value soft">undefined</dd><dd class="detail">{why}</dd>'
    else:
        ends = ends_text(measurement)
        below = [f"{minus(escape(ends))}" if ends else "no interval", count_text(measurement)]
        inner = (
            f'<dd class="value">{minus(escape(value_text(measurement)))}</dd>'
            f'<dd class="detail">{below[0]} <span class="soft">{escape(below[1])}</span></dd>'
        )
        if method := method_text(measurement):
            inner += f'<dd class="detail soft">{escape(method)}</dd>'
    return f"<div><dt>{escape(label)}</dt>{inner}</div>"


def _section(
    section: Section,
    results: Results,
    figures: Sequence[Shown],
    pairs: Sequence[ViewPair],
    counted: _Counted,
) -> str:
    """Write one part, or nothing when the run has nothing for it."""
    tables = [
        table for table in results.tables if table.id != TRIALS and section_of(table.id) is section
    ]
    drawn = [(drawing, svg) for drawing, svg in figures if drawing.id in section.figures]
    numbers = numbers_of(section, results.measurements)
    if not tables and not drawn and not any(m.value is not None for _, m in numbers):
        return ""
    shown = "".join(figure_html(drawing, svg, counted.figure()) for drawing, svg in drawn)
    worst = pairs_html(pairs, counted.figures + 1) if section.id == "views" else ""
    if worst:
        counted.figure()
    lead = f'<p class="lead">{escape(section.lead)}</p>' if section.lead else ""
    ids = {drawing.id for drawing, svg in drawn if svg is not None}
    listed = "".join(
        table_html(
            table,
            counted.table(),
            whole=f"tables/{table.id}.csv",
            folded=True if DRAWN.get(table.id) in ids else None,
        )
        for table in tables
    )
    return (
        f'<section aria-labelledby="{section.id}"><h2 id="{section.id}">{escape(section.title)}'
        f"</h2>{lead}"
        f"{numbers_html(numbers, f'Numbers: {section.title}')}"
        f"{_figures(shown, len(drawn))}{worst}{listed}</section>"
    )


def _figures(shown: str, count: int) -> str:
    """Put figures side by side; one alone has its caption beside it."""
    kind = "figures one" if count == 1 else "figures"
    return f'<div class="{kind}">{shown}</div>' if shown else ""


def _trials(table: Table, counted: _Counted) -> str:
    text = table_html(table, counted.table(), whole="trials.csv, trials.parquet and tables/")
    return (
        '<section aria-labelledby="trials-part"><h2 id="trials-part">Every trial</h2>'
        f"{text}</section>"
    )


def _left_out(results: Results, counted: _Counted) -> str:
    head = '<section aria-labelledby="left-out"><h2 id="left-out">Left out, and missing</h2>'
    if not results.exclusions and not results.missing:
        return f"{head}<p>Nothing was left out.</p></section>"
    missing = "".join(f"<li>{escape(text)}</li>" for text in results.missing)
    listed = f"<ul>{missing}</ul>" if missing else ""
    table = ""
    if results.exclusions:
        rows = tuple((item.episode, item.scope, item.reason) for item in results.exclusions)
        columns = ("episode", "left out of", "reason")
        left = Table(id="exclusions", title="What was left out", columns=columns, rows=rows)
        table = table_html(left, counted.table(), whole="results.json", shown_rows=SHOWN_EXCLUSIONS)
    return f"{head}{listed}{table}</section>"


def _measurements(measurements: Sequence[Measurement]) -> str:
    shown = measurements[:SHOWN_MEASUREMENTS]
    rows = "".join(
        f'<tr><th scope="row"><code>{escape(m.id)}</code></th><td>'
        f"{minus(escape(measurement_text(m)))}{escape(_no_interval(m))}</td>"
        f"<td>{escape(m.definition)}</td></tr>"
        for m in shown
    )
    cut = ""
    if len(measurements) > len(shown):
        cut = (
            f'<p class="note">The first {len(shown):,} of {len(measurements):,} numbers; all are '
            "in results.json and measurements.parquet.</p>"
        )
    return (
        '<section aria-labelledby="numbers"><h2 id="numbers">Every number</h2>'
        '<p class="lead">To quote a number, give its id, its n and its interval with it.</p>'
        f"<details><summary>{len(measurements):,} measurements with their definitions</summary>"
        '<div class="scroll" role="region" aria-label="Every number" tabindex="0"><table>'
        '<caption class="unseen">Every measurement with its definition</caption><thead><tr>'
        '<th scope="col">id</th><th scope="col">value</th><th scope="col">definition</th></tr>'
        f"</thead><tbody>{rows}</tbody></table></div>{cut}</details></section>"
    )


def _no_interval(measurement: Measurement) -> str:
    if measurement.interval is not None or measurement.value is None:
        return ""
    reason = measurement.reason_without_interval
    return f"; no interval: {reason}" if reason else ""


def _provenance(results: Results) -> str:
    software = results.provenance.get("software")
    told = ""
    if isinstance(software, Mapping):
        commit = str(software.get("git_commit") or "")
        told = f"{software.get('name', 'robot-gst')} {software.get('version', '')}"
        told += f", commit {commit[:12]}" if commit else ""
        told = f"<p>{escape(told)}. Every input file stands here with its hash.</p>"
    text = json.dumps(dict(_short(results.provenance)), indent=1)
    return (
        '<section aria-labelledby="provenance"><h2 id="provenance">Where it came from</h2>'
        f"{told}<details><summary>Software, settings and input files</summary>"
        '<div class="scroll" role="region" aria-label="Provenance" tabindex="0">'
        f"<pre>{escape(text)}</pre></div></details></section>"
    )


def _short(provenance: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Cut long lists of files; results.json holds them whole."""
    for name, value in provenance.items():
        if isinstance(value, Mapping) and len(value) > SHOWN_ENTRIES:
            kept = dict(list(value.items())[:SHOWN_ENTRIES])
            rest = f"{len(value) - SHOWN_ENTRIES:,} more in results.json"
            yield name, kept | {"...": rest}
        else:
            yield name, value
