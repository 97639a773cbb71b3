"""The pages say what the evaluator said, survive what is missing, and refuse what is foreign."""

import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from serving import judged
from visible import words

from bridge.episode.run_folder import RunFolder
from dashboards import moments, overview_page
from dashboards.app import create_app
from dashboards.errors import NotHereError
from dashboards.guard import COOKIE, Admission
from dashboards.library import Library, derived_path, episode_path
from dashboards.moments import Moment
from dashboards.overview_page import first_numbers
from dashboards.twin_page import build_twin
from evaluator.report.front import front
from evaluator.report.page import breakable
from evaluator.result import Interval, load_results
from robot_gst import run as type_here


def test_the_overview_shows_the_numbers_of_results_json(
    browser: Any, shared_run: RunFolder
) -> None:
    agreement = load_results(shared_run.path).get("agreement.sim_planned.rate")
    text = words(browser.get("/").text)
    assert f"{agreement.k} of {agreement.n}" in text
    assert "correlation r" not in text  # two groups have none
    assert "PSNR of held-out views, raw" in text
    said = load_results(shared_run.path).get("views.all.psnr_db").definition
    assert said in words(browser.get("/twin").text)  # which frames, and whose depth
    assert "95 % Wilson" in text
    assert "Stand-in cell" in text


def test_numbers_are_found_by_words_of_their_ids_and_definitions(
    browser: Any, shared_run: RunFolder
) -> None:
    known = load_results(shared_run.path).measurements
    wanted = [m.id for m in known if "psnr" in f"{m.id} {m.definition}".lower()]
    assert 0 < len(wanted) < len(known)
    text = browser.get("/numbers", params={"q": "PSNR"}).text
    shown = [m.id for m in known if f"<code>{breakable(m.id)}</code>" in text]
    assert shown == wanted
    assert "<details open>" in text
    assert "No number is called" in browser.get("/numbers?q=psnr+nonsense").text


@pytest.mark.parametrize(
    ("low", "high", "is_first"), [(0.1, 0.9, True), (-0.9, -0.2, True), (-0.9, 1.0, False)]
)
def test_a_correlation_that_may_be_none_is_no_first_number(
    copy: RunFolder, low: float, high: float, is_first: bool
) -> None:
    (old,) = (m for m in judged(copy).measurements if m.id == "agreement.pearson_r")
    interval = Interval(low=low, high=high, level=0.95, method="hand")
    r = replace(old, value=(low + high) / 2, interval=interval, reason_if_undefined=None)
    found: Any = SimpleNamespace(measurements=(r,))
    titles = [name for name, _ in first_numbers(found)]
    assert titles == ["Success rates, correlation r"] * is_first


def test_a_task_is_called_as_its_makers_call_it(copy: RunFolder) -> None:
    old = next(m for m in judged(copy).measurements if m.id.startswith("rate.recorded."))
    rate = replace(old, id="rate.recorded.W+00fcrfel_auf_Block.-.act")
    found: Any = SimpleNamespace(measurements=(rate,))
    assert [name for name, _ in first_numbers(found)] == [
        "Recorded success, Würfel auf Block · act"
    ]


def test_the_first_page_begins_with_the_answer_and_the_worst(
    synthetic: ModuleType, copy: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(overview_page, "not_scanned_in", lambda *_: ["cube", "lid"])
    page = synthetic.browser_of(copy).get("/").text
    seen = words(page)
    answer = dict(front(load_results(copy.path)).answers)["Trust the twin"]
    at = [
        seen.index(part)
        for part in (
            f"Trust the twin? {answer.split('.')[0]}.",
            "No scan saw cube, lid",
            "Worst disagreement: trial_0002",
            "Worst held-out picture",
            "Twin predicts the outcome",
        )
    ]
    assert at == sorted(at)
    assert "First divergence : the cube left the gripper during carry" in seen
    (picture,) = re.findall(r'src="(/failures/picture/[^"]*)"', page)
    assert picture == "/failures/picture/trial_0002"
    found = build_twin(copy, judged(copy)).views[0]  # the worst first
    assert f"PSNR {found.psnr_db:.2f} dB · SSIM {found.ssim:.3f}" in seen
    for side in ("recorded", "rendered"):
        address = f"/twin/{found.file}/{side}/{found.camera}?stamp={found.stamp_ns}"
        assert page.count(address) == 2  # by itself, and in the difference
    (copy.derived_dir / found.file).unlink()
    assert "held-out" not in synthetic.browser_of(copy).get("/").text


def test_a_cause_has_few_words_and_a_trial_without_a_camera_no_picture(
    synthetic: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = RunFolder.create(tmp_path / "run")
    synthetic.write_trial(run, synthetic.TRIALS[1], images=False)
    synthetic.write_replay(run, synthetic.TRIALS[1], "planned", False)
    long = Moment(plan_id="p", t_ns=0, text="a " * 21)
    monkeypatch.setattr(moments, "moment_of", lambda *_: long)
    worst = overview_page.worst_disagreement(run, judged(run))
    assert worst is not None
    assert worst.cause is not None
    assert worst.cause.text == "a " * 20 + "…"
    browser = synthetic.browser_of(run)
    for address in ("/", "/failures"):
        assert "trial_0002" in browser.get(address).text
        assert "/failures/picture" not in browser.get(address).text


def test_the_results_of_a_table_ask_for_no_recording(tmp_path: Path, synthetic: ModuleType) -> None:
    lines = [f"t{i},stack,octo,{'success' if i % 3 else 'failure'}" for i in range(12)]
    (tmp_path / "study.csv").write_text("\n".join(["trial_id,task,policy,outcome", *lines]))
    place = RunFolder(tmp_path / "study")
    assert type_here(["evaluate", f"{place.path}.csv", "--out", str(place.results_dir)]) == 0
    pages = synthetic.browser_of(place)
    for address in ("/", "/label", "/failures"):
        shown = words(pages.get(address).text)
        assert "from a table" in shown
        assert "robot-gst record" not in shown
        assert "older than the run" not in shown
    assert "8/12" in words(pages.get("/").text)


def test_disagreements_come_first_and_outcomes_have_words(browser: Any) -> None:
    page = browser.get("/").text.partition('id="trials"')[2]
    ids = re.findall(r'href="/episode/(trial_\d+)', page)
    assert ids == ["trial_0002", "trial_0004", "trial_0001", "trial_0003"]
    for word in ("✓ success", "✗ failure", "≠ disagree", "= agree", "✗ refused"):
        assert word in page


def test_a_selection_in_the_address_filters_the_list_and_keeps_the_headline(
    browser: Any,
) -> None:
    page = browser.get("/?show=disagree").text
    listed = page.partition('id="trials"')[2]
    assert re.findall(r'href="/episode/(trial_\d+)', listed) == ["trial_0002"]
    assert "2 of 3" in words(page)
    none = words(browser.get("/?condition=nonsense").text)
    assert "No trial matches this selection" in none


def test_the_episode_page_shows_verdicts_causes_and_provenance(browser: Any) -> None:
    text = words(browser.get("/episode/trial_0001").text)
    for expected in (
        "✗ refused",
        "dropped",
        "cube – table",
        "the cube left the gripper during carry",
        "at 3.80 s",  # 2.8 s into a plan that started 1 s after the first sample
        "labelled by stand-in operator",
        "bullet",
        "✓ unchanged",
        "Download MCAP",
        "robot-gst replay",
    ):
        assert expected in text


def test_the_time_in_the_address_moves_slider_and_frames(browser: Any) -> None:
    page = browser.get("/episode/trial_0001?t=2.1").text
    assert 'value="2.100"' in page
    assert "/frame/side?t=2.0" in page
    assert 'value="5.950"' in browser.get("/episode/trial_0001?t=99").text
    for nonsense in ("nan", "soon", "1e400", ""):
        assert browser.get(f"/episode/trial_0001?t={nonsense}").status_code == 200


def test_a_replaced_plan_is_shown_as_not_sent(browser: Any) -> None:
    text = words(browser.get("/episode/trial_0003").text)
    assert "plan not sent" in text
    assert "1 of 2 plans sent" in text
    assert "2.80 s into the plan" in text


def test_a_frame_is_the_recorded_bytes_nearest_to_the_time(
    browser: Any, shared_run: RunFolder
) -> None:
    answer = browser.get("/episode/trial_0001/frame/side?t=2.1")
    assert answer.headers["content-type"] == "image/jpeg"
    assert answer.content[:2] == b"\xff\xd8"
    assert answer.content == browser.get("/episode/trial_0001/frame/side?t=2.0").content
    assert answer.content != browser.get("/episode/trial_0001/frame/side?t=4").content
    missing = browser.get("/episode/trial_0001/frame/top?t=1")
    assert missing.status_code == 404
    assert "side, wrist" in words(missing.text)


@pytest.mark.parametrize(
    ("part", "command"), [("results", "evaluate"), ("derived", "rebuild"), ("episodes", "record")]
)
def test_a_missing_part_names_the_next_command(
    synthetic: ModuleType, copy: RunFolder, part: str, command: str
) -> None:
    for folder in ("results", "derived", "episodes"):
        shutil.rmtree(copy.path / folder)
        if folder == part:
            break
    answer = synthetic.browser_of(copy).get("/")
    assert answer.status_code == 200
    assert f"robot-gst {command}" in words(answer.text)


def test_broken_files_are_named_and_the_rest_is_shown(
    synthetic: ModuleType, own_run: RunFolder
) -> None:
    whole = (own_run.episodes_dir / "trial_0001.mcap").read_bytes()
    (own_run.episodes_dir / "trial_0009.mcap").write_bytes(whole[: len(whole) // 2])
    (own_run.episodes_dir / "trial_0010.mcap").write_bytes(b"not an episode")
    (own_run.episodes_dir / "trial_0011.mcap.part").write_bytes(whole[:100])
    browser = synthetic.browser_of(own_run)
    text = words(browser.get("/").text)
    assert "Files that cannot be read 3" in text
    for name in ("trial_0009.mcap", "trial_0010.mcap", "trial_0011.mcap.part", "trial_0001"):
        assert name in text
    answer = browser.get("/episode/trial_0010")
    assert answer.status_code == 500
    assert "trial_0010.mcap: not a finished MCAP file" in words(answer.text)


def test_damage_inside_a_file_is_named_on_its_page(
    synthetic: ModuleType, own_run: RunFolder
) -> None:
    path = own_run.episodes_dir / "trial_0001.mcap"
    data = bytearray(path.read_bytes())
    middle = len(data) // 3
    data[middle : middle + 64] = bytes(64)
    path.write_bytes(data)
    browser = synthetic.browser_of(own_run)
    answer = browser.get("/episode/trial_0001")
    assert answer.status_code == 200
    assert "Some parts could not be read" in words(answer.text)
    assert "trial_0001.mcap" in words(answer.text)
    assert browser.get("/").status_code == 200


def test_several_runs_are_switched_in_the_address(
    synthetic: ModuleType, shared_run: RunFolder, own_run: RunFolder
) -> None:
    browser = synthetic.browser_of(shared_run, own_run)
    assert "trial_0003" in browser.get("/").text
    page = browser.get("/?run=own").text
    assert "trial_0003" not in page
    assert 'href="/episode/trial_0001?run=own"' in page
    assert browser.get("/?run=other").status_code == 404


@pytest.mark.parametrize(
    "address",
    [
        "/episode/..%2f..%2fetc%2fpasswd",
        "/episode/../../../etc/passwd",
        "/episode/%2e%2e/file",
        "/episode/trial_0001%00",
        "/episode/trial_9999",
        "/episode/..%5c..%5csecret/file",
        "/derived/..%2fepisodes%2ftrial_0001.mcap/file",
        "/derived/..%2f..%2f..%2fetc%2fpasswd/file",
        "/static/../app.py",
        "/static/..%2fapp.py",
        "/twin/nothing.mcap/recorded/side?stamp=1",
        "/nowhere",
    ],
)
def test_nothing_outside_the_run_is_served(browser: Any, address: str) -> None:
    answer = browser.get(address)
    assert answer.status_code == 404
    assert "root:" not in answer.text
    assert "def create_app" not in answer.text


def test_a_link_out_of_the_run_is_not_followed(own_run: RunFolder, tmp_path: Path) -> None:
    outside = tmp_path / "outside.mcap"
    shutil.copy(own_run.episodes_dir / "trial_0001.mcap", outside)
    (own_run.episodes_dir / "linked.mcap").symlink_to(outside)
    (own_run.derived_dir).mkdir()
    (own_run.derived_dir / "linked.views.x.mcap").symlink_to(outside)
    with pytest.raises(NotHereError, match="outside the run folder"):
        episode_path(own_run, "linked")
    with pytest.raises(NotHereError, match="outside the run folder"):
        derived_path(own_run, "linked.views.x.mcap")


def test_every_answer_carries_the_strict_headers(browser: Any) -> None:
    for address in ("/", "/nowhere", "/static/page.css", "/episode/trial_0001/frame/side"):
        headers = browser.get(address).headers
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"


def test_pages_hold_nothing_the_policy_forbids_and_nothing_from_outside(browser: Any) -> None:
    for address in ("/", "/episode/trial_0001", "/twin", "/nowhere"):
        page = browser.get(address).text
        assert not re.search(r"<script(?![^>]*\bsrc=)", page)
        assert not re.search(r"\s(style|on\w+)=", page)
        assert not re.search(r"(src|href|action)=\"(https?:)?//", page)


def test_a_foreign_host_name_is_refused(browser: Any) -> None:
    for host in ("127.0.0.1:8600", "localhost:1234", "[::1]:8600"):
        assert browser.get("/", headers={"host": host}).status_code == 200
    for host in ("evil.example", "127.0.0.1.evil.example:8600", "192.168.1.5:8600", "", "[::1"):
        assert browser.get("/", headers={"host": host}).status_code == 400


def test_an_open_address_asks_for_its_token(synthetic: ModuleType, shared_run: RunFolder) -> None:
    admission = Admission(host="0.0.0.0", token="secret-token")
    browser = synthetic.Browser(create_app(Library.open([shared_run.path]), admission))
    host = {"host": "192.168.1.5:8600"}
    assert browser.get("/", headers=host).status_code == 403
    assert browser.get("/static/page.css", headers=host).status_code == 403
    assert browser.get("/?token=wrong", headers=host).status_code == 403
    entry = browser.get("/?token=secret-token&show=disagree", headers=host)
    assert entry.status_code == 303
    assert entry.headers["location"] == "/?show=disagree"
    assert "HttpOnly" in entry.headers["set-cookie"]
    assert "samesite=strict" in entry.headers["set-cookie"].lower()
    with_cookie = {**host, "cookie": f"{COOKIE}=secret-token"}
    assert browser.get("/", headers=with_cookie).status_code == 200
    foreign = {"host": "evil.example", "cookie": f"{COOKIE}=secret-token"}
    assert browser.get("/", headers=foreign).status_code == 400
    away = browser.get("//evil.example/?token=secret-token", headers=host)
    assert not away.headers.get("location", "/").startswith("//")


def test_nothing_but_labels_can_be_asked_to_write(shared_run: RunFolder, browser: Any) -> None:
    app = create_app(Library.open([shared_run.path]))
    routes = [(getattr(r, "path", ""), getattr(r, "methods", None) or set()) for r in app.routes]
    assert [path for path, methods in routes if methods - {"GET", "HEAD"}] == [
        "/label",
    ]
    for path in ("/", "/label", "/episode/trial_0001"):
        foreign = browser.post(path, headers={"Origin": "http://evil.example"}, content=b"")
        assert foreign.status_code == 403
