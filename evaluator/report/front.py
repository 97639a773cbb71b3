"""The first two pages: what an evaluation means, in one line per task, before any table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from evaluator.compare.agreement import says_nothing
from evaluator.compare.conclusions import direction
from evaluator.compare.policies import ALL_TASKS
from evaluator.quantity import noun
from evaluator.report.sections import HEADLINES
from evaluator.report.wording import agreeing_side
from evaluator.result import Cell, Measurement, Results
from evaluator.statistics.intervals import wilson

SHOWN_TASKS = 8
"""Tasks with a line; the table holds the others."""
SHOWN_MISSING = 6
SAYS_LITTLE = 10
"""Fewer trials that all end alike say little of anything."""
SHOWN_ANSWERS = 3
LONGEST = 150
"""Characters of one reason; the whole stands further down."""
LONGEST_NOTE = 260
CLOSE_PP = 10.0
"""A bias smaller than this does not change what one does with a rate [percentage points]."""
SIMPSON = "Simpson's paradox"
"""What the report begins with, where a note says it."""
SAYS_NOTHING = "says nothing"
"""Said of r by a note, which the first page does not say twice."""
FIGURES = ("scatter", "success")
"""The picture beside the sentences: the first that was drawn."""
Row = Mapping[str, Cell]


@dataclass(frozen=True, kw_only=True)
class Front:
    """What a reader sees first."""

    sentences: Sequence[str]
    """Over all tasks."""
    next_step: str
    """What to run next; empty where nothing would settle more."""
    tasks: Sequence[tuple[str, str]]
    """Task and sentence."""
    more_tasks: int
    notes: Sequence[tuple[str, str]]
    """What must be known before a number is used."""
    missing: Sequence[str]
    more_missing: int


def front(results: Results) -> Front:
    """Write the first page of some results."""
    rows = rows_of(results, "conclusions")
    about = [(str(row["about"]), str(row["note"])) for row in rows_of(results, "notes")]
    missing = [text for text in results.missing if not text.startswith("figures without data")]
    opposed = [text for _, text in about if SIMPSON in text]
    told = _summary(results, len(rows))
    about = [
        (name, text)
        for name, text in about
        if text not in opposed and not (SAYS_NOTHING in text and SAYS_NOTHING in " ".join(told))
    ]
    return Front(
        sentences=[*_compared(results), *(f"{t}." for t in opposed), *told],
        next_step=next_trials(results),
        tasks=[(str(row["task"]), sentence(row)) for row in rows[:SHOWN_TASKS]],
        more_tasks=max(0, len(rows) - SHOWN_TASKS),
        notes=[
            (HEADLINES.get(name, name.replace("_", " ")), _short(text, LONGEST_NOTE))
            for name, text in about[:2]
        ],
        missing=[_short(text) for text in missing[:SHOWN_MISSING]],
        more_missing=max(0, len(missing) - SHOWN_MISSING),
    )


def _compared(results: Results) -> list[str]:
    """Say which candidate is better, of the questions over all tasks, and what the twin's cost."""
    rows = rows_of(results, "comparisons")
    sentences = [str(row["answer"]) for row in rows if row["task"] == ALL_TASKS]
    heads = ("undecided", "no difference")  # others begin with a name, which keeps its letters
    standing, beaten = _standing(results)
    if standing:  # it says who is worse; what is open between those who may be best is left
        sentences = [
            text
            for text in sentences
            if text.startswith("undecided")
            and not any(f": {name} " in text or f", {name} " in text for name in beaten)
        ]
    found = standing + [
        f"{text[0].upper()}{text[1:]}." if text.startswith(heads) else f"{text}."
        for text in sentences[: SHOWN_ANSWERS - len(standing)]
    ]
    if alike := _all_alike(results)[0]:
        return [alike]
    regret = next((m for m in results.measurements if m.id == "decision.regret_pp"), None)
    if regret is not None and regret.value is not None:
        ends = _ends(regret, ".0f")
        found.append(f"Taking what sim ranks first costs {_points(regret.value)}{ends}.")
    return found


def _standing(results: Results) -> tuple[list[str], list[str]]:
    """Say which of three candidates and more may be best, and return the others.

    Nothing where it may be any of them.
    """
    rows = rows_of(results, "standing")
    best = [row for row in rows if row["may be best"] == "yes"]
    beaten = [str(row["candidate"]) for row in rows if row["may be best"] == "no"]
    if not beaten:
        return [], []
    if len(best) > 1:
        listed = ", ".join(str(row["candidate"]) for row in best[:SHOWN_TASKS])
        more = " ..." if len(best) > SHOWN_TASKS else ""
        return [f"{len(best)} of {len(rows)} candidates may be best: {listed}{more}."], beaten
    counts = " ".join(f"with {row['k']} of {row['n']}" for row in best)
    name = best[0]["candidate"]
    words = f"{name} is best of {len(rows)} candidates, {counts}: every other one is shown to be "
    return [f"{words}worse than another; stop here."], beaten


def rows_of(results: Results, table_id: str) -> list[Row]:
    """Return the rows of a table; none where there is no such table."""
    table = next((t for t in results.tables if t.id == table_id), None)
    return [] if table is None else [dict(zip(table.columns, r, strict=True)) for r in table.rows]


def sentence(row: Row) -> str:
    """Write what one task's numbers mean."""
    parts = [_bias_words(row)]
    if isinstance(row["yes"], int) and isinstance(row["yes and right"], int):
        parts.append(
            f"when the twin predicted success it was right {row['yes and right']} of {row['yes']}"
        )
        if isinstance(row.get("succeeded"), int):  # older results do not count it
            parts.append(f"overall {row['succeeded']} of {row['trials']} succeeded")
    return "; ".join(parts) + "."


def answer(row: Row) -> str:
    """Say whether the twin's rate may stand for the recorded one: yes, not yet, not for this.

    Yes where the whole interval of the bias lies within ``CLOSE_PP``; not for this where it leaves
    zero out; not yet where it is too wide for either, or is not known.
    """
    low, high = _number(row["low"]), _number(row["high"])
    if low is None or high is None:
        return "not yet"
    if max(-low, high) <= CLOSE_PP:
        return "yes"
    return "not for this" if direction(low, high) else "not yet"


def next_trials(results: Results) -> str:
    """Name the comparison that the fewest trials are likely to decide; empty where none is open.

    Candidates that are shown to be worse than another are left out. Where all trials ended alike
    it is what would tell candidates apart.
    """
    if step := _all_alike(results)[1]:
        return step
    _, beaten = _standing(results)
    wanted = [
        (more, _pair(str(row.get("first", "one")), str(row.get("second", "another"))))
        for row in rows_of(results, "comparisons")
        if row["task"] == ALL_TASKS and row["decided"] == "no"
        if not {row.get("first"), row.get("second")} & {*beaten}
        if isinstance(more := row["more trials of each"], int) and more > 0
    ]
    if not wanted:
        return ""
    more, pair = min(wanted)
    return f"{more} more {noun('trial', more)} of each would likely decide {pair}."


def _pair(first: str, second: str) -> str:
    """Name two candidates by what they do not share."""
    parts = [*zip(first.split(", "), second.split(", "), strict=False)]
    differ = [pair for pair in parts if pair[0] != pair[1]]
    return " against ".join(map(", ".join, zip(*differ, strict=True)))


def _bias_words(row: Row) -> str:
    bias, low, high = (_number(row[name]) for name in ("bias (pp)", "low", "high"))
    if bias is None:
        return "the bias is not known"
    size = f"bias {_signed(bias)} {noun('point', abs(round(bias)))}"
    if low is None or high is None:
        return f"{size}, without an interval"
    ends = f"[{_signed(low)}, {_signed(high)}]"
    found = direction(low, high)
    return f"{size} {ends}: the twin is {found}" if found else f"{size}; interval {ends} includes 0"


def _signed(value: float) -> str:
    return f"{round(value):+d}" if round(value) else "0"


def _points(value: float) -> str:
    size = round(abs(value))
    return f"{size} {noun('point', size)}"


def _summary(results: Results, num_tasks: int) -> list[str]:
    by_id = {m.id: m for m in results.measurements}
    parts: list[str] = []
    side = agreeing_side(by_id)
    rate = by_id.get(f"agreement.{side}.rate")
    if rate is not None and rate.k is not None and rate.n:
        who = "Sim" if side == "sim_planned" else "Without plans, what was executed in the twin"
        parts.append(f"{who} and outcome agree in {rate.k} of {rate.n} trials.")
    bias = by_id.get("agreement.bias_pp")
    one_line = num_tasks == 1 and bias is not None and bias.interval is None  # says it already
    if bias is not None and bias.value is not None and (bias.n or 0) > 1 and not one_line:
        word = "above" if bias.value > 0 else "below"
        ends = _ends(bias)
        size = f"{_points(bias.value)} {word}" if round(bias.value) else "level with"
        parts.append(f"Over {bias.n} groups the twin lies {size} the recorded rates{ends}.")
    r = by_id.get("agreement.pearson_r")
    blind = by_id.get("agreement.blind_share")
    if r is not None and r.value is not None:
        parts.append(
            f"r = {r.value:.2f}{_ends(r, '.2f')} {SAYS_NOTHING}: its interval is too wide."
            if says_nothing(r)
            else f"Its rates follow them with r = {r.value:.2f}{_ends(r, '.2f')}."
            if not r.is_beyond
            else f"Measured r = {r.value:.2f}; without the noise of counting r lies"
            f" in{_ends(r, '.2f')}."
        )
    named = sum(name.startswith("agreement.blind.") for name in by_id)
    if blind is not None and blind.interval is not None and (named or blind.interval.low > 0.01):
        low, high = (round(100 * end) for end in (blind.interval.low, blind.interval.high))
        which = f", probably in {named} of these, which the notes name" if named else ""
        parts.append(f"It is blind in {low} to {high} % of such groups{which}.")
    return parts


def _all_alike(results: Results) -> tuple[str, str]:
    """Say that nothing, or everything, succeeded, and what to do: no rate here ranks anything."""
    rates = [m for m in results.measurements if m.id.startswith("rate.recorded.") and m.n]
    k, n = sum(m.k or 0 for m in rates), sum(m.n or 0 for m in rates)
    if not n or any(m.k is None for m in rates) or 0 < k < n:
        return "", ""
    word, task = ("Nothing", "an easier") if k == 0 else ("Everything", "a harder")
    ends = wilson(k, n)
    reach = f"{100 * ends.low:.0f} to {100 * ends.high:.0f} %"
    told = f"{word} succeeded: {k} of {n} recorded {noun('trial', n)}, so the rate lies in {reach}."
    few = f"record more trials; {n} {'say' if n > 1 else 'says'} next to nothing."
    return told, few if n < SAYS_LITTLE else f"try {task} task: this one ranks no candidate."


def _ends(measurement: Measurement, digits: str = "+.0f") -> str:
    interval = measurement.interval
    if interval is None:
        return ", without an interval"
    return f" [{interval.low:{digits}}, {interval.high:{digits}}]"


def _number(cell: Cell) -> float | None:
    is_number = isinstance(cell, int | float) and not isinstance(cell, bool)
    return float(cell) if is_number and cell is not None else None


def _short(text: str, longest: int = LONGEST) -> str:
    if len(text) <= longest:
        return text
    return text[:longest].rsplit(" ", 1)[0].rstrip(",;:") + " ..."
