"""How a number is written: value, count and interval in one unit, said once."""

import re
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from evaluator.compare import compare_csv
from evaluator.compare.policies import ALL_TASKS
from evaluator.report.front import answer, front, next_trials, sentence
from evaluator.report.page import page
from evaluator.report.wording import measurement_text
from evaluator.report.write import summary_text, write_report
from evaluator.result import Interval, Measurement, Results, Table

PAPER = Path(__file__).resolve().parents[3] / "docs" / "examples" / "paper_table_rates.csv"


def measurement(name: str, value: float, unit: str, low: float, high: float) -> Measurement:
    interval = Interval(low=low, high=high, level=0.95, method="wilson")
    k, n = (5, 6) if unit == "1" else (None, 6)
    return Measurement(
        id=name, value=value, unit=unit, definition="d", interval=interval, k=k, n=n,
        counted="group",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("shown", "text"),
    [
        (("x", 5 / 6, "1", 0.436, 0.97), "5/6 = 83.3 % [43.6, 97.0]"),
        (("agreement.bias_pp", 12.0, "pp", -1.0, 25.0), "+12.0 pp (n = 6 groups) [-1.0, +25.0]"),
        (("agreement.mae_pp", 12.0, "pp", 3.0, 25.0), "12.0 pp (n = 6 groups) [3.0, 25.0]"),
        (("x", 0.0123, "m", 0.01, 0.02), "12.30 mm (n = 6 groups) [10.00, 20.00]"),
    ],
)
def test_a_number_says_its_unit_once_and_its_interval_in_it(
    shown: tuple[str, float, str, float, float], text: str
) -> None:
    written = measurement_text(measurement(*shown))
    assert written == f"{text} (95 % Wilson)"


@pytest.mark.parametrize(("value", "text"), [(1e300, "1e+300"), (1.25e8, "1.25e+08")])
def test_numbers_nobody_reads_digit_by_digit_are_short(value: float, text: str) -> None:
    assert measurement_text(Measurement(id="x", value=value, unit="1", definition="d")) == text


def test_the_first_page_says_what_it_means_in_few_words() -> None:
    """On the paper's table and on the widest published one: at most 700 words before a click."""
    published = PAPER.parents[2] / "datasets" / "published" / "worldgym_bridge.csv"
    for path in (PAPER, published):
        results = compare_csv(path).results()
        first = front(results)
        assert first.answers
        assert first.tasks
        text = re.sub(r"<nav.*?</nav>|<style.*?</style>", " ", page(results), flags=re.S)
        while "<details" in text:
            text = re.sub(r"<details(?:(?!<details).)*?</details>", " ", text, flags=re.S)
        words = re.sub(r"<[^>]+>", " ", text).split()
        assert 60 < len(words) <= 700


def row(**values: Any) -> dict[str, Any]:
    return dict.fromkeys(("bias (pp)", "low", "high", "yes", "yes and right")) | values


@pytest.mark.parametrize(
    ("values", "text"),
    [
        (
            {"bias (pp)": 12.2, "low": 3.4, "high": 21.6, "yes": 18, "yes and right": 16},
            "bias +12 points [+3, +22]: the twin is optimistic; when the twin predicted success it "
            "was right 16 of 18.",
        ),
        (
            {"bias (pp)": -9.0, "low": -20.0, "high": -1.2},
            "bias -9 points [-20, -1]: the twin is pessimistic.",
        ),
        (
            {"bias (pp)": 2.0, "low": -5.0, "high": 9.0},
            "bias +2 points; interval [-5, +9] includes 0.",
        ),
    ],
)
def test_a_task_is_summed_up_in_one_sentence(values: dict[str, Any], text: str) -> None:
    assert sentence(row(**values)) == text


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (-4.0, 4.0, "yes"),
        (1.0, 10.0, "yes"),  # a bias that is there and small
        (1.0, 11.0, "not for this"),
        (-30.0, -2.0, "not for this"),
        (-30.0, 4.0, "not yet"),
        (None, None, "not yet"),
    ],
)
def test_a_rate_is_trusted_where_the_whole_interval_of_the_bias_is_small(
    low: float | None, high: float | None, expected: str
) -> None:
    assert answer(row(low=low, high=high)) == expected


def test_the_comparison_that_the_fewest_trials_decide_is_worth_running_next() -> None:
    def compared(task: str, first: str, decided: str, more: int | None) -> tuple[Any, ...]:
        return "undecided: ...", task, first, "B", decided, more

    columns = ("answer", "task", "first", "second", "decided", "more trials of each")
    rows = [
        compared(ALL_TASKS, "A", "no", 40),
        compared(ALL_TASKS, "C", "no", 1),
        compared(ALL_TASKS, "D", "better", 0),
        compared(ALL_TASKS, "E", "no", None),
        compared("pour", "A", "no", 1),
    ]
    table = Table(id="comparisons", title="t", columns=columns, rows=tuple(rows))
    results = Results(run="r", source="trials", stand_in=None, tables=(table,))
    words = "make 1 more trial of C and 1 of B; if the rates stay as seen, that is likely to tell "
    assert next_trials(results) == f"{words}these two apart; undecided then, too: A against B."
    made = Measurement(id="rate.recorded.a", value=0.5, unit="1", definition="d", k=1, n=2)
    few = replace(table, rows=(compared(ALL_TASKS, "A", "no", 4),))
    told = next_trials(replace(results, tables=(few,), measurements=(made,)))
    assert told.startswith("take A or B: each may be best; if the rates stay as seen, to tell them")
    assert "about 8 more trials" in told
    in_tasks = replace(
        table, rows=(rows[0], *(compared(t, "A", "no", 9) for t in ("pour", "stir")))
    )
    of_tasks = next_trials(replace(results, tables=(in_tasks,)))
    assert of_tasks.startswith("make 20 more trials of A and 20 of B on each of 2 tasks: pour")
    opposed = replace(table, rows=(compared("x", "A", "better", 0), compared("y", "A", "worse", 0)))
    assert "for each task one that was not beaten" in next_trials(
        replace(results, tables=(opposed,))
    )
    assert "Not beaten: B on x; A on y." in " ".join(
        map(": ".join, front(replace(results, tables=(opposed,))).answers)
    )
    decided = replace(table, rows=tuple(rows[2:]))
    assert next_trials(replace(results, tables=(decided,))) == ""
    beaten = Table(
        id="standing",
        title="t",
        columns=("candidate", "k", "n", "may be best"),
        rows=(("C", 1, 9, "no"), ("A", 8, 9, "yes"), ("B", 8, 9, "yes")),
    )
    assert "of A and 40 of B" in next_trials(replace(results, tables=(table, beaten)))
    round_ = replace(beaten, rows=tuple((name, 5, 9, "no") for name in "ABC"))
    told = dict(front(replace(results, tables=(round_,))).answers)["Which is better"]
    assert told == "Each of 3 candidates lost to another: none is the best."
    pair = [compared(ALL_TASKS, "A, without replanning", "no", 9)]
    pair[0] = (*pair[0][:3], "A, with replanning", *pair[0][4:])
    next_step = next_trials(replace(results, tables=(replace(table, rows=tuple(pair)),)))
    assert next_step.startswith(
        "make 9 more trials without replanning and 9 with replanning, all A;"
    )


def shown(tmp_path: Path, text: str) -> tuple[str, str]:
    """The first page and the terminal of a table."""
    path = tmp_path / "table.csv"
    path.write_text(text)
    written = write_report(compare_csv(path), tmp_path / "out")
    told = [*map(": ".join, front(written.content).answers), *written.content.missing]
    return " ".join(told), summary_text(written.content, written)


def trusted(tmp_path: Path, sim: tuple[int, ...], n: int) -> str:
    """What the first page says of a twin in ten tasks, of which tenths succeed on the robot."""
    cells = product(range(10), range(2), range(n))
    rows = [f"t{t},p{p},{int(i % 10 < t)},{int(i % 10 < sim[t])}" for t, p, i in cells]
    told = shown(tmp_path, "\n".join(["task,policy,recorded,sim_planned", *rows]))[0]
    return told.partition("Trust the twin: ")[2]


def test_a_twin_is_trusted_only_where_the_numbers_say_so(tmp_path: Path) -> None:
    right, off = tuple(range(10)), (4, 5, 6, 7, 8, 9, 10, 10, 9, 9)
    assert trusted(tmp_path, right, 100).startswith("Yes. In each of these tasks")
    assert trusted(tmp_path, right, 4).startswith("Not yet. ")
    assert trusted(tmp_path, off, 100).startswith("No. ")
    assert trusted(tmp_path, right[::-1], 100).startswith("No. ")
    blind = trusted(tmp_path, (9, *right[1:]), 100)  # in one task it says success throughout
    assert blind.startswith("No. In 2 of 20 groups its rate is far from")
    assert "(t0, p0: 90 against 0 %; t0, p1: 90 against 0 %)" in blind


def test_a_terminal_shows_twelve_of_many_comparisons_the_decided_ones_first(tmp_path: Path) -> None:
    rows = [f"p{k},s{i},{int(k < 6)}" for k in range(7) for i in range(40)]  # the last one fails
    terminal = shown(tmp_path, "\n".join(["policy,start_id,recorded", *rows]))[1]
    found = re.findall(
        r"p(\d) is (?:better|worse)|undecided: p\d", terminal.partition("Who may")[0]
    )
    assert (len(found), sum(map(bool, found))) == (12, 6)
    assert all(found[:6])
    assert "9 more are in the report." in " ".join(terminal.split())


def test_rates_without_n_ask_for_it_and_claim_no_interval(tmp_path: Path) -> None:
    rates = "policy,real,sim\nA,50%,60%\nB,70%,65%\nC,30%,45%\nD,10%,20%\nE,80%,75%\n"
    page_text, terminal = shown(tmp_path, rates)
    assert "Which is better: Cannot be told: the table gives no numbers" in page_text
    assert "a column n" in page_text
    for text in (page_text, terminal):
        assert re.search(r"r .*0\.9", text)
        assert not re.search(r"\[[-+.\d]+, ", text)


def test_tasks_that_are_not_compared_are_not_claimed(tmp_path: Path) -> None:
    told = shown(tmp_path, PAPER.read_text())[0]  # its ducks are counted one by one
    assert "Over the compared tasks (cube_into_box, sloth_into_basket) together: " in told


def test_a_table_without_a_twin_is_told_nothing_about_one(tmp_path: Path) -> None:
    trials = "task,policy,outcome\n" + "".join(
        f"cup,{policy},{int(i < k)}\n" for policy, k in (("A", 3), ("B", 1)) for i in range(4)
    )
    for text in shown(tmp_path, trials):
        for word in ("replay", "verdict", "sim_planned", "agree", "--samples", "gate"):
            assert word not in text, (word, text)
