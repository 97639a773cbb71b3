"""Tables as people read them: numbers of several columns become one text, ``4/5 = 80.0 %``.

Tables hold numbers, one to a column, in ``results.json``, CSV and Parquet. What is printed,
drawn on the page and set in LaTeX is a view of them, made here as DataFrames.
"""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from evaluator.result import Cell, Table

if TYPE_CHECKING:
    import pandas as pd

Record = dict[Hashable, Any]


@dataclass(frozen=True)
class Figures:
    """A number as people read it, with its count and the ends of its interval."""

    value: str
    """With its unit."""
    ends: str = ""
    count: str = ""

    def __str__(self) -> str:
        """Write it in one line."""
        count = f"{self.count} = " if self.count else ""
        return f"{count}{self.value}" + (f" [{self.ends}]" if self.ends else "")


Shown = Cell | Figures
"""What a view may hold."""


@dataclass(frozen=True, kw_only=True)
class View:
    """A table as it is printed."""

    id: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Shown, ...], ...]
    note: str


def view(table: Table) -> View:
    """Return what is printed of a table."""
    build = _VIEWS.get("bands" if table.id.startswith("bands_") else table.id)
    if build is None or not table.rows:
        return View(**vars(table))
    import pandas as pd  # noqa: PLC0415  # a third of a second, and only what is printed needs it

    frame = build(pd.DataFrame(table.rows, columns=table.columns, dtype=object))
    shown = frame.astype(object).where(frame.notna(), None)
    rows = tuple(map(tuple, shown.to_numpy()))
    return View(**(vars(table) | {"columns": tuple(shown.columns), "rows": rows}))


def used_columns(table: View) -> list[int]:
    """Return the columns that say something in any row."""
    return [
        index
        for index in range(len(table.columns))
        if not table.rows or any(row[index] not in ("", None) for row in table.rows)
    ]


def is_number(table: View, index: int) -> bool:
    """Say whether a column holds numbers, or mostly numbers with their intervals.

    Args:
        table: A table as it is printed.
        index: Place of the column, from 0.
    """
    cells = [row[index] for row in table.rows if row[index] is not None]
    if any(isinstance(cell, Figures) for cell in cells):
        return 2 * sum(isinstance(cell, Figures) for cell in cells) > len(cells)
    return bool(cells) and all(
        isinstance(cell, int | float) and not isinstance(cell, bool) for cell in cells
    )


def _known(value: Any) -> bool:
    return value is not None and value == value  # NaN is not


def percent(value: float | None, low: Any = None, high: Any = None, digits: int = 1) -> Shown:
    """Write a share and its interval in percent; nothing where it is unknown.

    Args:
        value: The share, 0 to 1; None where it is unknown.
        low: Lower end of its interval, 0 to 1; None leaves the interval out.
        high: Upper end.
        digits: Digits after the point.
    """
    if not _known(value):
        return None
    ends = ""
    if _known(low):
        ends = f"{100 * low:.{digits}f}, {100 * high:.{digits}f}"
    return Figures(f"{100 * (value or 0.0):.{digits}f} %", ends)


def _rate(row: Record) -> Shown:
    """Write a rate with its count and interval: ``4/5 = 80.0 % [37.6, 96.4]``."""
    if not _known(row["rate"]):
        return f"undefined: {row['why undefined']}"
    shown = percent(row["rate"], row["low"], row["high"])
    if not _known(row["k"]):
        return f"{shown} (no n)"
    return replace(shown, count=f"{row['k']}/{row['n']}") if isinstance(shown, Figures) else shown


def _each(frame: "pd.DataFrame", write: Callable[[Record], Shown]) -> list[Shown]:
    return [write(row) for row in frame.to_dict("records")]


def _words(column: "pd.Series[Any]") -> "pd.Series[Any]":
    return column.str.replace("_", " ")


def _success(frame: "pd.DataFrame") -> "pd.DataFrame":
    """Put the sides of a group beside each other."""
    sides = list(dict.fromkeys(frame["side"]))
    (gap,) = (name for name in frame.columns if name.startswith("sim - "))
    groups = frame[frame["side"] == sides[0]].reset_index(drop=True)
    shown = groups[["task", "condition", "policy", "unit"]].copy()
    shown["condition"] = _words(shown["condition"])
    if set(shown["unit"]) == {"trial"}:
        shown["unit"] = None  # as everybody counts
    for side in sides:
        shown[side] = _each(frame[frame["side"] == side], _rate)
    shown[gap] = groups[gap]
    return shown


def _points(value: float, row: Record) -> Figures:
    """Write percentage points with the interval that stands in the row."""
    ends = f"{row['low']:+.1f}, {row['high']:+.1f}" if _known(row["low"]) else ""
    return Figures(f"{value:+.1f} pp", ends)


def _gain(row: Record) -> Shown:
    if not _known(row["gain (pp)"]):
        return f"undefined: {row['why undefined']}"
    return _points(row["gain (pp)"], row)


def _relative(row: Record) -> Shown:
    if not _known(row["relative gain"]):
        return f"undefined: {row['why undefined']}"
    return Figures(f"{100 * row['relative gain']:+.1f} %")


def _gains(frame: "pd.DataFrame") -> "pd.DataFrame":
    tasks = [
        ", ".join(part for part in (task, policy) if part)
        for task, policy in zip(frame["task"], frame["policy"], strict=True)
    ]
    shown = frame[["task", "side"]].assign(task=tasks)
    shown["percentage points"] = _each(frame, _gain)
    shown["relative gain"] = _each(frame, _relative)
    return shown


def _layout(frame: "pd.DataFrame") -> "pd.DataFrame":
    for name in frame.columns[2:]:
        frame[name] = [percent(value) or "undefined" for value in frame[name]]
    return frame


def _curve(frame: "pd.DataFrame") -> "pd.DataFrame":
    rates = _each(frame, lambda row: percent(row["rate"], row["low"], row["high"]))
    shown = frame.drop(columns=["rate", "low", "high", "interval"])
    return shown.rename(columns={"k": "succeeded", "n": "of"}).assign(rate=rates)


def _varied(frame: "pd.DataFrame") -> "pd.DataFrame":
    shown = frame[["task", "condition", "policy"]].copy()
    shown["condition"] = _words(shown["condition"])
    shown["sim"] = _each(frame, lambda row: f"{row['sim k']}/{row['sim n']}")
    shown["sim, fresh seeds"] = _each(
        frame,
        lambda r: f"{100 * r['rate with fresh seeds']:.1f} % (n = {r['trials with fresh seeds']})",
    )
    shown["difference (pp)"] = frame["difference (pp)"]
    return shown


def _clauses(frame: "pd.DataFrame") -> "pd.DataFrame":
    """Write both shares of a clause, and ``any`` for the price of one that refused no good plan."""

    def share(name: str, k: str, n: str) -> list[Shown]:
        def write(row: Record) -> Shown:
            shown = percent(row[name], row[f"{name} low"], row[f"{name} high"], digits=0)
            if isinstance(shown, Figures):
                return replace(shown, count=f"{row[k]}/{row[n]}")
            return shown

        return _each(frame, write)

    def price(row: Record) -> Shown:
        price: float | None = row["pays up to a price of"]
        return "any" if not _known(price) and row["refused and failed"] else price

    shown = frame[["verdict of", "clause", "trials", "refused", "refused and failed"]].copy()
    shown["right to refuse"] = share("right", "refused and failed", "refused")
    shown["good plans refused"] = frame["good plans refused"]
    shown["failures it found"] = share("found", "refused and failed", "failed")
    shown["pays up to a price of"] = _each(frame, price)
    return shown


def _conclusions(frame: "pd.DataFrame") -> "pd.DataFrame":
    """Put the bias and its interval into one cell, and a yes beside those that were right."""

    def right(row: Record) -> Shown:
        if not row["yes"]:
            return None
        return Figures(f"{row['yes and right']} of {row['yes']}")

    def succeeded(row: Record) -> Shown:
        return Figures(f"{row['succeeded']} of {row['trials']}") if row["yes"] else None

    def points(name: str) -> list[Shown]:
        return [Figures(f"{value:.0f}") if _known(value) else None for value in frame[name]]

    shown = frame[["task", "groups"]].copy()
    shown["bias"] = [
        _points(value, row) if _known(value) else None
        for value, row in zip(frame["bias (pp)"], frame.to_dict("records"), strict=True)
    ]
    shown["interval"] = frame["interval"]
    shown["yes and right"] = _each(frame, right)
    shown["succeeded at all"] = _each(frame, succeeded)
    for name in ("candidates", "best recorded", "ranked", "more trials"):
        shown[name] = frame[name]
    shown["trials each"] = frame["recorded trials per candidate"]
    for name in ("smallest difference (pp)", "smallest bias (pp)"):
        shown[name] = points(name)
    return shown


def _baselines(frame: "pd.DataFrame") -> "pd.DataFrame":
    def share(k: str, n: str) -> list[Shown]:
        def write(row: Record) -> Shown:
            if not row[n]:
                return None
            return Figures(f"{100 * row[k] / row[n]:.0f} %", count=f"{row[k]}/{row[n]}")

        return _each(frame, write)

    def difference(row: Record) -> Shown:
        if not _known(row["twin more right (pp)"]):
            return None
        return _points(row["twin more right (pp)"], row)

    shown = frame[["asked of", "task", "forecast by"]].copy()
    shown["right"] = share("right", "trials")
    shown["PPV"] = share("yes and succeeded", "said yes")
    shown["NPV"] = share("no and failed", "said no")
    shown["twin more right"] = _each(frame, difference)
    return shown


def _stopping(frame: "pd.DataFrame") -> "pd.DataFrame":
    def interval(row: Record) -> Shown:
        if not _known(row["low"]):
            return None
        return f"[{100 * row['low']:.1f}, {100 * row['high']:.1f}] %"

    def advice(row: Record) -> Shown:
        if not _known(row["low"]):
            return str(row["why undefined"])
        return f"stop: {row['answer']} {100 * row['goal']:g} %" if row["stop"] else "continue"

    shown = frame[["task", "condition", "policy", "trials"]].copy()
    shown["condition"] = _words(shown["condition"])
    shown["interval at any time"] = _each(frame, interval)
    shown["advice"] = _each(frame, advice)
    shown["more trials at this rate"] = frame["more trials at this rate"]
    return shown


def _bands(frame: "pd.DataFrame") -> "pd.DataFrame":
    name = "inside the recorded band"
    if name in frame:  # the other tables of bands hold lengths alone
        frame[name] = [percent(value, digits=0) for value in frame[name]]
    return frame


def _without_task(frame: "pd.DataFrame") -> "pd.DataFrame":
    frame["Pearson r"] = _each(
        frame,
        lambda row: (
            row["Pearson r"] if _known(row["Pearson r"]) else f"undefined: {row['why undefined']}"
        ),
    )
    return frame.drop(columns="why undefined")


def _states(frame: "pd.DataFrame") -> "pd.DataFrame":
    def interval(row: Record) -> Shown:
        known = _known(row["low (mm)"])
        return f"[{row['low (mm)']:.1f}, {row['high (mm)']:.1f}]" if known else None

    at = frame.columns.get_loc("low (mm)")
    ends = _each(frame, interval)
    frame = frame.drop(columns=["low (mm)", "high (mm)"])
    frame.insert(at, "interval (mm)", ends)
    return frame


def _published(frame: "pd.DataFrame") -> "pd.DataFrame":
    def recomputed(row: Record) -> Shown:
        value = row["recomputed"]
        if not _known(value):
            return str(row["instead"])
        return f"{value:.4g}" if abs(value) < 1 else f"{value:.2f}"

    frame["recomputed"] = _each(frame, recomputed)
    return frame.drop(columns="instead")


def _axes(frame: "pd.DataFrame") -> "pd.DataFrame":
    """Put the agreement and the gap of each value of an axis into one cell each."""
    word = next(name for name in frame.columns if name.endswith(" rate") and name[:3] != "sim")
    gap = next(name for name in frame.columns if name.startswith("sim - "))

    def agree(row: Record) -> Shown:
        shown = percent(row["agree rate"], row["agree low"], row["agree high"], digits=0)
        if isinstance(shown, Figures):
            return replace(shown, count=f"{row['agree k']}/{row['agree n']}")
        return shown

    def points(row: Record) -> Shown:
        if not _known(row[gap]):
            return None
        return _points(row[gap], {"low": row["gap low"], "high": row["gap high"]})

    shown = frame[["axis", "value", "trials"]].assign(agree=_each(frame, agree))
    for name in (word, "sim rate"):
        shown[name] = [percent(value, digits=0) for value in frame[name]]
    return shown.assign(**{gap: _each(frame, points)})


def _progress(frame: "pd.DataFrame") -> "pd.DataFrame":
    gap = next(name for name in frame.columns if name.startswith("sim - "))

    def difference(row: Record) -> Shown:
        if not _known(row[gap]):
            return None
        ends = f"{row['low']:+.2f}, {row['high']:+.2f}" if _known(row["low"]) else ""
        return Figures(f"{row[gap]:+.3f}", ends)

    shown = frame.drop(columns=["low", "high"])
    shown[gap] = _each(frame, difference)
    for name in shown.columns:
        if name.endswith((" mean", " of pairs")):
            shown[name] = [round(x, 3) if _known(x) else None for x in shown[name]]
    return shown


_VIEWS: dict[str, Callable[["pd.DataFrame"], "pd.DataFrame"]] = {
    "conclusions": _conclusions,
    "success": _success,
    "axes": _axes,
    "progress": _progress,
    "gains": _gains,
    "layout": _layout,
    "success_curve": _curve,
    "sim_varied": _varied,
    "gate_baselines": _baselines,
    "gate_clauses": _clauses,
    "stopping": _stopping,
    "bands": _bands,
    "leave_one_task_out": _without_task,
    "final_states": _states,
    "published": _published,
}
"""By table; the others are printed as they are."""
