"""The operator's console: who gets in, what they do not see, and that nothing they say is lost."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from live_recorder import LiveRecorder, open_recorder
from loopback import free_endpoint

from bridge.episode.catalogue import label_episode, outcome_of
from bridge.episode.metadata import Outcome
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.task.find import chosen_task_file
from bridge.task.protocol import Endpoint, PolicyArms, Protocol, StudyTask
from bridge.wire.config import WireConfig
from dashboards.app import create_app
from dashboards.config import DashboardConfig
from dashboards.console_door import CLOSED_S, MOST_WRONG, ConsoleDoor, claim_console
from dashboards.console_page import may_write_into
from dashboards.console_study import ConsoleStudy, drawn_start, outcome_from
from dashboards.guard import Admission
from dashboards.label_page import CAUSES
from dashboards.library import Library
from evaluator.compare import compare_run

WAIT_S = 20.0
TASK = "cube_into_box"
CODES = ("arm_01", "scripted")
"""The second is what synthetic trials say of themselves."""


def protocol(*, arms: tuple[str, ...] = ("without", "with"), blind: bool = True) -> Protocol:
    file = chosen_task_file(TASK)
    codes = {f"secret_policy, {arm}": code for arm, code in zip(arms, CODES, strict=True)}
    arm = {"policy": "secret_policy", "against_policy": "secret_policy"}
    return Protocol(
        tasks=(StudyTask(task=TASK, task_sha256=file.sha256, session_seed=1, starts=2),),
        policies=(PolicyArms(policy="secret_policy", arms=arms),),
        rounds=5,
        study_seed=3,
        codes=codes if blind else {},
        primary=Endpoint(kind="difference", arm="with", against_arm="without", **arm),
    )


def study_run(path: Path, made: Protocol) -> RunFolder:
    run = RunFolder.create(path)
    (run.path / "protocol.json").write_bytes(made.to_json())
    return run


class Phone:
    """One phone at a console that is answered without a network."""

    def __init__(self, synthetic: ModuleType, app: Any, code: str, name: str = "Ann") -> None:
        """Enter with a code."""
        self._pages = synthetic.Browser(app)
        answer = self._pages.post("/console/enter", json={"code": code, "name": name})
        self.entered = answer.status_code
        self.set_cookie = answer.headers.get("set-cookie", "")
        self.cookie = {"Cookie": self.set_cookie.partition(";")[0]}

    def look(self, correct: str = "") -> Any:
        return self._pages.get(f"/console/state?correct={correct}", headers=self.cookie).json()

    def do(self, what: str, **more: object) -> Any:
        answer = self._pages.post("/console/act", json={"do": what, **more}, headers=self.cookie)
        return {"status": answer.status_code, **answer.json()}

    def get(self, address: str) -> Any:
        return self._pages.get(address, headers=self.cookie)

    def seen(self) -> str:
        found = re.search(r'data-seen="(\w+)"', self.look()["html"])
        assert found
        return found[1]


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    return study_run(tmp_path / "study", protocol())


@pytest.fixture
def recorder(run: RunFolder, endpoint: str) -> Iterator[LiveRecorder]:
    wire = WireConfig(mode="router", connect=(), listen=(endpoint,))
    with open_recorder(run.path, wire=wire) as found:
        yield found


@pytest.fixture
def server(endpoint: str) -> Iterator[Callable[[RunFolder], tuple[Any, ConsoleDoor]]]:
    """Makes servers as if each had been started anew; all end with the test."""
    apps = []

    def made(run: RunFolder) -> tuple[Any, ConsoleDoor]:
        door = ConsoleDoor()
        config = DashboardConfig(connect=(endpoint,), console=True)
        admission = Admission(has_console=True)
        apps.append(create_app(Library.open([run.path]), admission, config, door))
        return apps[-1], door

    yield made
    for app in apps:
        app.state.end_console()


def test_a_code_lets_one_phone_in_and_wrong_ones_close_the_door_for_a_while() -> None:
    told: list[str] = []
    clock = [0.0]
    codes = iter(f"{n:08d}" for n in range(10))
    door = ConsoleDoor(told.append, now_s=lambda: clock[0], digits=lambda: next(codes))
    first = door.enter("0000 0000", "Ann")
    assert first
    assert door.holder() == first
    assert door.enter("00000000", "Eve") is None  # used up
    assert "0000 0001" in told[-1]
    for _ in range(MOST_WRONG - 1):
        assert door.enter("99999999", "Eve") is None
    assert door.closed_s() == CLOSED_S
    assert door.enter("00000002", "Eve") is None  # right by now, and still closed
    clock[0] += CLOSED_S
    second = door.enter("00000002", "Bob")
    assert second
    assert door.holder() == first
    door.take(second)
    assert door.holder() == second
    assert door.operator(first.session) == first  # told, not sent away
    assert door.operator("") is None


def test_a_phone_reaches_nothing_but_the_console(run: RunFolder, synthetic: ModuleType) -> None:
    door = ConsoleDoor()
    admission = Admission(host="192.0.2.1", token="t" * 32, has_console=True)
    app = create_app(Library.open([run.path]), admission, DashboardConfig(console=True), door)
    pages = synthetic.Browser(app)
    assert "Enter the code" in pages.get("/console").text
    assert pages.get("/static/console.js").status_code == 200
    for address in ("/", "/queue", "/episode/trial_0001", "/consoles", "/static2/x", "//console"):
        assert pages.get(address).status_code in (400, 403), address
    for address in ("/console/state", "/console/start/1", "/console/now/side"):
        assert pages.get(address).status_code in (401, 404), address
    code = door.code
    assert Phone(synthetic, app, "12").entered == 403
    foreign = {"Origin": "http://evil.example"}
    body = {"code": code, "name": "Eve"}
    assert pages.post("/console/enter", json=body, headers=foreign).status_code == 403
    phone = Phone(synthetic, app, code)
    assert phone.entered == 200
    assert {"HttpOnly", "SameSite=strict", "Path=/console"} <= set(phone.set_cookie.split("; "))
    assert phone.get("/").status_code == 403  # a session is no token
    token = {"Cookie": f"robot_gst_token={'t' * 32}"}
    assert pages.get("/console/state", headers=token).status_code == 401  # nor the other way round
    bare = synthetic.browser_of(run)
    assert bare.get("/console").status_code == 404


def test_a_console_is_opened_on_one_address_by_one_server_for_a_locked_protocol(
    run: RunFolder, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match="Name one address"):
        DashboardConfig(host="0.0.0.0", console=True)
    assert DashboardConfig(console=True).host == "127.0.0.1"
    with pytest.raises(UsageError, match="robot-gst design"):
        claim_console(tmp_path)
    claim_console(run.path)
    with pytest.raises(UsageError, match="another dashboard"):
        claim_console(run.path)
    path = run.path / "protocol.json"
    path.write_text(path.read_text().replace('"rounds": 5', '"rounds": 6'))
    with pytest.raises(UsageError, match="edited"):
        claim_console(run.path)


def test_neither_arms_nor_verdicts_change_a_byte_of_what_a_blinded_operator_sees(
    tmp_path: Path, synthetic: ModuleType, server: Any
) -> None:
    """The law of blindness: two studies with exchanged arms, whose twins say the opposite."""
    shown = []
    for side, arms in {"a": ("without", "with"), "b": ("with", "without")}.items():
        run = study_run(tmp_path / side / "study", protocol(arms=arms))
        made = protocol(arms=arms)
        first = next(t for t in made.order() if made.code_of(t.policy, t.arm) == "scripted")
        trial = synthetic.Trial(
            id=f"trial_{first.number:04d}",
            condition="with_replanning" if side == "a" else "without_replanning",
            start_id=first.start_id,
            recorded=True,
            planned=side == "a",
            rejected_first=side == "b",
        )
        synthetic.write_trial(run, trial)
        synthetic.write_replay(run, trial, "planned", side == "a")
        told = "the gate refused it" if side == "b" else None
        label_episode(run, trial.id, Outcome(result="failure", detail=told))
        app, door = server(run)
        phone = Phone(synthetic, app, door.code)
        parts = [phone.look(), phone.look(correct=trial.id)]
        shown.append([part["html"].replace(str(tmp_path / side), "") for part in parts])
        beside = next(t for t in made.order() if t.start_id == first.start_id and t != first)
        start = phone.get(f"/console/start/{beside.number}")
        shown[-1].append(start.content)
        assert start.content.startswith(b"\xff\xd8")
        assert parts[1]["kind"] == "answer"
    assert shown[0] == shown[1]
    for word in ("secret", "gate", "replan", "verdict", "accepted", "refused", "twin fails"):
        assert word not in str(shown[0][:2])
    assert "arm_01" in shown[0][0] + shown[0][1] or "scripted" in shown[0][0]


def test_how_far_a_trial_came_becomes_stages_as_the_evaluator_reads_them() -> None:
    task = chosen_task_file(TASK).task()
    names = [str(stage["id"]) for stage in task.stages]

    def outcome(**record: object) -> Outcome:
        return outcome_from(record, task, "Ann", void_cause="interrupted")

    for reached in range(len(names)):
        made = outcome(result="failure", cause=CAUSES[0], reached=reached, note="so")
        failed = [stage["id"] for stage in made.stages if stage["result"] == "failure"]
        assert failed == [names[reached]]
        assert [stage["id"] for stage in made.stages] == names
        assert made.detail == f"{CAUSES[0]}: so"
        assert made.is_failed_execution
    assert not outcome(result="failure", cause=CAUSES[0], reached=-1).stages
    assert {s["result"] for s in outcome(result="success").stages} == {"success"}
    void = outcome(result="void", note="the lamp fell")
    assert (void.result, void.detail) == ("unknown", "interrupted: the lamp fell")
    for wrong in (
        {"result": "maybe"}, {"result": "failure", "cause": "x", "reached": 0},
        {"result": "failure", "cause": CAUSES[0], "reached": len(names) + 1},
        {"result": "failure", "cause": CAUSES[0], "reached": True},
        {"result": "success", "note": 7}, {"result": "success", "note": "x" * 5000},
    ):  # fmt: skip
        with pytest.raises(UsageError):
            outcome(**wrong)


def test_a_start_is_drawn_where_its_seed_puts_the_objects() -> None:
    task = chosen_task_file(TASK).task()
    poses = task.draw_start(np.random.default_rng(1001))
    view = drawn_start(task, 1001)
    left, top, width, height = map(float, view.view_box.split())
    for placed in view.objects:
        assert (placed.x_m, placed.y_m) == tuple(poses[placed.name][:2, 3])
        corners = np.array([p.split(",") for p in placed.outline.split()], float)
        middle = corners.mean(axis=0)
        assert np.allclose(middle, [-1000 * placed.y_m, -1000 * placed.x_m], atol=1)
        assert (corners > [left, top]).all()
        assert (corners < [left + width, top + height]).all()
        ahead = np.subtract(placed.heading[2:], placed.heading[:2])
        turned = np.degrees(np.arctan2(-ahead[0], -ahead[1]))
        assert turned == pytest.approx(placed.yaw_deg, abs=0.1)


def test_a_study_is_recorded_answered_and_read_by_the_evaluator_through_servers_that_die(
    run: RunFolder, recorder: LiveRecorder, synthetic: ModuleType, server: Any
) -> None:
    app, door = server(run)
    phone = Phone(synthetic, app, door.code)
    other = Phone(synthetic, app, door.code, "Bob")
    assert phone.look()["kind"] == "ready"
    assert "Ann holds the console" in other.look()["html"]
    assert other.do("start", trial="trial_0001")["status"] == 409
    assert recorder.status()["state"] == "idle"
    assert phone.do("start", trial="trial_0002")["status"] == 409
    for _ in range(2):  # the second press is one whose answer was lost
        assert phone.do("start", trial="trial_0001")["kind"] == "recording"
    assert recorder.status()["episode"] == "trial_0001"

    app, door = server(run)  # the first server died
    phone = Phone(synthetic, app, door.code)
    assert phone.look()["kind"] == "recording"
    for _ in range(2):
        assert phone.do("stop", trial="trial_0001")["kind"] == "answer"

    app, door = server(run)
    phone = Phone(synthetic, app, door.code)
    seen = phone.seen()
    said = {"trial": "trial_0001", "seen": seen, "result": "failure", "cause": "dropped it"}
    assert phone.do("start", trial="trial_0002")["status"] == 409  # an answer is owed
    assert phone.do("answer", **said, reached=9)["status"] == 400
    assert phone.do("answer", **said, reached=1)["kind"] == "ready"
    late = phone.do("answer", **{**said, "result": "success"})
    assert late["status"] == 409  # another tab that had not seen it
    corrected = phone.look(correct="trial_0001")["html"]
    assert "So far" in corrected
    assert "✗ failure" in corrected

    episode = Episode.open(run.episodes_dir / "trial_0001.mcap")
    outcome = outcome_of(run, episode)
    assert outcome
    assert (outcome.result, outcome.by, outcome.detail) == ("failure", "Ann", "dropped it")
    first = ConsoleStudy(run, protocol()).order[0]
    info = episode.info
    assert (info.start_id, info.trial, info.operator) == (first.start_id, 1, "Ann")
    assert info.policy.startswith("arm_")
    assert not info.condition
    assert chosen_task_file(TASK).sha256 == info.task_sha256
    (row,) = compare_run(run).rows
    assert (row.policy, row.study_arm, row.recorded) == ("secret_policy", first.arm, False)
    assert row.stages == (("grasp", True), ("place", False))


def test_a_recorder_may_name_its_run_from_its_own_folder(tmp_path: Path) -> None:
    run = tmp_path / "runs" / "study"
    run.mkdir(parents=True)
    (tmp_path / "link").symlink_to(run)
    for told in (
        run,
        tmp_path / "link",
        Path("study"),
        Path("runs/study"),
        Path("../study"),
        Path(),
    ):
        assert may_write_into(told, run), told
    for told in (tmp_path / "other", Path("other"), Path("others/study"), Path("study/other")):
        assert not may_write_into(told, run), told


def test_a_recorder_of_another_run_or_none_is_told_and_never_started(
    tmp_path: Path, endpoint: str, synthetic: ModuleType, server: Any
) -> None:
    app, door = server(study_run(tmp_path / "other", protocol()))
    phone = Phone(synthetic, app, door.code)
    wire = WireConfig(mode="router", connect=(), listen=(endpoint,))
    with open_recorder(tmp_path / "run", wire=wire):
        state = phone.look()
        assert state["kind"] == "stuck"
        assert "another run" in state["html"]
        assert phone.do("start", trial="trial_0001")["status"] == 400
    assert phone.look()["kind"] == "stuck"
    assert phone.do("start", trial="trial_0001")["status"] == 502
