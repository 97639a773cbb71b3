"""Two twins on the same trials, and two raters of the same trials."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bridge.errors import InvalidRecordError, UsageError
from bridge.exchange.reviews import Review, read_reviews
from bridge.exchange.table_text import TableError
from evaluator.cli import evaluate
from evaluator.compare import compare_csv
from evaluator.compare.against import against_tables
from evaluator.compare.raters import with_reviews
from evaluator.compare.several import with_against
from evaluator.errors import EvaluatorError
from evaluator.result import Table

HEAD = "trial_id,task,start_id,recorded,sim_planned,p_success\n"


def twin(right: int, n: int = 20) -> str:
    """A twin that answers the first trials rightly; half of all trials succeed."""
    lines = []
    for i in range(n):
        real = i % 2
        said = real if i < right else 1 - real
        lines.append(f"t{i},task{i % 4},s{i},{real},{said},{0.9 if said else 0.1}")
    return HEAD + "\n".join(lines) + "\n"


def cells(table: Table, row: int = 0) -> dict[str, Any]:
    return dict(zip(table.columns, table.rows[row], strict=True))


def test_a_better_twin_is_shown_to_be_better_by_the_pairs(tmp_path: Path) -> None:
    good, bad = tmp_path / "good.csv", tmp_path / "bad.csv"
    good.write_text(twin(19))
    bad.write_text(twin(9))
    comparison = with_against(compare_csv(good), good, bad)
    tables = {table.id: table for table in comparison.tables}
    accuracy = cells(tables["against"])
    assert (accuracy["good"], accuracy["bad"], accuracy["trials"]) == (19, 9, 20)
    assert accuracy["difference (pp)"] == pytest.approx(50)
    assert accuracy["low"] > 0
    assert len(tables["flips"].rows) == 10
    assert {row[-3] for row in tables["flips"].rows} == {"good"}
    back = against_tables(compare_csv(bad).rows, compare_csv(good).rows, names=("bad", "good"))
    assert cells(back[0])["difference (pp)"] == pytest.approx(-50)


def test_the_same_twin_twice_shows_no_difference(write_table: Callable[[str], Path]) -> None:
    rows = compare_csv(write_table(twin(15))).rows
    (table,) = against_tables(rows, rows, names=("a", "a"))
    assert cells(table)["difference (pp)"] == 0
    assert cells(table)["low"] < 0 < cells(table)["high"]


def test_two_twins_must_speak_of_the_same_trials(tmp_path: Path) -> None:
    one, other = tmp_path / "one.csv", tmp_path / "other.csv"
    one.write_text(twin(15))
    other.write_text(twin(15).replace("t0,task0,s0,0", "t0,task0,s0,1"))
    with pytest.raises(EvaluatorError, match="t0 succeeded in one and failed in the other"):
        with_against(compare_csv(one), one, other)
    other.write_text(HEAD + "x,y,z,1,1,\n")
    with pytest.raises(EvaluatorError, match="No trial has an outcome and an answer of both"):
        with_against(compare_csv(one), one, other)
    with pytest.raises(UsageError, match="given twice"):
        with_against(compare_csv(one), one, one)


def test_a_run_against_its_copy_has_no_flip(six_trials: Any, tmp_path: Path) -> None:
    run, copy = six_trials.run.path, tmp_path / "copy"
    shutil.copytree(run, copy)
    assert evaluate(run, against=copy, out=tmp_path / "out") == 0
    tables = {
        t["id"] for t in json.loads((tmp_path / "out" / "results.json").read_text())["tables"]
    }
    assert "against" in tables
    assert "flips" not in tables


def test_reviews_are_kept_and_read_in_one_format(tmp_path: Path) -> None:
    first = Review(trial_id="a/1", rater="Ann", time="2026-01-01T10:00:00Z", result="failure")
    later = Review(
        trial_id="a/1", rater="Ann", time="2026-01-02T10:00:00Z", result="success", cause="slip"
    )
    path = first.write(tmp_path)
    assert read_reviews(tmp_path / "reviews") == [first]
    assert later.write(tmp_path) == path
    table = tmp_path / "reviews" / "bob.csv"
    table.write_text("trial_id;rater;time;result;cause\na/1;Bob;2026-01-01;fail;dropped\n")
    assert {(r.rater, r.result) for r in read_reviews(tmp_path / "reviews")} == {
        ("Ann", "success"),
        ("Bob", "failure"),
    }
    table.write_text("trial_id,rater,result\na,,pass\n")
    with pytest.raises(TableError, match="row 2: rater is empty"):
        read_reviews(table)
    path.write_text('{"schema_version": 1, "trial_id": "a", "rater": "Ann", "result": "maybe"}')
    with pytest.raises(InvalidRecordError, match="review"):
        read_reviews(path)


def test_kappa_of_two_raters(write_table: Callable[[str], Path]) -> None:
    comparison = compare_csv(write_table(twin(18)))
    reviews = [
        Review(trial_id=f"t{i}", rater="Ann", result="success" if (i % 2) != (i < 4) else "failure")
        for i in range(20)
    ]
    reviews.append(Review(trial_id="elsewhere", rater="Ann", result="success"))
    found = with_reviews(comparison, reviews)
    tables = {table.id: table for table in found.tables}
    line = cells(tables["raters"])
    a = np.array([i % 2 for i in range(20)])
    b = np.array([(i % 2) != (i < 4) for i in range(20)])
    chance = a.mean() * b.mean() + (1 - a.mean()) * (1 - b.mean())
    assert line["kappa"] == pytest.approx(((a == b).mean() - chance) / (1 - chance))
    assert line["low"] < line["kappa"] < line["high"]
    assert any("1 of trials that are not there (elsewhere)" in text for text in found.missing)
