"""Two raters of the same trials."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bridge.errors import InvalidRecordError
from bridge.exchange.reviews import Review, read_reviews
from bridge.exchange.table_text import TableError
from evaluator.compare import compare_csv
from evaluator.compare.raters import with_reviews
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
    line = cells({table.id: table for table in found.tables}["raters"])
    a = np.array([i % 2 for i in range(20)])
    b = np.array([(i % 2) != (i < 4) for i in range(20)])
    chance = a.mean() * b.mean() + (1 - a.mean()) * (1 - b.mean())
    assert line["kappa"] == pytest.approx(((a == b).mean() - chance) / (1 - chance))
    assert line["low"] < line["kappa"] < line["high"]
    assert any("1 of trials that are not there (elsewhere)" in text for text in found.missing)
