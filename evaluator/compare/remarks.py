"""What a reader should know before believing a number, said in sentences."""

from collections.abc import Iterable, Sequence

from evaluator.compare.rows import RateCell
from evaluator.result import Measurement, Table

SIGNIFICANT = 0.05
LARGE_BIAS_PP = 5.0
HIGH_R = 0.8
FEW_CELLS = 4

Remark = tuple[str, str]
"""About what, and the sentence."""


def remarks(cells: Sequence[RateCell], measurements: Sequence[Measurement]) -> list[Remark]:
    """Collect what follows from the cells and the numbers alone."""
    by_id = {measurement.id: measurement for measurement in measurements}
    return [
        *_units(cells),
        *_few_cells(by_id),
        *_hidden_bias(by_id),
        *_two_gains(by_id),
        *_power(by_id),
    ]


def remarks_table(found: Iterable[Remark]) -> tuple[Table, ...]:
    """Lay remarks out as a table; none without remarks."""
    rows = tuple(dict.fromkeys(found))
    if not rows:
        return ()
    return (Table(id="remarks", title="Remarks", columns=("about", "remark"), rows=rows),)


def with_remarks(tables: Iterable[Table], found: Iterable[Remark]) -> tuple[Table, ...]:
    """Put remarks before those that are among some tables already."""
    kept, found = list(tables), list(found)
    if not found:
        return tuple(kept)
    old = [(str(a), str(b)) for table in kept if table.id == "remarks" for a, b in table.rows]
    others = [table for table in kept if table.id != "remarks"]
    return (*others, *remarks_table([*found, *old]))


def _units(cells: Sequence[RateCell]) -> list[Remark]:
    found = {cell.task: cell for cell in cells if cell.unit != "trial"}
    remarks = []
    for task, cell in found.items():
        n = cell.recorded.n or cell.sim.n
        count = f" (n = {n})" if n else ""
        remarks.append(
            (
                task,
                f"counted in {cell.unit}s{count}, not in trials: {cell.unit}s of one trial are not "
                "independent, so intervals and tests claim more than the trials justify",
            )
        )
    units = sorted({cell.unit for cell in cells})
    if len(units) > 1:
        words = f"averages and r mix rates counted in {' and in '.join(f'{u}s' for u in units)}"
        remarks.append(("averages", words))
    return remarks


def _few_cells(by_id: dict[str, Measurement]) -> list[Remark]:
    return [
        (name, f"r over {m.n} cells has no interval: few points that rise together give a high r")
        for name, m in by_id.items()
        if name.startswith("agreement.pearson_r")
        and not name.endswith("remeasured")
        and m.value is not None
        and (m.n or 0) < FEW_CELLS
    ]


def _hidden_bias(by_id: dict[str, Measurement]) -> list[Remark]:
    r, bias = by_id.get("agreement.pearson_r"), by_id.get("agreement.bias_pp")
    if r is None or bias is None or r.value is None or bias.value is None:
        return []
    if r.value < HIGH_R or abs(bias.value) < LARGE_BIAS_PP:
        return []
    said = "optimistic" if bias.value > 0 else "pessimistic"
    text = f"r = {r.value:.3f} does not show that the twin is {said} by {bias.value:+.1f} pp"
    return [("agreement.pearson_r", text)]


def _two_gains(by_id: dict[str, Measurement]) -> list[Remark]:
    points = by_id.get("gain.pp.recorded.average")
    relative = by_id.get("gain.relative.recorded.average")
    if points is None or relative is None or points.value is None or relative.value is None:
        return []
    text = (
        f"{points.value:+.2f} percentage points and {100 * relative.value:+.2f} % relative are the "
        "same recorded gain"
    )
    return [("gain", text)]


def _power(by_id: dict[str, Measurement]) -> list[Remark]:
    found = []
    for name, p in by_id.items():
        if not name.startswith("unpaired.boschloo_p.recorded.") or name.endswith(".pooled"):
            continue
        cell = name.removeprefix("unpaired.boschloo_p.recorded.")
        needed = by_id.get(f"power.trials_needed.recorded.{cell}")
        gain = by_id.get(f"gain.pp.recorded.{cell}")
        if p.value is None or p.value < SIGNIFICANT or gain is None or not gain.value:
            continue  # no gain at all is nothing that more trials would show
        change = "a gain" if gain.value > 0 else "a loss"
        text = (
            f"{p.n} {p.counted}s per condition do not show {change} of {gain.value:+.0f} pp "
            f"(Boschloo p = {p.value:.2f})"
        )
        if needed is not None and needed.value is not None:
            text += f"; {needed.value:.0f} per condition would, with 80 % power"
        found.append((cell.removesuffix(".-"), f"underpowered: {text}"))
    return found
