"""The first two pages: what an evaluation means, in one line per task, before any table."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from textwrap import shorten

from evaluator.compare.agreement import says_nothing
from evaluator.compare.conclusions import CLOSE_PP, direction
from evaluator.compare.notes import FAR_HERE
from evaluator.compare.policies import ALL_TASKS
from evaluator.quantity import noun
from evaluator.report.sections import HEADLINES
from evaluator.report.wording import agreeing_side
from evaluator.result import Cell, Measurement, Results
from evaluator.statistics.intervals import wilson

SHOWN_TASKS = 8
"""Tasks with a line; the table holds the others."""
SAYS_LITTLE = 10
"""Fewer trials say little of anything."""
SHOWN_ANSWERS = 3
LONGEST = 260
"""Characters of a note; the whole stands further down."""
GROUPS_FOR_R = 4
"""Fewer say nothing of whether the twin's rates follow."""
FOLLOWS_R = 0.5
"""Where r is surely below this, the twin's rates tell less than a quarter of what differs."""
SIMPSON = "Simpson's paradox"
"""What the report begins with, where a note says it."""
SAYS_NOTHING = "says nothing"
"""Said of r by a note, which the first page does not say twice."""
IN_NUMBERS = "In numbers"
"""What a page leaves out that has cards of them."""
TAKE = "take "
"""How a step begins after which no trial is needed."""
NEVER, USE = "not for this", " Use the recorded rates."
"""Of a task whose rates the twin gets wrong, with confidence; and what to do instead."""
TOO_MANY = 3
"""More trials than so many times those that were made are no advice."""
IF_THAT_STAYS = "; if that stays"
"""What an open comparison goes on with; the first page says under "Next" what to do."""
GIVE_N = "add the number of trials behind each rate: a column n, or 7/10 where 70 % stands; where "
GIVE_N += "nobody knows it, this table cannot show which policy is better."
NO_N, NO_INTERVAL = "rates without n", ", without an interval"
NO_TRIALS = "the table gives no numbers of trials"
FIGURES = ("scatter", "success")
"""The picture beside the sentences: the first that was drawn."""
Row = Mapping[str, Cell]


@dataclass(frozen=True, kw_only=True)
class Front:
    """What a reader sees first."""

    answers: Sequence[tuple[str, str]]
    """Over all tasks, each with the question that it answers."""
    next_step: str
    """What to do next; empty where nothing would settle more."""
    commands: Sequence[tuple[str, str]]
    """What to do for it, and to type then; empty where nothing is to be tried."""
    tasks: Sequence[tuple[str, str]]
    """Task and sentence."""
    more_tasks: int
    notes: Sequence[tuple[str, str]]
    """What must be known before a number is used."""


def front(results: Results) -> Front:
    """Write the first page of some results."""
    rows = rows_of(results, "conclusions")
    about = [(str(row["about"]), str(row["note"])) for row in rows_of(results, "notes")]
    opposed = [text for _, text in about if SIMPSON in text]
    told = _summary(results, len(rows))
    trust = [*_trust(results), *_regret(results)]
    answers = {
        "Which is better": _compared(results),
        "Trust the twin": trust,
        IN_NUMBERS: [*told, *(f"{text}." for text in opposed)],
    }
    about = [
        (name, text)
        for name, text in about
        if text not in opposed and FAR_HERE not in text
        if not (SAYS_NOTHING in text and SAYS_NOTHING in " ".join(told))
    ]
    return Front(
        answers=[(n, " ".join(s)) for n, s in answers.items() if s],
        next_step=(step := next_trials(results)),
        commands=_again(results, step) if step and not step.startswith(TAKE) else (),
        tasks=[(str(row["task"]), sentence(row)) for row in rows[:SHOWN_TASKS]],
        more_tasks=max(0, len(rows) - SHOWN_TASKS),
        notes=[
            (HEADLINES.get(n, n.replace("_", " ")), shorten(text, LONGEST, placeholder=" ..."))
            for n, text in about[:2]
        ],
    )


def _compared(results: Results) -> list[str]:
    """Say which candidate is better, of the questions over all tasks."""
    rows = rows_of(results, "comparisons")
    sentences = [
        _with_shared(row).partition(IF_THAT_STAYS)[0].removesuffix("; stop here")
        for row in rows
        if row["task"] == ALL_TASKS
    ]
    heads = ("undecided", "no difference")  # others begin with a name, which keeps its letters
    split = _by_task(results)
    standing, beaten = _standing(results)
    if standing:  # it says who is worse; what is open between those who may be best is left
        sentences = [
            text
            for text in sentences
            if text.startswith("undecided")
            and not any(f": {name} " in text or f", {name} " in text for name in beaten)
        ]
    found = standing + [
        f"{text[0].upper() if text.startswith(heads) else text[0]}{text[1:]}."
        for text in sentences[: SHOWN_ANSWERS - len(standing) - SHOWN_ANSWERS * len(split)]
    ]
    tasks = [name for name in dict.fromkeys(str(row["task"]) for row in rows) if name != ALL_TASKS]
    if tasks and found:
        is_all = {row["task"] for row in rows_of(results, "conclusions")} <= {*tasks}
        which = "all tasks" if is_all else f"the compared tasks ({', '.join(tasks[:SHOWN_TASKS])})"
        found[0] = f"Over {which} together: {found[0]}"
    cannot = _all_alike(results)[0]
    if not rows and _lacks_n(results):
        cannot = f"Cannot be told: {NO_TRIALS}."
    return [cannot] if cannot else [*split, *found]


def _with_shared(row: Row) -> str:
    """Say of an open comparison what both candidates have in common, too."""
    shared = _differing((str(row.get("first", "")), str(row.get("second", ""))))[1]
    more = f" ({shared})" if shared else ""
    return str(row["answer"]).replace("undecided", f"undecided{more}")


def _lacks_n(results: Results) -> bool:
    return any(NO_N in text for text in results.missing)


def _regret(results: Results) -> list[str]:
    """Say what it costs to take what the twin ranks first."""
    regret = next((m for m in results.measurements if m.id == "decision.regret_pp"), None)
    if regret is None or regret.value is None or _all_alike(results)[0]:
        return []
    name = regret.definition.partition("ranks first (")[2].partition("), mean")[0]
    if regret.value == 0:
        return [
            f"The twin and the recorded rates both rank {name} first: that agreement may be chance."
        ]
    taken = "one of them by chance" if " or " in name else "its recorded rate"
    words = f"The twin ranks {name} first; {taken} is {_points(regret.value)}"
    return [f"{words}{_ends(regret, '.0f')} below the best over all tasks."]


def _by_task(results: Results) -> list[str]:
    """Say who was not beaten on a task, where of two one is better here and the other there."""
    rows = [row for row in rows_of(results, "comparisons") if row["task"] != ALL_TASKS]
    decided = [row for row in rows if row["decided"] != "no"]
    won = {(row.get("first"), row.get("second"), row["decided"]) for row in decided}
    if not any({(*pair, "better"), (*pair, "worse")} <= won for *pair, _ in won):
        return []
    listed = []
    for task in dict.fromkeys(row["task"] for row in rows):
        here = [row for row in decided if row["task"] == task]
        lost = [row["first" if row["decided"] == "better" else "second"] for row in here]
        names = dict.fromkeys(
            r[side] for r in rows if r["task"] == task for side in ("first", "second")
        )
        left = " or ".join(str(name) for name in names if name not in lost)
        listed.append(f"{(left or 'none') if lost else 'any'} on {task}")
    return [f"Which is better depends on the task. Not beaten: {'; '.join(listed)}."]


def _standing(results: Results) -> tuple[list[str], list[str]]:
    """Say which of three candidates and more may be best, and return the others.

    Nothing where it may be any of them.
    """
    rows = rows_of(results, "standing")
    best = [row for row in rows if row["may be best"] == "yes"]
    beaten = [str(row["candidate"]) for row in rows if row["may be best"] == "no"]
    if not beaten:
        return [], []
    if not best:
        return [f"Each of {len(rows)} candidates lost to another: none is the best."], []
    if len(best) > 1:
        listed = ", ".join(str(row["candidate"]) for row in best[:SHOWN_TASKS])
        more = " ..." if len(best) > SHOWN_TASKS else ""
        lost = f"; not the best: {', '.join(beaten[:SHOWN_TASKS])}"
        return [f"{listed}{more} may be best{lost}."], beaten
    name, of = best[0]["candidate"], f"({best[0]['k']} of {best[0]['n']})"
    over_all = all(f", {name}, " in f", {row['beaten by']}, " for row in rows if row not in best)
    why = "it is better than each of the others" if over_all else "only it lost no comparison"
    second = max((row for row in rows if row not in best), key=lambda row: _number(row["k"]) or 0.0)
    then = f"; next {second['candidate']} ({second['k']} of {second['n']})"
    return [f"{name} {of} is the best of {len(rows)} candidates: {why}{then}."], beaten


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
    return NEVER if direction(low, high) else "not yet"


def next_trials(results: Results) -> str:
    """Say what to try, take or record next, and how much of it; empty where nothing is open.

    It is what the fewest trials are likely to decide between candidates that may still be best.
    Where all trials ended alike it is what would tell candidates apart.
    """
    if step := _all_alike(results)[1]:
        return step
    _, beaten = _standing(results)
    asked = [
        (row, (str(row.get("first", "one")), str(row.get("second", "another"))))
        for row in rows_of(results, "comparisons")
    ]
    of_all = [(row, pair) for row, pair in asked if row["task"] == ALL_TASKS]
    wanted = [
        (more, pair)
        for row, pair in of_all
        if row["decided"] == "no" and not {*pair} & {*beaten}
        if isinstance(more := row["more trials of each"], int) and more > 0
    ]
    standing = rows_of(results, "standing")
    if not wanted and (best := _settled([row for row, _ in of_all], standing)):
        return best
    if _by_task(results):
        return f"{TAKE}for each task one that was not beaten there; none is best on all tasks."
    if not wanted:
        return GIVE_N if _lacks_n(results) else ""
    (more, pair), *others = sorted(wanted)
    made = sum(m.n or 0 for m in results.measurements if m.id.startswith("rate.recorded."))
    if len({name for _, each in asked for name in each}) * more > TOO_MANY * made > 0:
        won = {str(row["candidate"]): _number(row["k"]) or 0.0 for row in standing}
        names = sorted({n for _, each in wanted for n in each}, key=lambda n: (-won.get(n, 0), n))
        whom = "them" if len(names) == 2 else "even two of them"
        words = f"each may be best; if the rates stay as seen, to tell {whom} apart takes about"
        first = " (most successes)" if won else ""
        words = f"{words} {2 * more} more trials in all, which is seldom worth it."
        return f"{TAKE}{names[0]}{first} or {' or '.join(names[1:])}: {words}"
    tasks = [str(row["task"]) for row, each in asked if each == pair and row["task"] != ALL_TASKS]
    named = [" against ".join(_differing(each)[0]) for _, each in others[:SHOWN_ANSWERS]]
    rest = f"; undecided then, too: {', '.join(named)}" if named else ""
    likely = "if the rates stay as seen, that is likely to tell these two apart"
    return f"{_more_trials(more, pair, tasks)}; {likely}{rest}."


def _more_trials(more: int, pair: tuple[str, str], tasks: Sequence[str]) -> str:
    one = -(-more // max(1, len(tasks)))
    (first, second), shared = _differing(pair)
    sides = [n if n.startswith("with") else f"of {n}" for n in (first, second)]
    where = f": {', '.join(tasks)}" if len(tasks) <= SHOWN_TASKS else ""
    in_all = f" on each of {len(tasks)} tasks{where} ({2 * one * len(tasks)} trials in all)"
    alone = f", all {shared}{',' * (len(tasks) > 1)}" if shared else ""
    words = f"make {one} more {noun('trial', one)} {sides[0]} and {one} {sides[1]}{alone}"
    return f"{words}{in_all if len(tasks) > 1 else ''}"


def _differing(pair: tuple[str, str]) -> tuple[list[str], str]:
    """Name two candidates without what they have in common, and that."""
    parts = list(zip(*(name.split(", ") for name in pair), strict=False))
    unlike = zip(*(both for both in parts if len({*both}) > 1), strict=True)
    return list(map(", ".join, unlike)), ", ".join(a for a, b in parts if a == b)


def _settled(compared: Sequence[Row], standing: Sequence[Row]) -> str:
    """Say what to take where one candidate is better than all others."""
    best = [str(row["candidate"]) for row in standing if row["may be best"] == "yes"]
    if len(compared) == 1 and compared[0]["decided"] != "no":
        best = [str(compared[0]["second" if compared[0]["decided"] == "better" else "first"])]
    return f"{TAKE}{best[0]}; no more trials are needed to choose." if len(best) == 1 else ""


def _again(results: Results, step: str) -> tuple[tuple[str, str], ...]:
    if results.source == "run":
        name = shlex.quote(str(results.provenance.get("folder", results.run)))
        then = f"robot-gst replay {name} && robot-gst evaluate {name}"
        return ("Record them with", f"robot-gst record {name}"), (", then type", then)
    files = shlex.join(results.provenance.get("files", ())) or shlex.quote(results.run)
    what = "counts" if results.source == "rates" else "outcomes"
    first = "Then type" if step == GIVE_N else f"Add the {what} to the table, then type"
    return ((first, f"robot-gst evaluate {files}"),)


def _trust(results: Results) -> list[str]:
    """Say whether the twin's rates may stand for recorded ones: yes, no, or can't tell yet.

    Yes only where it surely follows, is surely close in each task and seems blind in no group.
    """
    by_id = {m.id: m for m in results.measurements}
    r, bias = by_id.get("agreement.pearson_r"), by_id.get("agreement.bias_pp")
    if r is None or bias is None or not bias.n:
        return []
    found = [*_far(results, bias.n), *_followed(r, bias.n), *_near(results, bias)]
    if results.stand_in:
        found.insert(0, (False, "the recorded side is a simulation, too"))
    against = [words for is_sure, words in found if is_sure]
    low = 0.0 if r.interval is None else r.interval.low
    yes = f"in each of these tasks its rate is within {CLOSE_PP:.0f} points of the recorded one, "
    yes += f"it follows from group to group (r at least {low:.2f}), and no group looks blind"
    told = "No" if against else "Not yet" if found else "Yes"
    why = "; ".join(against or [words for _, words in found] or [yes])
    use = USE if found and not results.stand_in and not _all_alike(results)[0] else ""
    return [f"{told}. {why[0].upper()}{why[1:]}.{use}"]


Against = Iterator[tuple[bool, str]]
"""What speaks against the twin, and whether it is sure."""


def _far(results: Results, num_groups: int) -> Against:
    notes = rows_of(results, "notes")
    told = [(str(row["note"]), str(row["about"])) for row in notes]
    if far := [text.replace(FAR_HERE, about) for text, about in told if FAR_HERE in text]:
        named = [*far[:SHOWN_ANSWERS], *["..."] * (len(far) > SHOWN_ANSWERS)]
        words = f"in {len(far)} of {num_groups} groups its rate is far from the recorded one"
        yield True, f"{words}, unlike in the others ({'; '.join(named)})"


def _followed(r: Measurement, num_groups: int) -> Against:
    if r.interval is None or r.value is None:
        why = str(r.reason_if_undefined or r.reason_without_interval).replace(";", ",")
        if num_groups < GROUPS_FOR_R:
            there = "there is 1" if num_groups == 1 else f"there are {num_groups}"
            why = f"it takes {GROUPS_FOR_R} groups (policies times tasks) at least, and {there}"
        why = NO_TRIALS if why.startswith(NO_N) else why
        yield False, f"whether its rates follow the recorded ones cannot be told: {why}"
    elif r.interval.high < FOLLOWS_R:
        yield True, f"its rates hardly follow the recorded ones (r at most {r.interval.high:.2f})"
    elif r.interval.low <= 0:
        yield (
            False,
            f"how the twin's rates follow the recorded ones is too uncertain (r{_ends(r, '.2f')})",
        )


def _near(results: Results, bias: Measurement) -> Against:
    rows = rows_of(results, "conclusions")
    found = [answer(row) for row in rows]
    off, open_, many = found.count(NEVER), found.count("not yet"), len(found)
    if (ends := bias.interval) and answer({"low": ends.low, "high": ends.high}) == NEVER:
        yield True, f"over all groups it is {direction(ends.low, ends.high)}"
    if off:
        bad = {str(r["task"]): _number(r["bias (pp)"]) or 0.0 for r in rows if answer(r) == NEVER}
        least, most = min(bad.values()), max(bad.values())
        which = "too high" if least > 0 else "too low" if most < 0 else "wrong"
        named = f" ({', '.join(bad)})" if off <= SHOWN_ANSWERS and many > 1 else ""
        yield 2 * off > many, f"{_of_tasks(off, many)}its rate is {which}{named}"
    if (open_ or not many) and any(row["low"] is not None for row in rows):
        where = _of_tasks(open_, many)
        yield False, f"{where}it may be off by more than {CLOSE_PP:.0f} points"


def _of_tasks(some: int, many: int) -> str:
    if some == many:
        return "" if many < 2 else "in both tasks " if many == 2 else f"in all {many} tasks "
    return f"in {some} of {many} tasks "


def _bias_words(row: Row) -> str:
    bias, low, high = (_number(row[name]) for name in ("bias (pp)", "low", "high"))
    if bias is None:
        return "the bias is not known"
    size = f"bias {_signed(bias)} {noun('point', abs(round(bias)))}"
    if low is None or high is None:
        return f"{size}{NO_INTERVAL}"
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
    if rate is not None and rate.k is not None and rate.n and rate.n >= SAYS_LITTLE:
        who = "Twin" if side == "sim_planned" else "Without plans, what was executed in the twin"
        of = f"{rate.k} of {rate.n} trials ({100 * rate.k / rate.n:.0f} %"
        parts.append(f"{who} and recorded outcome agree in {of}{_by_chance(results, rate.n)}).")
    again = by_id.get("agreement.repeated.rate")
    if again is not None and (again.n or 0) >= SAYS_LITTLE:
        pairs = f"{again.k} of {again.n} pairs of trials from one start"
        parts.append(f"The cell agrees with itself in {pairs} ({100 * (again.value or 0):.0f} %).")
    bias = by_id.get("agreement.bias_pp")
    if bias and bias.value is not None and (bias.n or 0) > 1 and (num_tasks > 1 or bias.interval):
        size = f"{_points(bias.value)} {'below' if bias.value < 0 else 'above'}"
        rows = rows_of(results, "success")
        kinds = [k for k in ("policy", "condition") if any(row[k] for row in rows)]
        each = f" (each {' and '.join(f'one {k}' for k in kinds)} on one task)" if kinds else ""
        words = f"Over {bias.n} groups{each} the twin's rates lie {size} the recorded ones"
        parts.append(f"{words} on average{_ends(bias)}.")
    r = by_id.get("agreement.pearson_r")
    if r is not None and r.value is not None:
        nothing = f", which {SAYS_NOTHING}: its interval is too wide" if says_nothing(r) else ""
        parts.append(
            f"Measured r = {r.value:.2f}; without the noise of counting r is in{_ends(r, '.2f')}."
            if r.is_beyond
            else f"Their correlation is r = {r.value:.2f}{_ends(r, '.2f')}{nothing}."
        )
    return parts


def _by_chance(results: Results, num_trials: int) -> str:
    """Say how often outcomes would agree that have the same rates and else nothing."""
    rows = rows_of(results, "conclusions")
    yes, succeeded, known = (
        sum(n for row in rows if isinstance(n := row.get(name), int)) / num_trials
        for name in ("yes", "succeeded", "trials")
    )
    if known != 1:  # or older results, which miss some
        return ""
    return f"; by chance {100 * (yes * succeeded + (1 - yes) * (1 - succeeded)):.0f} %"


def _all_alike(results: Results) -> tuple[str, str]:
    """Say that nothing, or everything, succeeded, and what to do: no rate here ranks anything."""
    rates = [m for m in results.measurements if m.id.startswith("rate.recorded.") and m.n]
    k, n = sum(m.k or 0 for m in rates), sum(m.n or 0 for m in rates)
    if not n or any(m.k is None for m in rates) or 0 < k < n:
        return "", ""
    words, task = ("nothing", "an easier") if k == 0 else ("everything", "a harder")
    each, ends = f"record {SAYS_LITTLE} trials or more of each policy on", wilson(k, n)
    told = f"{words} succeeded, {k} of {n} recorded {noun('trial', n)}; the pooled rate is between "
    told = f"{told}{100 * ends.low:.0f} and {100 * ends.high:.0f} %."
    alone = "Nothing to compare: there is one policy on one task; "
    cannot = alone if len(rates) == 1 else "Cannot be told: "
    few = f"{each} each task; to compare, at least 2 policies; to judge the twin, at least "
    few = f"{few}{GROUPS_FOR_R} groups (a group: one policy on one task)."
    why = f"while {words} succeeds, no policy can be shown to be better"
    alike = f"check how success is scored; if that is right, {each} {task} task: {why}."
    return cannot + told, few if n < SAYS_LITTLE else alike


def _ends(measurement: Measurement, digits: str = "+.0f") -> str:
    interval = measurement.interval
    if interval is None:
        return NO_INTERVAL
    return f" [{interval.low:{digits}}, {interval.high:{digits}}]"


def _number(cell: Cell) -> float | None:
    is_number = isinstance(cell, int | float) and not isinstance(cell, bool)
    return float(cell) if is_number and cell is not None else None
