"""A study is designed and locked before its first trial, carried out, and held against its lock."""

import csv
import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.exchange.trials_csv import trials_path
from bridge.task.protocol import FILE_NAME, Protocol, read_protocol
from evaluator.compare.run import compare_run
from evaluator.design.config import StudyOptions, Wanted
from evaluator.design.plan import ORDER_FILE, Design, design, design_text, lock
from evaluator.result import Results
from evaluator.statistics.sequential import look_pairs

STUDY = StudyOptions(task=("pour", "stack"), any_task=True, policies=("act",), blind=True)
WANTED = Wanted(rate=0.4, gain=0.4)
Line = dict[str, str]


@pytest.fixture(scope="module")
def made() -> Design:
    return design(STUDY, WANTED)


def filled(run: Path, change: Callable[[list[Line]], object] = lambda lines: None) -> Results:
    """Carry a design out: the arm with succeeds in four of five, the other in two of five."""
    protocol = read_protocol(run)
    assert protocol is not None
    arms = {code: name.rpartition(", ")[2] for name, code in protocol.codes.items()}
    lines = list(csv.DictReader(io.StringIO((run / ORDER_FILE).read_text())))
    for line in lines:
        seed = int(line["start_id"].rpartition("/")[2])
        arm = arms.get(line["policy"]) or ("with" if line["condition"] == "with_replanning" else "")
        line["recorded"] = "success" if seed % 5 < (4 if arm == "with" else 2) else "failure"
    change(lines)
    path = trials_path(RunFolder.open(run))
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, fieldnames=list(lines[0]))
        writer.writeheader()
        writer.writerows(lines)
    return compare_run(RunFolder.open(run)).results()


def rows_of(results: Results, name: str) -> list[Line]:
    table = next(table for table in results.tables if table.id == name)
    return [dict(zip(table.columns, map(str, row), strict=True)) for row in table.rows]


def departures(results: Results) -> set[str]:
    return {row["what"] for row in rows_of(results, "protocol_departures")} - {"none"}


def test_a_study_carried_out_as_designed_has_no_departure(tmp_path: Path, made: Design) -> None:
    written = lock(tmp_path, made)
    assert written.sha256
    results = filled(tmp_path)
    assert results.get("protocol.departures").value == 0
    questions = rows_of(results, "comparisons")
    assert [row["task"] for row in questions] == ["all tasks", "pour", "stack"]
    assert questions[0]["decided"] == "better"
    starts = 2 * made.protocol.tasks[0].starts
    assert int(questions[0]["shared starts"]) == starts
    assert float(questions[0]["decided after (pairs)"]) in look_pairs(starts)
    assert questions[0]["answer"].endswith("stop here")


def test_trials_that_name_no_condition_are_of_the_one_arm_there_is(tmp_path: Path) -> None:
    """As episodes are that were imported and labelled."""
    one_arm = replace(STUDY, policies=("act", "pi0"), arms=("without",), blind=False)
    lock(tmp_path, design(one_arm, WANTED))

    def forget(lines: list[Line]) -> None:
        for line in lines:
            line["condition"] = ""
            if line["policy"] == "pi0" and int(line["start_id"].rpartition("/")[2]) % 5 < 4:
                line["recorded"] = "success"

    results = filled(tmp_path, forget)
    assert departures(results) == set()
    assert int(rows_of(results, "comparisons")[0]["shared starts"]) > 0


def leave_blank(lines: list[Line]) -> None:
    lines[0]["recorded"] = ""


def swap(lines: list[Line]) -> None:
    lines[0], lines[-1] = lines[-1], lines[0]


def move_start(lines: list[Line]) -> None:
    for line in lines[:2]:
        line["start_id"] = "pour/77"


def add_policy(lines: list[Line]) -> None:
    lines.append(
        {**lines[-1], "trial_id": "late", "policy": "pi0", "condition": "without_replanning"}
    )


def repeat(lines: list[Line]) -> None:
    lines.append({**lines[-1], "trial_id": "again"})


@pytest.mark.parametrize(
    ("change", "kinds"),
    [
        (leave_blank, {"too few trials"}),
        (swap, {"order"}),
        (move_start, {"other starts", "starts not tried"}),
        (add_policy, {"other policy or arm"}),
        (repeat, {"more trials", "start tried again"}),
    ],
)
def test_every_departure_is_named(
    tmp_path: Path, made: Design, change: Callable[[list[Line]], None], kinds: set[str]
) -> None:
    lock(tmp_path, made)
    assert kinds <= departures(filled(tmp_path, change))


def test_an_edited_protocol_and_another_interval_are_departures(
    tmp_path: Path, made: Design
) -> None:
    lock(tmp_path, replace(made, protocol=replace(made.protocol, interval="jeffreys")))
    path = tmp_path / FILE_NAME
    path.write_text(json.dumps({**json.loads(path.read_bytes()), "alpha": 0.2}))
    assert {"protocol", "analysis"} <= departures(filled(tmp_path))


def test_a_design_is_locked_and_comes_before_the_first_trial(tmp_path: Path, made: Design) -> None:
    lock(tmp_path, made)
    before = (tmp_path / FILE_NAME).read_bytes()
    with pytest.raises(UsageError, match="is locked"):
        lock(tmp_path, made)
    assert (tmp_path / FILE_NAME).read_bytes() == before
    filled(tmp_path)
    (tmp_path / FILE_NAME).unlink()
    with pytest.raises(UsageError, match="holds trials already"):
        lock(tmp_path, made)


def test_the_list_of_a_blinded_operator_names_no_arm(tmp_path: Path, made: Design) -> None:
    lock(tmp_path, made)
    text = (tmp_path / ORDER_FILE).read_text()
    assert "act" not in text
    assert "replanning" not in text
    lock(tmp_path / "open", replace(made, protocol=replace(made.protocol, codes={})))
    assert "act,with_replanning" in (tmp_path / "open" / ORDER_FILE).read_text()


@pytest.mark.parametrize(
    ("study", "wanted", "words"),
    [
        (STUDY, Wanted(), "nothing says how large"),
        (replace(STUDY, arms=("with",)), WANTED, "nothing to compare"),
        (replace(STUDY, arms=("both",)), WANTED, "There are: without, with, control"),
        (replace(STUDY, arms=("without", "with", "control")), WANTED, "needs --coin"),
        (STUDY, Wanted(rate=0.9, gain=0.3), "make 120 %"),
        (STUDY, Wanted(rate=0.5, gain=0.01), "more than 4000"),
        (replace(STUDY, any_task=False), WANTED, "no task named 'pour'"),
    ],
)
def test_what_is_no_design_is_refused(study: StudyOptions, wanted: Wanted, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        design(study, wanted)


def test_policies_are_compared_on_the_same_starts() -> None:
    study = replace(STUDY, policies=("act", "pi0"), arms=("without",))
    primary = design(study, WANTED).protocol.primary
    assert primary is not None
    assert (primary.policy, primary.against_policy) == ("pi0", "act")


def test_the_text_names_the_hash_and_the_command(tmp_path: Path, made: Design) -> None:
    written = lock(tmp_path, made)
    text = design_text(made, written, tmp_path)
    assert written.sha256 in text
    assert f"fill in {ORDER_FILE}, robot-gst open" in text
    assert Protocol.from_json((tmp_path / FILE_NAME).read_bytes()) == made.protocol
