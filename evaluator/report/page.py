"""``report.html``: one file, no outside requests, readable without JavaScript."""

import json
from collections.abc import Sequence
from html import escape
from importlib import resources

from evaluator.report.wording import (
    cell_text,
    headlines,
    interval_text,
    measurement_text,
    stand_in_sentence,
)
from evaluator.result import Cell, Measurement, Results, Table

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""The page forbids itself to load anything."""


def page(results: Results, figures: Sequence[str]) -> str:
    """Build the page from the results and the figures made of them."""
    banner = stand_in_sentence(results)
    kinds = {"run": "run folder", "trials": "trials table", "rates": "table of rates"}
    style = resources.files("evaluator.report").joinpath("page.css").read_text()
    parts = [
        f"<h1>How far to trust the twin: {escape(results.run)}</h1>",
        f'<p class="soft">Made by robot-gst evaluate from a {kinds[results.source]}.</p>',
        f'<div class="banner">{escape(banner)}</div>' if banner else "",
        _cards(results),
        f'<div class="figures">{"".join(figures)}</div>' if figures else "",
        *(_table(table) for table in results.tables),
        _left_out(results),
        _measurements(results.measurements),
        "<h2>Where it came from</h2><details><summary>Provenance</summary>"
        f"<pre>{escape(json.dumps(results.provenance, indent=1))}</pre></details>",
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(results.run)}: twin report</title><style>{style}</style></head>"
        f"<body><main>{''.join(parts)}</main></body></html>\n"
    )


def _cards(results: Results) -> str:
    cards = [
        f'<div class="card{"" if measurement.value is not None else " undefined"}" '
        f'title="{escape(measurement.definition)}">'
        f"<span>{escape(label)}</span><b>{escape(text)}</b></div>"
        for label, text, measurement in headlines(results)
    ]
    if not cards and results.measurements:
        return ""
    if not cards:
        return "<p>Nothing could be measured; what is missing is listed below.</p>"
    return f'<div class="cards">{"".join(cards)}</div>'


def _table(table: Table) -> str:
    head = "".join(
        f'<th class="{"number" if _is_number(table, index) else "text"}">{escape(name)}</th>'
        for index, name in enumerate(table.columns)
    )
    body = "".join(f"<tr>{''.join(_td(cell) for cell in row)}</tr>" for row in table.rows)
    note = f'<p class="soft">{escape(table.note)}</p>' if table.note else ""
    return (
        f'<h2 id="{escape(table.id)}">{escape(table.title)}</h2><div class="scroll"><table>'
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>{note}"
    )


def _is_number(table: Table, index: int) -> bool:
    cells = [row[index] for row in table.rows if row[index] is not None]
    return bool(cells) and all(isinstance(cell, int | float) for cell in cells)


def _td(cell: Cell) -> str:
    text = escape(cell_text(cell))
    if cell in ("success", "failure"):
        mark = "✓" if cell == "success" else "✗"
        return f'<td class="{cell}">{mark} {text}</td>'
    number = isinstance(cell, int | float) and not isinstance(cell, bool)
    return f'<td class="number">{text}</td>' if number else f"<td>{text}</td>"


def _left_out(results: Results) -> str:
    if not results.exclusions and not results.missing:
        return "<h2>Left out</h2><p>Nothing was left out.</p>"
    missing = "".join(f"<li>{escape(text)}</li>" for text in results.missing)
    rows = "".join(
        f"<tr><td>{escape(item.episode)}</td><td>{escape(item.scope)}</td>"
        f"<td>{escape(item.reason)}</td></tr>"
        for item in results.exclusions
    )
    table = (
        '<div class="scroll"><table><thead><tr><th>episode</th><th>left out of</th>'
        f"<th>reason</th></tr></thead><tbody>{rows}</tbody></table></div>"
        if rows
        else ""
    )
    return f"<h2>Left out, and missing</h2>{f'<ul>{missing}</ul>' if missing else ''}{table}"


def _measurements(measurements: Sequence[Measurement]) -> str:
    rows = "".join(
        f"<tr><td><code>{escape(m.id)}</code></td><td>{escape(measurement_text(m))}"
        f"{escape(_no_interval(m))}</td><td>{escape(m.definition)}</td></tr>"
        for m in measurements
    )
    return (
        f"<h2>Every number</h2><details><summary>{len(measurements)} measurements with their "
        'definitions</summary><div class="scroll"><table><thead><tr><th>id</th><th>value</th>'
        f"<th>definition</th></tr></thead><tbody>{rows}</tbody></table></div></details>"
    )


def _no_interval(measurement: Measurement) -> str:
    if interval_text(measurement) or measurement.value is None:
        return ""
    reason = measurement.reason_without_interval
    return f"; no interval: {reason}" if reason else ""
