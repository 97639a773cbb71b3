"""The gate as a service: what it answers, how it ends, and that nothing is a yes by default."""

import json
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gate_fakes import HOME, PLAN, TASK, FakePerception, FakeSession, accept, gate_with

from bridge.episode.run_folder import RunFolder
from bridge.errors import InvalidRecordError, UsageError
from bridge.geometry import se3
from bridge.task.task_file import load_task
from bridge.task.verdict import Factor, Verdict
from bridge.terminal import Output
from twin.gate.config import GateConfig
from twin.gate.gate import turn_between, who_moved
from twin.gate.service import GateError, run_gate, serve_gate, watch_cell
from twin.robot import collision


def frame(stamp_ns: int) -> Any:
    return SimpleNamespace(stamp_ns=stamp_ns)


@dataclass
class ChangingPerception(FakePerception):
    """What is seen first, and what is seen when one looks again."""

    looks: list[list[Any]] = field(default_factory=lambda: [[frame(1)]])
    executed: list[str | None] = field(default_factory=lambda: [None])
    postures: list[Any] = field(default_factory=lambda: [HOME])

    def joints(self) -> Any:
        self.arm = self.postures.pop(0) if len(self.postures) > 1 else self.postures[0]
        return super().joints()

    def executing(self) -> str | None:
        return self.executed.pop(0) if len(self.executed) > 1 else self.executed[0]

    def frames(self, **_: Any) -> Any:
        frames = self.looks.pop(0) if len(self.looks) > 1 else self.looks[0]
        return SimpleNamespace(frames=frames, reasons=[] if frames else ["side: silent"])


def pose(x_m: float = 0.5, yaw_rad: float = 0.0) -> np.ndarray:
    q = np.array([np.cos(yaw_rad / 2), 0.0, 0.0, np.sin(yaw_rad / 2)])
    return se3.transform_from(q, np.array([x_m, 0.0, 0.02]))


def seen(T_cube: np.ndarray, sigma_m: float = 0.001) -> dict[str, Any]:
    unsure = np.diag([sigma_m**2] * 3 + [1e-4] * 3)
    return {
        name: SimpleNamespace(
            found=True,
            reason=None,
            T_base_object=T_cube if name == "cube" else np.eye(4),
            covariance=unsure,
        )
        for name in TASK.objects
    }


def accepted(p_success: dict[str, float] | None = None) -> Verdict:
    return replace(accept(PLAN), p_success=p_success)


def judged(
    perception: ChangingPerception | None = None,
    found: list[dict[str, Any]] | None = None,
    verdict: Verdict | None = None,
    **settings: Any,
) -> Verdict:
    answers = found or [seen(pose())]
    gate = gate_with(
        perception or ChangingPerception(),
        lambda *_: answers.pop(0) if len(answers) > 1 else answers[0],
        lambda *_: verdict or accepted(),
        **settings,
    )
    return gate.judge(PLAN.to_json())


LOOKS = [[frame(1)], [frame(2)]]


def at(joints_rad: list[float]) -> Any:
    return SimpleNamespace(**{**vars(HOME), "position": np.array(joints_rad)})


def test_a_yes_needs_the_cell_to_be_as_it_was_judged() -> None:
    assert judged(ChangingPerception(looks=list(LOOKS))).accepted is True


LOST = {**seen(pose()), "cube": SimpleNamespace(found=False, reason="0 points")}
BENT = at([0.0, 0.0, 0.06, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("changes", "after", "reason"),
    [
        ({"looks": LOOKS}, seen(pose(0.53)), "moved while the plan was being judged: cube by 30 mm "
         "and 0 degrees"),
        ({"looks": LOOKS}, seen(pose(yaw_rad=0.6)), "cube by 0 mm and 34 degrees"),
        ({"looks": LOOKS}, LOST, "not every object was found: cube (0 points)"),
        ({"looks": [[frame(1)], []]}, None, "lost from sight while the plan was judged"),
        ({"executed": [None, "plan_0"]}, None, "plan_0 was started while the plan was"),
        ({"postures": [HOME, BENT]}, None, "the arm moved while the plan was being judged: "
         "elbow_joint by 0.060 rad"),
        ({"postures": [HOME, at([np.nan] * 6)]}, None, "/standin/joint_states hold no numbers for "
         "every joint"),
    ],
)  # fmt: skip
def test_what_changes_while_a_plan_is_judged_takes_the_yes_away(
    changes: dict[str, list[Any]], after: dict[str, Any] | None, reason: str
) -> None:
    perception = ChangingPerception(**{name: list(values) for name, values in changes.items()})
    verdict = judged(perception, [seen(pose()), after] if after else None)
    assert verdict.accepted is None
    assert reason in str(verdict.reason)


def test_what_localisation_is_not_sure_of_is_no_motion() -> None:
    before, after = seen(pose(), sigma_m=0.01), seen(pose(0.53), sigma_m=0.01)
    assert who_moved(before, after, TASK) == []


def test_a_place_that_is_no_number_is_not_where_it_was() -> None:
    before, after = seen(pose()), seen(pose(np.nan))
    assert who_moved(before, after, TASK)
    turned = pose()
    turned[0, 0] = np.nan
    assert who_moved(before, seen(turned), TASK)


def test_a_cube_turned_by_a_quarter_did_not_turn() -> None:
    cube = TASK.objects["cube"]
    assert turn_between(pose(), pose(yaw_rad=np.pi / 2), cube) == pytest.approx(0.0, abs=1e-9)
    assert turn_between(pose(), pose(yaw_rad=0.4), cube) == pytest.approx(0.4)
    sloth = load_task("sloth_into_basket").objects["sloth"]
    assert turn_between(pose(), pose(yaw_rad=np.pi / 2), sloth) == pytest.approx(np.pi / 2)


P = {"value": 0.75, "low": 0.5, "high": 0.9, "k": 12, "n": 16}


def test_a_share_of_samples_that_is_asked_for_is_asked_for() -> None:
    wanted = {"samples": 16, "min_p_success": 0.8}
    refused = judged(verdict=accepted(P), **wanted)
    assert refused.accepted is False
    assert refused.first_failing == "terminal"
    assert refused.terminal.cause == "probability"
    assert "12 of 16 varied replays succeed, 80% are asked for" in str(refused.reason)
    assert refused.p_success == P
    assert Verdict.from_json(refused.to_json()).accepted is False
    assert judged(verdict=accepted(P), samples=16, min_p_success=0.75).accepted is True
    none = judged(verdict=accepted(None), **wanted)
    assert none.accepted is None
    assert "--max-steps 100000 leaves no step for a varied replay" in str(none.reason)
    assert judged(verdict=accepted(P), samples=16).accepted is True


def test_settings_with_which_no_gate_works_are_refused() -> None:
    with pytest.raises(UsageError, match="leave --samples 0 out"):
        GateConfig(min_p_success=0.5, samples=0)


def test_a_no_is_a_no_whatever_happens_meanwhile() -> None:
    no = Factor(value=False, cause="inside", detail="beside the box")
    perception = ChangingPerception(executed=[None, "plan_0"])
    assert judged(perception, verdict=replace(accepted(), terminal=no)).accepted is False


def test_without_a_newer_picture_nobody_looks_again() -> None:
    """A cell that stands still while it waits for the verdict costs no second localisation."""
    assert judged(found=[seen(pose()), seen(pose(9.0))]).accepted is True


def test_the_service_answers_and_publishes_with_the_cells_own_time() -> None:
    session = FakeSession()
    serve_gate(session, gate_with(), FakePerception(), GateConfig(), Output(quiet=True))
    answer = session.services["standin/gate/verdict"](PLAN.to_json())
    assert Verdict.from_json(answer).accepted is True
    assert session.published == [("/standin/verdict", answer, 42)]


def test_an_id_from_the_network_does_not_move_the_cursor(
    capsys: pytest.CaptureFixture[str],
) -> None:
    session, plan = FakeSession(), replace(PLAN, id="plan\x1b[2J\x1b[31m")
    serve_gate(session, gate_with(), FakePerception(), GateConfig(), Output())
    session.services["standin/gate/verdict"](plan.to_json())
    said = capsys.readouterr().err
    assert "\x1b" not in said
    assert "plan?[2J?[31m: accepted" in said


def test_a_malformed_plan_is_not_published() -> None:
    session = FakeSession()
    serve_gate(session, gate_with(), FakePerception(), GateConfig(), Output(quiet=True))
    with pytest.raises(InvalidRecordError):
        session.services["standin/gate/verdict"](b"nonsense")
    assert session.published == []


def test_only_cameras_events_joints_and_transforms_are_subscribed() -> None:
    session, taken = FakeSession(), []
    watch_cell(session, "standin", lambda *item: taken.append(item))
    assert sorted(session.subscriptions) == [
        "/robot_description",
        "/standin/cam/**",
        "/standin/event",
        "/standin/joint_states",
        "/tf",
        "/tf_static",
    ]
    sample = SimpleNamespace(topic="/tf", data=b"x", received_ns=3, type_name="t")
    session.subscriptions["/tf"](sample)
    assert taken == [("/tf", b"x", 3, "t")]


def test_a_yes_names_scene_and_calibration_and_the_gate_says_those_of_now() -> None:
    now: dict[str, str | None] = {"scene_hash": "5cene", "calibration_id": "c"}
    session, said = FakeSession(), {"scene_hash": "5cene", "calibration_id": "c"}
    gate = gate_with(replay=lambda plan, *_: replace(accept(plan), **said), judged_in=lambda: now)
    serve_gate(session, gate, FakePerception(), GateConfig(), Output(quiet=True))
    ask = session.services["standin/gate/verdict"]
    basis = Verdict.from_json(ask(PLAN.to_json())).basis or {}
    assert {name: basis[name] for name in said} == said
    now["scene_hash"] = "rebuilt"
    assert json.loads(ask(b"")) == now
    said["calibration_id"] = "d"
    refused = Verdict.from_json(ask(PLAN.to_json()))
    assert refused.accepted is None
    assert "the run has been calibrated since the gate started" in str(refused.reason)


def test_a_gate_of_an_arm_that_nobody_watches_does_not_start(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(collision, "_MOST_LEFT_OUT", 0.0)
    told = r"could be accepted: \d+% of the pairs of links .*: base_link and upper_arm_link, for"
    with pytest.raises(GateError, match=told):
        run_gate(run.path, GateConfig(robot="ur10e_parallel_gripper"), Output(quiet=True))
