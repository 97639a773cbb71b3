"""Everything that can go wrong between a plan and its execution: never a yes by default."""

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gate_fakes
import numpy as np
import pytest
from gate_fakes import HOME, JUDGED, TASK, accept

from bridge.episode.run_folder import RunFolder
from bridge.errors import OptionError, UsageError
from bridge.geometry import se3
from bridge.task.task_file import load_task
from bridge.task.verdict import Factor, Verdict
from bridge.terminal import Output
from twin.gate import twin_process
from twin.gate.config import GateConfig
from twin.gate.gate import Gate, UndecidedError, turn_between, who_moved
from twin.gate.twin_process import TwinProcess

PLAN = replace(gate_fakes.PLAN, robot="arm")


def frame(stamp_ns: int) -> Any:
    return SimpleNamespace(stamp_ns=stamp_ns)


@dataclass
class ChangingPerception:
    """What is seen first, and what is seen when one looks again."""

    looks: list[list[Any]] = field(default_factory=lambda: [[frame(1)]])
    running: list[str | None] = field(default_factory=lambda: [None])
    postures: list[Any] = field(default_factory=lambda: [HOME])

    def urdf(self) -> str:
        return '<robot name="arm"/>'

    def joints(self) -> Any:
        return self.postures.pop(0) if len(self.postures) > 1 else self.postures[0]

    def executing(self) -> str | None:
        return self.running.pop(0) if len(self.running) > 1 else self.running[0]

    def newest_ns(self) -> int:
        return 1

    def heard_ns(self) -> int:
        return 0

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
    gate = Gate(
        tasks=JUDGED,
        config=GateConfig(**{"deadline_s": 5.0, "frame_wait_s": 0.0, **settings}),
        perception=perception or ChangingPerception(),
        localise=lambda *_: answers.pop(0) if len(answers) > 1 else answers[0],
        replay=lambda *_: verdict or accepted(),
        now_ns=lambda: 0,
    )
    return gate.judge(PLAN.to_json())


LOOKS = [[frame(1)], [frame(2)]]


def at(joints_rad: list[float]) -> Any:
    return SimpleNamespace(**{**vars(HOME), "position_rad": np.array(joints_rad)})


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
        ({"running": [None, "plan_0"]}, None, "plan_0 was started while the plan was"),
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
    with pytest.raises(UsageError, match="--samples 16"):
        GateConfig(min_p_success=0.5)
    with pytest.raises(OptionError, match="--deadline-s"):
        GateConfig(deadline_s=-1.0)


@pytest.fixture
def twin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TwinProcess]:
    """A process that imports nothing, and does what it is told instead of replaying."""
    monkeypatch.setattr(twin_process, "get_ready", id)
    run = RunFolder.create(tmp_path / "run")
    with TwinProcess(run.path, GateConfig(), Output(quiet=True)) as process:
        yield process


FOREVER = "__import__('threading').Event().wait()"
"""A replay that never ends: a test that waited for it would hang, and be named by the limit."""


def soon(seconds: float) -> float:
    return time.monotonic() + seconds


def test_a_replay_that_hangs_is_stopped_and_the_next_one_is_judged(twin: TwinProcess) -> None:
    assert twin._do("replay", eval, "1 + 1", soon(20)) == 2
    with pytest.raises(UndecidedError, match="the replay was not done before the wall-clock limit"):
        twin._do("replay", eval, FOREVER, soon(0.1))
    assert twin._do("replay", eval, "2 + 2", soon(20)) == 4


def test_a_replay_that_dies_takes_nobody_with_it(twin: TwinProcess) -> None:
    suicide = "__import__('os').kill(__import__('os').getpid(), 11)"
    with pytest.raises(UndecidedError, match="no replay: the process that did it ended by SIGSEGV"):
        twin._do("replay", eval, suicide, soon(20))
    assert twin._do("replay", eval, "2 + 2", soon(20)) == 4


def test_a_replay_that_raises_is_no_verdict_with_its_sentence(twin: TwinProcess) -> None:
    raising = "(_ for _ in ()).throw(__import__('twin.errors').errors.TwinError('no waypoints'))"
    with pytest.raises(UndecidedError, match=r"^no waypoints$"):
        twin._do("replay", eval, raising, soon(20))
    with pytest.raises(UndecidedError, match="internal error: ZeroDivisionError"):
        twin._do("replay", eval, "1 / 0", soon(20))


def test_a_gate_that_is_being_stopped_says_so(twin: TwinProcess) -> None:
    said: list[Exception] = []

    def ask() -> None:
        try:
            twin._do("replay", eval, FOREVER, soon(60))
        except UndecidedError as error:
            said.append(error)

    asking = threading.Thread(target=ask)
    asking.start()
    while twin._worker is None or not twin._worker.busy:
        threading.Event().wait(0.005)
    twin.close()
    asking.join(10)
    assert not asking.is_alive()
    assert len(said) == 1
    with pytest.raises(UndecidedError, match="is being stopped"):
        twin._do("replay", eval, "1", soon(1))


def test_a_no_is_a_no_whatever_happens_meanwhile() -> None:
    no = Factor(value=False, cause="inside", detail="beside the box")
    perception = ChangingPerception(running=[None, "plan_0"])
    assert judged(perception, verdict=replace(accepted(), terminal=no)).accepted is False


def test_without_a_newer_picture_nobody_looks_again() -> None:
    """A cell that stands still while it waits for the verdict costs no second localisation."""
    assert judged(found=[seen(pose()), seen(pose(9.0))]).accepted is True
