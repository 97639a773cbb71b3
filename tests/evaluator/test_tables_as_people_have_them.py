"""Tables as people have them: what each must be read as, what needs a yes, what is refused.

The expected readings were written before the reader was.
"""

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest

from bridge.errors import BridgeError, UsageError
from bridge.exchange import trials_rates
from bridge.exchange.table_text import TableOptions, read_rows
from evaluator.cli import evaluate
from evaluator.compare.intake import Taken, take
from evaluator.compare.table_words import DoubtfulTableError

YES = TableOptions(yes=True)
Rates = dict[tuple[str, str, str], object]
"""By task, policy and side: (k, n), or the rate where n is not known."""
Trials = list[tuple[str, str, bool | None, bool | None]]
"""Task, policy, recorded and sim of each trial."""


def rates_of(taken: Taken) -> Rates:
    return {
        (r.task, r.policy, r.side): (r.k, r.n) if r.n is not None else r.rate for r in taken.rates
    }


def trials_of(taken: Taken) -> Trials:
    return [(t.task, t.policy, t.recorded, t.sim_planned) for t in taken.trials]


def fractions(task: str, real: str, sim: str, policies: str = "ACT DP") -> Rates:
    """Rates without n, by policy, written as fractions."""
    found: Rates = {}
    for side, texts in (("real", real), ("sim", sim)):
        for policy, text in zip(policies.split(), texts.split(), strict=True):
            found[task, policy, side] = Fraction(text)
    return found


def counts(task: str, real: str, sim: str, policies: str = "ACT DP") -> Rates:
    """Counts by policy, written as 7/10."""
    found: Rates = {}
    for side, texts in (("real", real), ("sim", sim)):
        for policy, text in zip(policies.split(), texts.split(), strict=True):
            k, n = text.split("/")
            found[task, policy, side] = (int(k), int(n))
    return found


READ: dict[str, tuple[str, Rates | Trials]] = {
    "count and percent, in wide brackets, and a dash for not tried": (
        "| Task | Method | Sim Success | Real Success | Gap |\n|---|---|---|---|---|\n"
        "| Gear | A | 74/80 (92.50%) | 13/20 (65.0%) | -27.50 |\n"
        "| Gear | B | 80/80 (100.00%) | 25%（5/20） | -75.00 |\n"
        "| Peg | A | 4/8 (50%) | — | — |\n",
        counts("Gear", "13/20 5/20", "74/80 80/80", "A B") | {("Peg", "A", "sim"): (4, 8)},
    ),
    "tables of one header below each other": (
        "**Open the Box**\n\n| 方法 | Sim (%) | Real (%) |\n|---|---|---|\n| A | 95.8 | 21.5 |\n"
        "| **B** | 84.4 | **82.5** |\n\n**Lift the Lid**\n\n| 方法 | Sim (%) | Real (%) |\n"
        "|---|---|---|\n| A | 80.1 | 29.9 |\n| **B** | 70.0 | **70.6** |\n",
        fractions("Open the Box", "0.215 0.825", "0.958 0.844", "A B")
        | fractions("Lift the Lid", "0.299 0.706", "0.801 0.7", "A B"),
    ),
    "words without blanks between them": (
        "| 方法 | 推理时间 (ms) | 仿真成功率 | 真实世界成功率 |\n|---|---|---|---|\n"
        "| ACT | 225 | 0.48 | 0.69 |\n| DP | 360 | 0.86 | 0.83 |\n",
        fractions("table", "0.69 0.83", "0.48 0.86"),
    ),
    "a first column of another name, and a further side": (
        "Backbone,real_sr_pct,wm_sr_pct\nACT,12.6,10.8\nDP,12.1,12.3\n",
        fractions("table", "0.126 0.121", "0.108 0.123"),
    ),
    "axes of a figure": (
        "task,policy,x_real,y_sim,unit_x\ncup,ACT,0.56,0.28,rate\ncup,DP,0.4,0.5,rate\n",
        fractions("cup", "0.56 0.4", "0.28 0.5"),
    ),
    "a column outcome": (
        "trial_id,task,policy,start_id,outcome\n1,cup,ACT,s1,success\n2,cup,ACT,s2,failure\n",
        [("cup", "ACT", True, None), ("cup", "ACT", False, None)],
    ),
    "pandas index and a column success": (
        ",task,policy,side,success,episode,seed,time\n0,cup,pi0,real,True,0,,2026-03-01\n"
        "1,cup,pi0,real,False,1,,2026-03-01\n2,cup,pi0,sim,True,0,7.0,\n3,cup,pi0,sim,True,1,8.0,\n",
        [("cup", "pi0", True, None), ("cup", "pi0", False, None)]
        + [("cup", "pi0", None, True)] * 2,
    ),
    "wide with percent signs": (
        "policy,real,sim\nACT,50 %,60%\nDP,70%,65 %\n",
        fractions("table", "1/2 7/10", "3/5 13/20"),
    ),
    "wide with decimal commas": (
        "Policy;Real;Sim\nACT;50,0 %;41,7 %\nDP;70,0 %;100,0 %\n",
        fractions("table", "1/2 7/10", "417/1000 1"),
    ),
    "wide with 7/10": (
        "Method,Real-world,Simulation\nACT,7/10,16/20\nDP,3 / 10,9 of 20\n",
        counts("table", "7/10 3/10", "16/20 9/20"),
    ),
    "wide with counts and a column of trials": (
        "policy,trials,real,sim\nACT,10,7,9\nDP,10,3,4\n",
        counts("table", "7/10 3/10", "9/10 4/10"),
    ),
    "two header rows as a spreadsheet saves merged cells": (
        ",Pick cup,,Stack,\nPolicy,Real,Sim,Real,Sim\nACT,7/10,8/10,3/10,5/10\n"
        "DP,5/10,6/10,1/10,2/10\n",
        counts("Pick cup", "7/10 5/10", "8/10 6/10") | counts("Stack", "3/10 1/10", "5/10 2/10"),
    ),
    "side above task": (
        "Policy,Real,,Sim,\n,cup,cube,cup,cube\nACT,7/10,3/10,8/10,5/10\nDP,5/10,1/10,6/10,2/10\n",
        counts("cup", "7/10 5/10", "8/10 6/10") | counts("cube", "3/10 1/10", "5/10 2/10"),
    ),
    "tasks as rows, policies and sides as columns": (
        "Task,ACT real,ACT sim,DP (real),DP (sim)\ncup,7/10,8/10,5/10,6/10\n"
        "cube,3/10,5/10,1/10,2/10\n",
        counts("cup", "7/10 5/10", "8/10 6/10") | counts("cube", "3/10 1/10", "5/10 2/10"),
    ),
    "tasks as columns, sides as rows": (
        "policy,domain,cup,cube\nACT,Real,7/10,3/10\nACT,Sim,8/10,5/10\nDP,Real,5/10,1/10\n"
        "DP,Sim,6/10,2/10\n",
        counts("cup", "7/10 5/10", "8/10 6/10") | counts("cube", "3/10 1/10", "5/10 2/10"),
    ),
    "an average row is no policy": (
        "policy,real,sim\nACT,50%,60%\nDP,70%,80%\nAvg. (all tasks),60%,70%\n",
        fractions("table", "1/2 7/10", "3/5 4/5"),
    ),
    "an average column is no task": (
        ",cup,,Avg.,\npolicy,real,sim,real,sim\nACT,50%,60%,50%,60%\nDP,70%,80%,70%,80%\n",
        fractions("cup", "1/2 7/10", "3/5 4/5"),
    ),
    "a title above the header": (
        "Table 2: success rates,,\n,,\npolicy,real,sim\nACT,50%,60%\nDP,70%,80%\n",
        fractions("table", "1/2 7/10", "3/5 4/5"),
    ),
    "a markdown table": (
        "| Policy | Real | Sim |\n|:---|---:|---:|\n| **ACT** | 50% | **60%** |\n"
        "| DP | 70% | 80% |\n",
        fractions("table", "1/2 7/10", "3/5 4/5"),
    ),
    "German": (
        "Versuch;Aufgabe;Modell;Erfolg\n1;Tasse;ACT;ja\n2;Tasse;ACT;nein\n",
        [("Tasse", "ACT", True, None), ("Tasse", "ACT", False, None)],
    ),
    "French": (
        "Essai;Tâche;Modèle;Succès\n1;tasse;ACT;oui\n2;tasse;ACT;non\n",
        [("tasse", "ACT", True, None), ("tasse", "ACT", False, None)],
    ),
    "ok and nok": (
        "task,policy,result\ncup,ACT,ok\ncup,ACT,NOK\ncup,DP,OK\n",
        [("cup", "ACT", True, None), ("cup", "ACT", False, None), ("cup", "DP", True, None)],
    ),
    "an outcome that nobody knows": (
        "task,policy,success\ncup,ACT,yes\ncup,ACT,n/a\n",
        [("cup", "ACT", True, None), ("cup", "ACT", None, None)],
    ),
    "trial numbers restart for each task": (
        "trial,task,policy,outcome\n1,cup,ACT,1\n2,cup,ACT,0\n1,cube,ACT,1\n2,cube,ACT,1\n",
        [("cup", "ACT", True, None), ("cup", "ACT", False, None)]
        + [("cube", "ACT", True, None)] * 2,
    ),
    "sections named real and sim": (
        "task,policy,trial,success\nReal,,,\ncup,ACT,1,1\ncup,ACT,2,0\nSim,,,\ncup,ACT,1,1\n"
        "cup,ACT,2,1\n",
        [("cup", "ACT", True, None), ("cup", "ACT", False, None)]
        + [("cup", "ACT", None, True)] * 2,
    ),
    "counts and trials of each side": (
        "policy,real successes,real trials,sim successes,sim trials\nACT,7,10,40,50\n"
        "DP,3,10,20,50\n",
        counts("table", "7/10 3/10", "40/50 20/50"),
    ),
    "n in the header": (
        "policy,Real (n=20),Sim (n=100)\nACT,50%,61%\nDP,70%,80%\n",
        counts("table", "10/20 14/20", "61/100 80/100"),
    ),
    "percent with its count": (
        "policy,real,sim\nACT,70 % (7/10),80% (8/10)\nDP,30% (3/10),40% (4/10)\n",
        counts("table", "7/10 3/10", "8/10 4/10"),
    ),
    "a spread beside the value": (
        "policy,real,sim\nACT,0.42 ± 0.03,0.50 ± 0.02\nDP,0.25 +- 0.1,0.75\n",
        fractions("table", "42/100 1/4", "1/2 3/4"),
    ),
    "a missing cell": (
        "policy,real,sim\nACT,7/10,8/10\nDP,-,6/10\n",
        counts("table", "7/10", "8/10", "ACT") | {("table", "DP", "sim"): (6, 10)},
    ),
    "pairs of outcomes trial by trial": (
        "policy,task,real,sim\nACT,cup,1,1\nACT,cup,0,1\nACT,cup,1,0\n",
        [("cup", "ACT", True, True), ("cup", "ACT", False, True), ("cup", "ACT", True, False)],
    ),
    "trials as columns": (
        "policy,task,side,1,2,3\nACT,cup,real,✓,✗,✓\nACT,cup,sim,✓,✓,✓\n",
        [("cup", "ACT", True, None), ("cup", "ACT", False, None), ("cup", "ACT", True, None)]
        + [("cup", "ACT", None, True)] * 3,
    ),
    "a footnote below": (
        "policy,real,sim\nACT,50%,60%\nDP,70%,80%\n* all on Monday,,\n",
        fractions("table", "1/2 7/10", "3/5 4/5"),
    ),
    "a column that nobody asked about": (
        "policy,real,sim,gap,time (s)\nACT,50%,60%,10,31.5\nDP,70%,80%,10,28\n",
        fractions("table", "1/2 7/10", "3/5 4/5"),
    ),
    "spreads in columns of their own": (
        "policy,real,real_std,sim,sim std,sim - real\nACT,0.5,0.01,0.6,0.02,0.1\n"
        "DP,0.7,0.01,0.8,0.02,0.1\n",
        fractions("table", "1/2 7/10", "3/5 4/5"),
    ),
    "restarted numbers beside our own names": (
        "trial_id,task,policy,recorded,sim_planned\n1,cup,ACT,1,0\n1,cube,ACT,1,1\n",
        [("cup", "ACT", True, False), ("cube", "ACT", True, True)],
    ),
    "an outcome beside our own names": (
        "task,policy,outcome,sim_planned\ncup,ACT,1,0\n",
        [("cup", "ACT", True, False)],
    ),
    "a task that is written once for its rows": (
        "task,policy,real,sim\ncup,ACT,7/10,8/10\n,DP,5/10,6/10\ncube,ACT,3/10,5/10\n"
        ",DP,1/10,2/10\n",
        counts("cup", "7/10 5/10", "8/10 6/10") | counts("cube", "3/10 1/10", "5/10 2/10"),
    ),
    "a side beside our own name of the outcome": (
        "trial_id,task,policy,side,recorded\n1,cup,ACT,real,1\n2,cup,ACT,sim,0\n",
        [("cup", "ACT", True, None), ("cup", "ACT", None, False)],
    ),
    "rates of objects with our own names": (
        "task,condition,policy,side,unit,n,rate\nducks,a,p,sim,object,50,0.46\n"
        "ducks,a,p,real,object,50,0.6\n",
        counts("ducks", "30/50", "23/50", "p"),
    ),
    "a name that says sim or real": (
        "experiment,policy,success,trials\ncup_real,ACT,7,10\ncup_sim,ACT,8,10\n",
        {("cup", "ACT", "real"): (7, 10), ("cup", "ACT", "sim"): (8, 10)},
    ),
}

DOUBTED: dict[str, tuple[str, str, Rates | Trials]] = {
    "counts or percent": (
        "policy,trials,real,sim\nACT,20,5,10\nDP,20,15,10\n",
        "counts or percent",
        counts("table", "5/20 15/20", "10/20 10/20"),
    ),
    "one or one percent": (
        "policy,real,sim\nACT,1,0\nDP,0,1\n",
        "0 and 1",
        fractions("table", "1 0", "0 1"),
    ),
    "rate_percent that holds a fraction, with n": (
        "task,policy,side,n,rate_percent\na,ACT,real,10,0.5\na,ACT,sim,20,0.75\n",
        "rate_percent",
        counts("a", "5/10", "15/20", "ACT"),
    ),
    "rates of one side": (
        "policy,cup,cube\nACT,50%,30%\nDP,70%,10%\n",
        "real",
        {
            ("cup", "ACT", "real"): Fraction(1, 2),
            ("cup", "DP", "real"): Fraction(7, 10),
            ("cube", "ACT", "real"): Fraction(3, 10),
            ("cube", "DP", "real"): Fraction(1, 10),
        },
    ),
    "small whole numbers without n": (
        "policy,real,sim\nACT,7,9\nDP,3,4\n",
        "counts",
        fractions("table", "7/100 3/100", "9/100 4/100"),
    ),
    "sides as rows, policies as columns": (
        "metric,ACT,DP\nreal,50%,70%\nsim,60%,80%\n",
        "policies",
        fractions("table", "1/2 7/10", "3/5 4/5"),
    ),
    "seeds as columns": (
        "policy,side,seed 1,seed 2\nACT,real,7/10,8/10\n",
        "'seed 1', 'seed 2'",
        {("seed 1", "ACT", "real"): (7, 10), ("seed 2", "ACT", "real"): (8, 10)},
    ),
    "a policy that may name a side": (
        "policy,success,trials\nACT,7,10\nACT (sim),8,10\n",
        r"'ACT \(sim\)'",
        {("table", "ACT", "real"): (7, 10), ("table", "ACT (sim)", "real"): (8, 10)},
    ),
    "rows that share a name": (
        "colour,real_success,sim_success\npink,0.25,0.5\npink,0.75,0.5\n",
        "rows of one name are read as different policies",
        {
            ("table", "pink row 2", "real"): Fraction(1, 4),
            ("table", "pink row 2", "sim"): Fraction(1, 2),
            ("table", "pink row 3", "real"): Fraction(3, 4),
            ("table", "pink row 3", "sim"): Fraction(1, 2),
        },
    ),
    "columns that may be tasks": (
        "policy,side,cup,hook\nACT,real,0.5,0.3\nACT,sim,0.75,0.25\n",
        "'cup', 'hook'",
        fractions("cup", "1/2", "3/4", "ACT") | fractions("hook", "3/10", "1/4", "ACT"),
    ),
}

REFUSED = {
    "stacked without a word": (
        "trial,task,policy,success\n1,cup,ACT,1\n2,cup,ACT,0\n1,cup,ACT,1\n2,cup,ACT,1\n",
        "row 4: trial_id '1' stands in row 2.*real and sim",
    ),
    "a word that is no answer": ("task,policy,outcome\ncup,ACT,partly\n", "row 2.*'partly'"),
    "two outcomes": ("task,policy,outcome,success\ncup,ACT,1,0\n", "'outcome' and 'success'"),
    "two policies": (
        "method,model,real,sim\nours,ACT,50%,60%\nbase,ACT,70%,80%\n",
        "'method' and 'model'",
    ),
    "no outcome at all": ("trial_id,task,policy\n1,cup,ACT\n", "no column .*outcome"),
    "nothing known": ("a,b\n1,2\n", "neither"),
    "a count that cannot be": ("policy,real,sim\nACT,12/10,8/10\n", "row 2.*12 of 10"),
    "no count and no rate": ("task,n,real\na,10,3\nb,10,12.5\n", r"row 3: '12\.5' is neither"),
    "46 percent of ten": ("policy,n,real,sim\nACT,10,46%,50%\n", "row 2.*0.46 x 10"),
    "percent that is not its count": (
        "policy,real,sim\nACT,80 % (7/10),80% (8/10)\n",
        "row 2.*0.8 is not 7/10",
    ),
    "one policy twice": ("policy,real,sim\nACT,50%,60%\nACT,70%,80%\n", "row 3.*row 2"),
    "a date that was 7/10": ("policy,real,sim\nACT,07-Oct,8/10\nDP,3/10,4/10\n", "row 2.*date"),
    "percent and fractions in one column": (
        "policy,real,sim\nACT,70%,60%\nDP,0.8,80%\n",
        "row 3.*percent",
    ),
    "a side nobody knows": (
        "policy,side,success rate\nACT,real,70%\nACT,moon,80%\n",
        "row 3.*moon",
    ),
    "a side that is missing": (
        "policy,side,success rate\nACT,real,70%\nDP,,80%\n",
        "row 3.*side is ''",
    ),
    "over one hundred": ("policy,real,sim\nACT,110%,60%\nDP,70%,80%\n", "row 2.*110"),
    "fractional counts": ("policy,trials,real,sim\nACT,10,7.5,9\nDP,10,3,4\n", "row 2.*7.5"),
    "a decimal comma that cut a cell in two": ("policy,real,sim\nACT,0,5,0,6\n", "row 2.*5 fields"),
    "a heading between rows": (
        "policy,real,sim\nPick,,\nACT,7/10,8/10\nStack,,\nDP,3/10,4/10\n",
        "row 3.*'Pick'",
    ),
    "two columns of one side": (
        "policy,real,real world,sim\nACT,50%,55%,60%\nDP,70%,75%,80%\n",
        "'real' and 'real world'",
    ),
    "between thousands": ("policy;real;sim\nACT;1,234;2,5 %\n", "1,234"),
}


def write(folder: Path, text: str) -> Path:
    path = folder / "table.csv"
    path.write_bytes(text.encode())
    return path


def check(taken: Taken, expected: Rates | Trials) -> None:
    if isinstance(expected, dict):
        assert rates_of(taken) == expected
    else:
        assert trials_of(taken) == expected


@pytest.mark.parametrize("name", READ)
def test_it_is_read_as_it_is_meant(tmp_path: Path, name: str) -> None:
    text, expected = READ[name]
    check(take(write(tmp_path, text)), expected)


@pytest.mark.parametrize("name", DOUBTED)
def test_a_reading_that_is_not_the_only_one_needs_a_yes(tmp_path: Path, name: str) -> None:
    text, words, expected = DOUBTED[name]
    path = write(tmp_path, text)
    with pytest.raises(DoubtfulTableError, match=f"{words}.*--yes") as caught:
        take(path)
    assert caught.value.exit_code == 2
    check(take(path, YES), expected)


@pytest.mark.parametrize("options", [TableOptions(), YES])
@pytest.mark.parametrize("name", REFUSED)
def test_it_is_refused_with_or_without_a_yes(
    tmp_path: Path, name: str, options: TableOptions
) -> None:
    text, message = REFUSED[name]
    with pytest.raises((BridgeError, UsageError), match=message) as caught:
        take(write(tmp_path, text), options)
    assert not isinstance(caught.value, DoubtfulTableError)


def test_utf_16_is_read_where_it_says_so(tmp_path: Path) -> None:
    path = tmp_path / "table.txt"
    path.write_bytes("policy\treal\tsim\nACT\t7/10\t8/10\n".encode("utf-16"))
    check(take(path), counts("table", "7/10", "8/10", "ACT"))


@pytest.fixture
def write_book(tmp_path: Path) -> Callable[..., Path]:
    openpyxl = pytest.importorskip("openpyxl")

    def build(rows: list[list[object]], merged: tuple[str, ...] = (), percent: str = "") -> Path:
        book = openpyxl.Workbook()
        sheet = book.active
        for row in rows:
            sheet.append(row)
        for cells in merged:
            sheet.merge_cells(cells)
        for row in sheet[percent] if percent else ():
            for cell in row:
                cell.number_format = "0.0%"
        path = tmp_path / "table.xlsx"
        book.save(path)
        return path

    return build


def test_merged_cells_of_a_workbook(write_book: Callable[..., Path]) -> None:
    rows: list[list[Any]] = [
        ["Task", "Policy", "Success", None],
        [None, None, "Real", "Sim"],
        ["cup", "ACT", "7/10", "8/10"],
        [None, "DP", "5/10", "6/10"],
    ]
    path = write_book(rows, ("A1:A2", "B1:B2", "C1:D1", "A3:A4"))
    check(take(path), counts("cup", "7/10 5/10", "8/10 6/10"))


def test_percent_of_a_workbook_are_percent(write_book: Callable[..., Path]) -> None:
    path = write_book([["policy", "real", "sim"], ["ACT", 0.5, 0.01], ["DP", 1, 0.75]], (), "B2:C3")
    check(take(path), fractions("table", "1/2 1", "1/100 3/4"))


def test_a_date_of_a_workbook_is_no_count(write_book: Callable[..., Path]) -> None:
    from datetime import datetime

    path = write_book([["policy", "real", "sim"], ["ACT", datetime(2026, 10, 7), "8/10"]])
    with pytest.raises(BridgeError, match=r"row 2.*date"):
        take(path)


def test_every_rate_of_up_to_forty_trials_is_counted_at_full_precision(tmp_path: Path) -> None:
    """As Python, pandas and 32-bit floats print them, as fractions and as percent."""
    import numpy as np

    cells = [(k, n) for n in range(1, 41) for k in range(n + 1)]
    for write_rate in (
        lambda k, n: f"{k / n!r},",
        lambda k, n: f",{100 * k / n!r}",
        lambda k, n: f",{100 * (k / n)!r}",
        lambda k, n: f"{np.float32(k / n)!s},",
        lambda k, n: f"{k / n:.4f},",
    ):
        lines = [f"{i},real,{n},{write_rate(k, n)}" for i, (k, n) in enumerate(cells)]
        path = write(tmp_path, "\n".join(["task,side,n,rate,rate_percent", *lines]) + "\n")
        rates = trials_rates.rates_of(read_rows(path, ("task", "side"), trials_rates.COLUMNS))
        assert [(r.k, r.n) for r in rates] == cells


def test_what_was_understood_stands_in_one_line(tmp_path: Path) -> None:
    said = take(write(tmp_path, "policy,trials,real,sim,gap\nACT,10,1,3,2\nDP,10,9,10,1\n")).summary
    assert "\n" not in said
    for part in ("2 groups", "real 10 to 90 %", "sim 30 to 100 %", "n from 'trials'", "'gap'"):
        assert part in said


@pytest.mark.parametrize("text", ["trial_id,task,policy\n1,cup,ACT\n", "a,b\n1,2\n"])
def test_nothing_read_ends_with_2(tmp_path: Path, text: str) -> None:
    with pytest.raises(UsageError) as caught:
        evaluate(write(tmp_path, text), out=tmp_path / "out")
    assert caught.value.exit_code == 2
    assert not (tmp_path / "out").exists()


def test_a_column_that_tells_panels_apart_is_their_condition(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    lines = ["panel,task,policy,real,sim,source", "all,cup,ACT,0.56,0.28,figure 3"]
    lines += ["all,cup,DP,0.4,0.5,figure 3", "dark,cup,ACT,0.3,0.2,figure 3"]
    path.write_text("\n".join(lines) + "\n")
    taken = take(path)
    assert [(r.condition, r.policy, float(r.rate)) for r in taken.rates if r.side == "real"] == [
        ("all", "ACT", 0.56),
        ("all", "DP", 0.4),
        ("dark", "ACT", 0.3),
    ]
    assert "first column read as condition" in taken.summary


@pytest.mark.parametrize(
    "head", ["outcome,sim", "success,sim", "success,sim_success", "success,success_sim"]
)
def test_an_outcome_beside_the_twins_is_what_was_recorded(tmp_path: Path, head: str) -> None:
    """Of three the twin and the cell agree on two, by hand."""
    rows = "1,a,success,success\n2,a,failure,success\n3,a,failure,failure\n"
    path = tmp_path / "t.csv"
    path.write_text(f"trial,task,{head}\n{rows}")
    trials = take(path).trials
    assert [trial.recorded for trial in trials] == [True, False, False]
    assert [trial.sim_planned for trial in trials] == [True, True, False]
