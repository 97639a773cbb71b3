"""Labels by raters who see neither the twin nor each other, and none of which is ever lost."""

import json
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import quote

import pytest
from serving import judged
from visible import words

from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.exchange import reviews
from dashboards.guard import Admission
from dashboards.label_page import OPERATOR, next_trial, rater_name, trials_to_label
from dashboards.label_routes import MAX_BODY

ANN = "/label?rater=Ann"


def label(trial: str = "trial_0001", result: str = "success", **more: object) -> dict[str, object]:
    return {"trial_id": trial, "seen": "", "result": result, **more}


@pytest.fixture
def pages(copy: RunFolder, synthetic: ModuleType) -> Any:
    return synthetic.browser_of(copy)


def test_a_label_is_on_disk_as_the_evaluator_reads_it(pages: Any, copy: RunFolder) -> None:
    answer = pages.post(ANN, json=label(result="failure", cause="dropped it", note="é", flag=True))
    assert answer.status_code == 200
    (kept,) = reviews.read_reviews(copy.path / "reviews")
    assert (kept.trial_id, kept.rater, kept.success) == ("trial_0001", "Ann", False)
    assert kept.says == ("failure", "dropped it", "é", True)
    assert kept.time.endswith("Z")
    assert answer.json()["next"] != "trial_0001"
    assert pages.post(ANN, json=label(cause="dropped it", seen=answer.json()["version"])).json()[
        "saved"
    ]["cause"] == ("")  # a success has none


def test_nothing_that_anybody_else_said_changes_what_a_rater_sees(
    tmp_path: Path, synthetic: ModuleType
) -> None:
    """The law of blindness: two runs that differ only in what others said give the same bytes."""
    sides = {  # recorded and twin, trial by trial: another one is the worst on each side
        "a": ((True, False), (True, True), (False, False)),
        "b": ((False, False), (True, True), (False, True)),
    }
    shown = []
    for side, outcomes in sides.items():
        run = RunFolder.create(tmp_path / side / "run")
        for number, (recorded, twin) in enumerate(outcomes, start=1):
            trial = synthetic.Trial(
                id=f"trial_000{number}",
                condition="with_replanning" if recorded else "without_replanning",
                start_id="s1",
                recorded=recorded,
                planned=twin,
            )
            synthetic.write_trial(run, trial)
            synthetic.write_replay(run, trial, "planned", twin)
            heard = "success" if recorded else "failure"
            other = reviews.Review(
                trial_id=trial.id, rater="Bob", result=heard, note=heard, flag=recorded
            )
            other.write(run.path)
        browser = synthetic.browser_of(run)
        seen = []
        for at in ("", *(f"&at=trial_000{number}" for number in (1, 2, 3))):
            page = browser.get(f"{ANN}{at}", follow_redirects=True)
            assert page.status_code == 200
            seen.append(page.text.replace(str(tmp_path / side), ""))
        for number in (1, 2, 3):
            answer = browser.post(ANN, json=label(f"trial_000{number}")).json()
            seen.append((answer["next"], answer["saved"]["result"]))
        shown.append(seen)
    assert shown[0] == shown[1]
    assert "Bob" not in str(shown)


def test_each_rater_has_an_order_of_their_own_over_the_same_trials(shared_run: RunFolder) -> None:
    judgement = judged(shared_run)
    orders = {name: trials_to_label(judgement, name) for name in ("Ann", "Bob", "Cleo", "Di")}
    assert len({tuple(order) for order in orders.values()}) > 1
    assert len({frozenset(order) for order in orders.values()}) == 1
    assert orders["Ann"] == trials_to_label(judgement, "Ann")


def test_what_nobody_labelled_comes_next_and_then_what_only_others_did() -> None:
    def said(rater: str, *trials: str, result: str = "success") -> list[reviews.Review]:
        return [reviews.Review(trial_id=name, rater=rater, result=result) for name in trials]

    order = ["a", "b", "c", "d"]
    assert next_trial(order, said("Ann", "b"), "Ann", "a") == "c"
    assert next_trial(order, said("Ann", "b", "c", "d"), "Ann", "b") == "a"
    assert next_trial(order, said("Bob", "a", "b"), "Ann") == "c"
    assert next_trial(order, said("Bob", "a", "b"), "Ann", "d") == "c"
    assert next_trial(order, [*said("Bob", *"abcd"), *said("Ann", "a")], "Ann") == "b"
    assert next_trial(order, said("Bob", "a", result="unrated"), "Ann") == "a"
    assert next_trial(["a"], said("Ann", "a"), "Ann") is None


def test_the_second_of_two_tabs_is_told_and_may_replace(pages: Any, copy: RunFolder) -> None:
    first = pages.post(ANN, json=label(result="failure", cause="collision"))
    late = pages.post(ANN, json=label(result="success"))
    assert late.status_code == 409
    assert "changed elsewhere" in late.json()["message"]
    assert late.json()["saved"]["cause"] == "collision"
    assert late.json()["version"] == first.json()["version"]
    assert reviews.read_reviews(copy.path / "reviews")[0].result == "failure"
    # The same answer once more is no conflict: a page asks again when it heard nothing.
    again = pages.post(ANN, json=label(result="failure", cause="collision"))
    assert (again.status_code, again.json()["version"]) == (200, first.json()["version"])
    replaced = pages.post(ANN, json=label(result="success", seen=late.json()["version"]))
    assert replaced.status_code == 200
    assert reviews.read_reviews(copy.path / "reviews")[0].result == "success"


def test_of_many_who_save_at_once_one_wins_and_the_others_are_told(tmp_path: Path) -> None:
    start = threading.Barrier(8)

    def save(number: int) -> bool:
        start.wait()
        review = reviews.Review(trial_id="t", rater="Ann", note=str(number))
        try:
            reviews.save_review(tmp_path, "t", "Ann", review, seen="")
        except reviews.ReviewConflictError:
            return False
        return True

    with ThreadPoolExecutor(8) as pool:
        won = list(pool.map(save, range(8)))
    assert sum(won) == 1
    (kept,) = reviews.read_reviews(tmp_path / "reviews")
    assert kept.note == str(won.index(True))
    assert len(list((tmp_path / "reviews").iterdir())) == 1


def test_undo_brings_back_what_was_there_even_nothing(pages: Any, copy: RunFolder) -> None:
    first = pages.post(ANN, json=label(result="failure", note="hm")).json()
    second = pages.post(ANN, json=label(result="success", seen=first["version"])).json()
    back = pages.post(
        ANN, json=label(**{**first["saved"], "seen": second["version"], "time": "ignored"})
    ).json()
    assert (back["saved"]["result"], back["saved"]["note"]) == ("failure", "hm")
    gone = pages.post(ANN, json=label(result=None, seen=back["version"]))  # type: ignore[arg-type]
    assert gone.json()["saved"] is None
    assert gone.json()["next"] is not None
    assert reviews.read_reviews(copy.path / "reviews") == []


def test_a_flag_without_an_answer_is_no_label(pages: Any, copy: RunFolder) -> None:
    pages.post(ANN, json=label(result="unrated", flag=True, note="look again"))
    shown = words(pages.get("/label").text)
    assert "Ann 0 4" in shown
    assert "look again" not in shown
    assert "⚑ look again" in words(pages.get("/label?show=1").text)


def test_notes_are_held_back_until_everybody_is_done(pages: Any) -> None:
    for rater, last in (("Ann", 5), ("Bob", 4)):
        for number in range(1, last):
            result = "success" if number % 2 else "failure"
            body = label(f"trial_000{number}", result, note=f"says {rater}")
            assert pages.post(f"/label?rater={rater}", json=body).status_code == 200
    held = words(pages.get("/label").text)
    assert "Bob has trials left" in held
    assert "says Ann" not in held
    assert "says Ann" not in words(pages.get(ANN).text)
    assert "says Ann" in words(pages.get("/label?show=1").text)
    pages.post("/label?rater=Bob", json=label("trial_0004"))
    assert "says Ann" in words(pages.get("/label").text)
    assert "All 4 trials are labelled" in words(pages.get(ANN).text)


def test_a_label_from_a_table_is_shown_to_its_rater_and_can_be_replaced(
    pages: Any, copy: RunFolder
) -> None:
    (copy.path / "reviews").mkdir()
    table = "trial_id,rater,time,result,note\ntrial_0001,Ann,2026-01-01,fail,from a table\n"
    (copy.path / "reviews" / "ann.csv").write_text(table)
    page = pages.get(f"{ANN}&at=trial_0001").text
    assert 'data-result="failure"' in page
    assert "from a table" in page
    assert pages.post(ANN, json=label(result="success")).status_code == 200
    assert [r.result for r in reviews.read_reviews(copy.path / "reviews")] == ["success"]


def test_a_broken_label_file_is_named_and_hides_no_other(pages: Any, copy: RunFolder) -> None:
    pages.post(ANN, json=label())
    (copy.path / "reviews" / "broken.json").write_text("{")
    assert "broken.json" in words(pages.get("/label").text)
    found, problems = reviews.readable_reviews(copy.path)
    assert ([r.rater for r in found], len(problems)) == (["Ann"], 1)


@pytest.mark.parametrize(
    ("options", "status"),
    [
        ({"headers": {"Origin": "http://evil.example"}}, 403),
        ({"headers": {"Origin": "null"}}, 403),
        ({"headers": {"Origin": ""}}, 403),
        ({"headers": {"Origin": "http://127.0.0.1:8601"}}, 403),
        ({"headers": {"Host": "evil.example", "Origin": "http://evil.example"}}, 400),
        ({"json": label("trial_9999")}, 404),
        ({"json": label("../episodes/trial_0001")}, 404),
        ({"json": label(result="maybe")}, 400),
        ({"json": label(flag="yes")}, 400),
        ({"json": label(note="x" * 5000)}, 400),
        (
            {
                "content": json.dumps(label(note="\ud800")).encode(),
                "headers": {"Content-Type": "application/json"},
            },
            400,
        ),
        ({"json": label(seen=3)}, 400),
        ({"json": [label()]}, 400),
        ({"content": b"{", "headers": {"Content-Type": "application/json"}}, 400),
        ({"content": b"{}", "headers": {"Content-Type": "text/plain"}}, 415),
        ({"content": b" " * (MAX_BODY + 1), "headers": {"Content-Type": "application/json"}}, 413),
    ],
)
def test_what_is_no_label_of_this_page_changes_nothing(
    pages: Any, copy: RunFolder, options: dict[str, Any], status: int
) -> None:
    body = {} if {"json", "content"} & options.keys() else {"json": label()}
    assert pages.post(ANN, **body, **options).status_code == status
    assert reviews.readable_reviews(copy.path) == ([], [])


def test_without_the_token_nothing_is_written(copy: RunFolder, synthetic: ModuleType) -> None:
    admission = Admission(host="0.0.0.0", token="secret")
    browser = synthetic.browser_of(copy, admission=admission)
    assert browser.post(ANN, json=label()).status_code == 403
    cookie = {"Cookie": "robot_gst_token=secret"}
    assert browser.post(ANN, json=label(), headers=cookie).status_code == 200


@pytest.mark.parametrize("name", ["", " ", "a\nb\x00", "x" * 81, OPERATOR])
def test_a_name_that_no_rater_can_have_is_refused(name: str, pages: Any) -> None:
    with pytest.raises(UsageError):
        rater_name(name)
    answer = pages.get(f"/label?rater={quote(name)}")
    assert answer.status_code == 200
    assert "Start labelling" in answer.text
    assert pages.post(f"/label?rater={quote(name)}", json=label()).status_code == 400
