"""``report.html``: one file, no outside requests, readable without JavaScript, light and dark.

What the page says stands in ``templates/``; here is what it says it about, in reading order.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from bridge.whole_file import write_whole
from evaluator.report import sections, wording
from evaluator.report.figures import DARK, LIGHT, Drawing
from evaluator.report.front import FIGURES, front
from evaluator.report.sections import OTHER, SECTIONS, TRIALS, Section
from evaluator.report.views import Figures, Shown, is_number, used_columns, view
from evaluator.report.wording import minus
from evaluator.result import Measurement, Results, Table

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""The page forbids itself to load anything."""
SOURCES = {
    "run": "a run folder",
    "trials": "a table of trials",
    "rates": "a table of rates",
    "images": "folders of images",
}
SHOWN_ROWS = 200
"""Rows of a table on the page; the whole table lies beside it as CSV."""
SHOWN_NUMBERS = 16
"""Numbers in one part; the list of all numbers has the others."""
SHOWN_MEASUREMENTS = 1500
SHOWN_ENTRIES = 12
"""Of a long part of the provenance."""
OPEN_ROWS = 14
"""A longer table is folded away: it is looked things up in, not read."""
ALWAYS_OPEN = ("published", "success", TRIALS)

SHARED = "shared"
"""Folder beside the report: files with the clips of single trials."""
NO_SHARED = "<!--shared--><!--/shared-->"
"""Where the report names them; ``name_shared`` fills it in."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """What the page shows of one section."""

    section: Section
    numbers: Sequence[tuple[str, Measurement]]
    figures: Sequence[Drawing]
    tables: Sequence[tuple[Table, bool]]
    """Each with whether a click shows it."""


def page(results: Results, figures: Sequence[Drawing] = (), *, everything: bool = False) -> str:
    """Build the page of the results."""
    shown = sections.shown_tables(results, everything=everything)
    shown_first = [each for name in FIGURES for each in figures if each.id == name][:1]
    tables_first = [table for table in results.tables if table.id == "success" and table.rows]
    later = replace(results, tables=tuple(t for t in shown if t not in tables_first))
    rest = [each for each in figures if each not in shown_first]
    parts = [
        part for section in (*SECTIONS, OTHER) if (part := _part(section, later, rest)) is not None
    ]
    trials = next((table for table in shown if table.id == TRIALS), None)
    names = [("meaning", "What it means")]
    names += [(part.section.id, part.section.title) for part in parts]
    names += [("trials-part", "Every trial")] if trials else []
    names += [("left-out", "Excluded and missing")]
    names += [("numbers", "Every number")] if everything else []
    names += [("provenance", "Sources")]
    of_twin = ("rate.sim", "agreement.", "views.", "image.", "motion.")
    has_twin = any(m.value is not None and m.id.startswith(of_twin) for m in results.measurements)
    question = "Twin and recorded success" if has_twin else "Recorded success"
    software = results.provenance.get("software") or {}
    commit = f", commit {software['git_commit'][:12]}" if software.get("git_commit") else ""
    told = f"{software.get('name', 'robot-gst')} {software.get('version', '')}{commit}"
    excluded = Table(
        id="exclusions",
        title="What was left out",
        columns=("episode", "left out of", "reason"),
        rows=tuple((item.episode, item.scope, item.reason) for item in results.exclusions),
    )
    return (
        environment()
        .get_template("report.html")
        .render(
            results=results,
            title=f"{results.run}: {question.lower()}",
            question=question,
            has_twin=has_twin,
            shared_mark=Markup(NO_SHARED),
            source=SOURCES.get(results.source, results.source),
            banner=wording.STAND_IN if results.stand_in else None,
            had_plans=wording.agreeing_side({m.id: m for m in results.measurements})
            == wording.SIM_SIDE,
            contents=names,
            first=front(results),
            front_figures=shown_first,
            front_tables=tables_first,
            parts=parts,
            trials=trials,
            excluded=excluded,
            software=told if software else "",
            provenance=json.dumps(dict(_short(results.provenance)), indent=1),
            everything=everything,
            next_table=count(1).__next__,
            next_figure=count(1).__next__,
        )
    )


def name_shared(report: Path) -> None:
    """Let a written report name the files in the folder ``shared`` beside it, or none."""
    try:
        text = report.read_text()
        names = sorted(path.name for path in (report.parent / SHARED).glob("*.html"))
        before, opened, rest = text.partition("<!--shared-->")
        _, closed, after = rest.partition("<!--/shared-->")
        if not (opened and closed):
            return
        links = ", ".join(f'<a href="{SHARED}/{quote(name)}">{escape(name)}</a>' for name in names)
        paragraph = f'<p class="soft">Trials with their clips: {links}</p>' if names else ""
        new = f"{before}{opened}{paragraph}{closed}{after}"
        if new != text:
            write_whole(report, new.encode())
    except (OSError, UnicodeDecodeError):  # not there, or not ours to write
        return


def _part(section: Section, results: Results, figures: Sequence[Drawing]) -> Part | None:
    """Collect one part, or nothing when the run has nothing for it."""
    found = [table for table in results.tables if sections.section_of(table.id) is section]
    tables = [(table, is_long(table)) for table in found if table.id != TRIALS]
    drawn = [drawing for drawing in figures if drawing.id in section.figures]
    numbers = sections.numbers_of(section, results.measurements)
    if not tables and not drawn and not any(m.value is not None for _, m in numbers):
        return None
    return Part(section=section, numbers=numbers, figures=drawn, tables=tables)


def _short(provenance: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Cut long lists of files; results.json holds them whole."""
    for name, value in provenance.items():
        if isinstance(value, Mapping) and len(value) > SHOWN_ENTRIES:
            kept = dict(list(value.items())[:SHOWN_ENTRIES])
            yield name, kept | {"...": f"{len(value) - SHOWN_ENTRIES:,} more in results.json"}
        else:
            yield name, value


@cache
def environment() -> Environment:
    """Return what fills in the templates of the report, for pages that look like it."""
    environment = Environment(
        loader=PackageLoader("evaluator.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        function.__name__: function
        for function in (
            *(breakable, minus, thousands, grid, footnotes, reason, is_long, sections.decides),
            *(wording.cell_text, wording.value_text, wording.ends_text, wording.count_text),
            *(wording.method_text, wording.measurement_text),
        )
    }
    environment.tests["figures"] = lambda cell: isinstance(cell, Figures)
    environment.globals |= {
        "policy": POLICY,
        "light": LIGHT,
        "dark": DARK,
        "decided": sections.FIGURES,
        "shown_rows": SHOWN_ROWS,
        "shown_numbers": SHOWN_NUMBERS,
        "shown_measurements": SHOWN_MEASUREMENTS,
    }
    return environment


SHORT = 24
"""Characters of a name that fits any column."""


def breakable(text: str) -> Markup:
    """Let a long name break behind its joints, so that it never widens a page; a number stays."""
    if len(text) <= SHORT:
        return escape(text)
    return Markup("<wbr>").join(re.split(r"(?<=[^\W\d][_./-])(?=\w)", text))


def thousands(count: int) -> str:
    """Write a count with a comma between thousands."""
    return f"{count:,}"


def is_long(table: Table) -> bool:
    """Whether a table is looked things up in, and so folded."""
    return len(table.rows) > OPEN_ROWS and table.id not in ALWAYS_OPEN


def grid(table: Table) -> tuple[list[tuple[str, bool]], list[list[Shown]]]:
    """Return used columns, each with whether it holds numbers, and the rows of the page."""
    shown = view(table)
    used = used_columns(shown)
    columns = [(shown.columns[i], is_number(shown, i)) for i in used]
    return columns, [[row[i] for i in used] for row in shown.rows[:SHOWN_ROWS]]


def reason(measurement: Measurement) -> str:
    """Return why there is no value, or no interval; empty where there are both."""
    if measurement.value is None:
        return measurement.reason_if_undefined or ""
    return "" if measurement.interval else measurement.reason_without_interval or ""


def footnotes(numbers: Sequence[tuple[str, Measurement]]) -> dict[str, str]:
    """Return the mark of each reason; equal reasons share one."""
    reasons = dict.fromkeys(filter(None, (reason(measurement) for _, measurement in numbers)))
    return {text: chr(ord("a") + index) for index, text in enumerate(reasons)}
