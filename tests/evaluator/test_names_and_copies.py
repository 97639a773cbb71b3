"""Nothing counts twice and no number stands for another: names, copies, counts, two raters."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.episode.catalogue import label_episode
from bridge.episode.metadata import Outcome
from bridge.errors import InvalidRecordError
from bridge.exchange.reviews import Review, read_reviews
from bridge.exchange.table_text import TableError
from evaluator.compare import compare_csv, compare_run
from evaluator.compare.measure import refuse_alike
from evaluator.compare.raters import with_reviews
from evaluator.errors import AlikeNamesError
from evaluator.measurements import slug
from evaluator.result import Results, Table

HEADER = "trial_id,task,condition,recorded,sim_planned\n"


def reasons(comparison: Any, episode: str) -> str:
    return " | ".join(e.reason for e in comparison.exclusions if e.episode == episode)


@pytest.mark.parametrize(
    ("column", "first", "second"),
    [("task", "cube into box", "cube_into_box"), ("condition", "a/b", "a b")],
)
def test_two_names_of_one_id_are_refused_with_their_rows(
    write_table: Callable[[str], Path], column: str, first: str, second: str
) -> None:
    cells = {"task": "t", "condition": "c"}
    lines = []
    for trial, name in (("x", first), ("y", second)):
        line = {**cells, column: name}
        lines.append(f"{trial},{line['task']},{line['condition']},success,failure")
    path = write_table(HEADER + "\n".join(lines) + "\n")
    with pytest.raises(AlikeNamesError, match=rf"{column} '{first}' \(x\) and '{second}' \(y\)"):
        compare_csv(path)


def test_tasks_in_any_script_keep_their_own_rates(write_table: Callable[[str], Path]) -> None:
    lines = ["a,方块,c,success,success", "b,方块,c,success,success", "c,鸭子,c,failure,success"]
    comparison = compare_csv(write_table(HEADER + "\n".join(lines) + "\n"))
    assert [(c.task, c.recorded.k, c.recorded.n) for c in comparison.groups] == [
        ("方块", 2, 2),
        ("鸭子", 0, 1),
    ]
    comparison.results().to_record()  # the ids fit the schema


@given(st.lists(st.text(min_size=1, max_size=6), min_size=2, max_size=6, unique=True))
def test_names_have_ids_of_their_own_or_are_refused(names: list[str]) -> None:
    ids = {slug(name) for name in names}
    if len(ids) == len(names):
        refuse_alike("task", [(name, name) for name in names])
        return
    with pytest.raises(AlikeNamesError, match="cannot be told apart"):
        refuse_alike("task", [(name, name) for name in names])


@pytest.mark.parametrize("copy", ["a1 (1).mcap", "a1-conflict.mcap", "z.mcap"])
def test_a_copy_of_an_episode_counts_no_trial_twice(six_trials: Any, copy: str) -> None:
    episodes = six_trials.run.episodes_dir
    shutil.copyfile(episodes / "a1.mcap", episodes / copy)
    comparison = compare_run(six_trials.run)
    rate = comparison.results().get("agreement.sim_planned.rate")
    assert (rate.k, rate.n) == (5, 6)
    assert "a1 once more, which a1.mcap is" in reasons(comparison, copy)


def test_a_label_given_afterwards_belongs_to_the_file_named_as_the_episode(six_trials: Any) -> None:
    episodes = six_trials.run.episodes_dir
    shutil.copyfile(episodes / "a1.mcap", episodes / "a1 (1).mcap")  # it comes first by name
    label_episode(six_trials.run, "a1", Outcome(result="failure"))
    row = next(row for row in compare_run(six_trials.run).rows if row.episode == "a1")
    assert row.recorded is False


def test_an_impossible_count_costs_its_own_trial_and_is_named(maker: Any) -> None:
    for name, k in (("t1", 4), ("t2", 5)):
        maker.trial(name, start_id=name)
        label_episode(maker.run, name, Outcome(result="success", unit="object", k=k, n=5))
    maker.trial("t3", start_id="t3", outcome=Outcome(result="success", unit="object", k=7, n=5))
    comparison = compare_run(maker.run)
    rate = comparison.results().get(
        "rate.recorded_object.cube_into_box.without_replanning.scripted"
    )
    assert (rate.k, rate.n) == (9, 10)
    assert "7 of 5 objects, which cannot be" in reasons(comparison, "t3")


def test_every_number_without_an_interval_says_why(everything: Any) -> None:
    paper = Path(__file__).resolve().parents[2] / "docs" / "examples" / "paper_table_rates.csv"
    found: list[Results] = [everything.results(), compare_csv(paper).results()]
    for results in found:
        for m in results.measurements:
            if m.value is not None and m.interval is None:
                assert m.reason_without_interval, m.id
            if m.value is not None:
                assert m.n is not None, m.id
                assert m.counted, m.id


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
