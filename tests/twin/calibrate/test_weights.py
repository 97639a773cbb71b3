"""A weight in the hand, found again from efforts that another engine's inverse dynamics makes."""

import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import TRUTH, object_topic
from bridge.robots.default import ROBOT
from bridge.sources.standin import session, world
from bridge.sources.standin.cell_file import draw_hidden
from bridge.sources.standin.settings import SessionConfig
from bridge.task.task_file import Task, load_task
from bridge.terminal import Output
from twin import cli
from twin.calibrate import weights
from twin.calibrate.config import CalibrateConfig
from twin.calibrate.physics.pushes import UnusablePushError
from twin.calibrate.posterior import draw_beforehand
from twin.calibrate.weights import NoWeightError, smoothed, together, unlike, weighed, weight_of
from twin.gate.twin_process import judge_of
from twin.replay.config import ReplayConfig
from twin.replay.monte_carlo import draw_variation, with_draw
from twin.replay.rebuilt_scene import MASSES, for_task, read_rebuilt_scene
from twin.robot.model import load_robot
from twin.scene.store.calibration import read_calibration, write_part

sys.path.append(str(Path(__file__).parents[3] / "benchmarks"))
from bench_held_mass import one_trial
from cell_run import FileSession

ARM = load_robot(ROBOT.description())
TIMES_S = np.arange(0, 12, 0.016)
FREE, HELD = TIMES_S < 5.5, (TIMES_S > 6) & (TIMES_S < 11.5)
MOST_NM = np.array([150.0, 150, 150, 28, 28, 28])


def model_with(mass_kg: float, centre_m: tuple[float, float, float]) -> mujoco.MjModel:
    """The arm's description in MuJoCo, with a ball at the tool."""
    text = re.sub(r"<(visual|collision)\b.*?</\1>", "", ARM.urdf, flags=re.DOTALL)
    x, y, z = centre_m
    ball = f"""<link name="ball"><inertial><origin xyz="{x} {y} {z}"/><mass value="{mass_kg}"/>
      <inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="held" type="fixed"><parent link="{ARM.record.tool_frame}"/><child link="ball"/>
      </joint></robot>"""
    return mujoco.MjModel.from_xml_string(text.replace("</robot>", ball))


def joints_at(times_s: np.ndarray, order: int = 0) -> np.ndarray:
    """Sines about the arm's posture at rest, each joint with a rhythm of its own; derivatives."""
    rhythm = np.array([0.9, 0.7, 1.1, 1.3, 0.8, 1.5])
    size = np.array([0.5, 0.25, 0.35, 0.5, 0.4, 0.6])
    waves = size * rhythm**order * np.sin(np.outer(times_s, rhythm) + order * np.pi / 2)
    return waves + ARM.home_rad * (order == 0)


def efforts_of(mass_kg: float, centre_m: tuple[float, float, float]) -> np.ndarray:
    model = model_with(mass_kg, centre_m)
    data = mujoco.MjData(model)
    at = [model.joint(name).dofadr[0] for name in ARM.joints]
    rows = []
    for index in range(len(TIMES_S)):
        for order, name in enumerate(("qpos", "qvel", "qacc")):
            getattr(data, name)[at] = joints_at(TIMES_S[index : index + 1], order)[0]
        mujoco.mj_inverse(model, data)
        rows.append(data.qfrc_inverse[at].copy())
    return np.array(rows)


EMPTY = efforts_of(1e-6, (0.0, 0.0, 0.0))


def measured(seed: int) -> tuple[dict[str, Any], float, tuple[float, float, float]]:
    """A weight that is drawn, sensors with bias, drift and noise, joints with dry friction."""
    rng = np.random.default_rng(seed)
    mass_kg = float(np.exp(rng.uniform(np.log(0.05), 0.0)))
    centre_m = tuple(rng.uniform(-0.03, 0.03, 3).tolist())
    efforts = np.where(TIMES_S[:, None] > 5.8, efforts_of(mass_kg, centre_m), EMPTY)
    drift = 0.01 * np.outer(TIMES_S / 12, rng.normal(size=6))
    efforts += MOST_NM * (0.02 * rng.uniform(-1, 1, 6) + drift)
    efforts += 0.03 * MOST_NM * np.tanh(joints_at(TIMES_S, 1) / 0.003)
    efforts += 0.001 * MOST_NM * rng.normal(size=efforts.shape)
    encoders = joints_at(TIMES_S) + 5e-5 * rng.normal(size=efforts.shape)
    return said_by(efforts, encoders), mass_kg, centre_m


def said_by(efforts: np.ndarray, encoders: np.ndarray | None = None) -> dict[str, Any]:
    moved = smoothed(TIMES_S, joints_at(TIMES_S) if encoders is None else encoders, efforts)
    free, held = (np.interp(moved[:, 0], TIMES_S, mask) > 0.5 for mask in (FREE, HELD))
    return weight_of(ARM, moved, free, held)


def test_a_weight_and_its_centre_are_found_again_within_their_intervals() -> None:
    inside, centres = 0, 0
    for seed in range(20):
        found, mass_kg, centre_m = measured(seed)
        assert found["half_kg"] < 0.03, (seed, found, mass_kg)
        inside += abs(found["mass_kg"] - mass_kg) <= found["half_kg"]
        off_m = np.abs(np.array(found["centre_m"]) - centre_m)
        centres += int((off_m <= np.array(found["centre_half_m"])).sum())
    assert inside >= 17
    assert centres >= 52


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda efforts: np.full_like(efforts, 3.0), "do not change"),
        (lambda efforts: np.where(TIMES_S[:, None] > 3, np.nan, efforts), "no numbers"),
        (lambda efforts: -efforts, "the other sign at joint"),
        (lambda efforts: efforts * [1, -1, 1, 1, 1, 1], "the other sign at joint 2"),
        (lambda efforts: 1e3 * efforts, "another unit than Nm"),
        (lambda efforts: efforts / 13.0, "another unit than Nm"),  # currents of motors
        (lambda efforts: efforts - EMPTY, "without the arm's own weight"),
        (lambda efforts: EMPTY + 0 * efforts, "nothing that weighs"),
    ],
)
def test_what_efforts_cannot_say_is_named(
    spoil: Callable[[np.ndarray], np.ndarray], why: str
) -> None:
    efforts = np.where(TIMES_S[:, None] > 5.8, efforts_of(0.3, (0.0, 0.0, 0.0)), EMPTY)
    assert abs(said_by(efforts)["mass_kg"] - 0.3) < 0.01
    with pytest.raises(NoWeightError, match=why):
        said_by(spoil(efforts))


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunFolder:
    """A trial with a cube that weighs 6 kg and not 50 g, in fingers that hold it."""
    monkeypatch.setattr(world, "FINGER_STIFFNESS", 20_000.0)
    heavy = {"mass_scale": 6.0 / 0.05, "grip_N": 200.0}
    monkeypatch.setattr(session, "draw_hidden", lambda *a: replace(draw_hidden(*a), **heavy))
    made = RunFolder.create(tmp_path / "run")
    config = SessionConfig(
        seed=9_000_000, scan=False, trials=1, conditions=("without_replanning",), rate_hz=0.0
    )
    wire = FileSession(made.episodes_dir)
    session.run_session(wire, config, Output(quiet=True), start_ns=10**18)
    return made


def test_what_a_trial_weighed_turns_the_next_verdict(
    run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    episode = Episode.open(run.episodes()[0])
    plan, task = streams.plans(episode)[0][1], streams.task_file(episode).task()
    tracks = {
        key: streams.pose_track(episode, object_topic(TRUTH, key, "pose")) for key in task.objects
    }
    starts = {key: track.transforms()[0] for key, track in tracks.items()}

    def scene() -> Any:
        known = read_rebuilt_scene(run, task)
        return replace(known, urdf=ROBOT.urdf_text(), Ts_base_object=starts)

    assert judge_of(run.path, scene())(plan).accepted is True
    assert cli.calibrate(run.path, config=CalibrateConfig(physics=True)) == 0
    told = capsys.readouterr().out
    assert re.search(r"cube_into_box cube: 5\.99\d+ kg .*replays and the gate use it", told)
    assert re.search(r"trial_0001, [345]\.\d+ to [67]\.\d+ s: 5\.99", told)
    verdict = judge_of(run.path, scene())(plan)
    assert verdict.accepted is False
    assert "cube weighs 5.99" in str(verdict.reason)
    assert "more than the 5 kg of" in str(verdict.reason)

    config = for_task(ReplayConfig(), read_calibration(run), task)
    drawn, _ = draw_variation(np.random.default_rng(0), scene(), config)
    mass_kg = drawn.task.objects["cube"].mass_kg
    assert 0 < abs(mass_kg - scene().task.objects["cube"].mass_kg) < 0.1
    wide = replace(draw_beforehand(1, {})[0], mass_scale=2.0)
    for settings, times in ((config, 1.0), (ReplayConfig(), 2.0)):
        varied, _ = with_draw(wide, scene(), settings)
        ratio = varied.task.objects["cube"].mass_kg / scene().task.objects["cube"].mass_kg
        assert ratio == pytest.approx(times)


def test_a_trial_without_efforts_weighs_nothing(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = streams.JointSample.from_cdr
    bare = staticmethod(lambda data: replace(read(data), effort=np.zeros(0)))
    monkeypatch.setattr(streams.JointSample, "from_cdr", bare)
    with pytest.raises(NoWeightError, match="no efforts of the arm's joints were recorded"):
        weighed(Episode.open(run.episodes()[0]), load_task("cube_into_box"))
    with pytest.raises(UnusablePushError, match="trial_0001: no efforts"):
        cli.calibrate(run.path, config=CalibrateConfig(physics=True))


def said(episode: str, mass_kg: float, half_kg: float) -> dict[str, Any]:
    return {"episode": episode, "mass_kg": mass_kg, "half_kg": half_kg}


def test_trials_that_agree_are_as_sure_as_the_surest_and_others_are_named() -> None:
    one = together([said("a", 0.30, 0.02)])
    both = together([said("a", 0.30, 0.02), said("b", 0.31, 0.02)])
    assert both["value"] == pytest.approx(0.305)
    assert both["high"] - both["low"] == pytest.approx(one["high"] - one["low"])
    swapped = together([said("a", 0.30, 0.02), said("b", 0.05, 0.02)])
    assert not both["why"]
    assert "0.300 kg in a, 0.050 kg in b" in swapped["why"]


def test_look_alikes_that_differ_in_mass_and_toys_of_unknown_stiffness_are_named() -> None:
    task = load_task("stack_two_cubes")
    first = task.manipulated[0]
    second = next(key for key in task.objects if key != first)
    twins = replace(task, objects={**task.objects, second: replace(task.objects[first], id=second)})
    found = {first: together([said("a", 0.3, 0.02)]), second: together([said("a", 0.1, 0.02)])}
    assert "look alike and weigh 0.300 and 0.100 kg" in unlike(twins, found)[0]
    assert not unlike(twins, {first: found[first], second: found[first]})
    red = replace(twins.objects[second], color_srgb=(1, 2, 3))
    assert not unlike(replace(twins, objects={**twins.objects, second: red}), found)
    (note,) = unlike(load_task("sloth_into_basket"), {"sloth": found[first]})
    assert note.startswith("sloth of sloth_into_basket: its stiffness is not determined")


PUSHED_KG, RUBS, PUSH = 0.3, 0.25, "push_cube_to_mark"
Pushed = tuple[RunFolder, Episode, Task]


@pytest.fixture(scope="module")
def push(tmp_path_factory: pytest.TempPathFactory) -> Pushed:
    """A cube that weighs 300 g and not 120 g, pushed once over a table by MuJoCo's contacts."""
    made = RunFolder.create(tmp_path_factory.mktemp("pushed") / "run")
    episode, task, _ = one_trial(made.episodes_dir, "standin", 9_000_000, PUSH, PUSHED_KG, RUBS)
    return made, episode, task


def test_a_push_alone_says_friction_x_weight_and_nothing_else(
    push: Pushed, capsys: pytest.CaptureFixture[str]
) -> None:
    run, _, task = push
    assert cli.calibrate(run.path, config=CalibrateConfig(physics=True)) == 0
    told, known = capsys.readouterr().out, read_calibration(run)
    assert known is not None
    drag = known.record[MASSES]["tasks"][PUSH]["cube"]["drag"]
    assert drag["low"] < PUSHED_KG * RUBS * 9.81 < drag["high"] < 2 * drag["low"]
    assert re.search("neither mass nor friction\n    standin_9000000, 3", told)
    assert for_task(ReplayConfig(), known, task).physics == ReplayConfig().physics


def test_a_look_alike_that_was_lifted_gives_replays_the_friction(push: Pushed) -> None:
    run, episode, task = push
    found: dict[str, Any] = {PUSH: {"cube": {"drag": together(weighed(episode, task), "drag_N")}}}
    lift = said("lift", PUSHED_KG, 0.01) | {"from_s": 1.0, "to_s": 2.0}
    found["other"] = {"block": together([lift])}
    block = replace(task.objects["cube"], id="block", mass_kg=1.0)
    weights.share_masses({PUSH: task, "other": replace(task, objects={"block": block})}, found)
    rubs = found[PUSH]["cube"]["friction"]
    assert rubs["low"] < RUBS < rubs["high"] < 1.4 * rubs["low"]
    record, _ = write_part(run, MASSES, {"tasks": found, "notes": [], "not_determined": {}})
    assert "of friction [0.2" in weights.describe_weights(record, "x")
    scene = read_rebuilt_scene(run, task)
    config = for_task(ReplayConfig(), read_calibration(run), task)
    assert scene.task.objects["cube"].mass_kg == PUSHED_KG
    surface = config.physics.surface_friction
    assert surface * config.physics.object_friction == pytest.approx(rubs["value"])
    assert dict(config.variation.calibrated)["surface_friction"] == rubs["sigma_log"]
    (drawn,) = draw_beforehand(1, {})
    assert with_draw(drawn, scene, config)[1].physics.surface_friction == surface


def test_a_push_in_noise_one_of_several_and_those_that_do_not_agree_are_named(
    push: Pushed, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, episode, task = push
    rows = [{"episode": "a", "drag_N": drag_N, "half_N": 0.1} for drag_N in (1.0, 3.0)]
    assert "1.000 N in a, 3.000 N in a" in together(rows, "drag_N")["why"]
    with pytest.raises(NoWeightError, match="2 pushes: nobody said which"):
        weighed(episode, replace(task, stages=task.stages * 2))
    read, rng = weights.readings, np.random.default_rng(0)
    noisy = lambda *a: (*(got := read(*a))[:2], rng.normal(got[2], 3.0))  # noqa: E731
    monkeypatch.setattr(weights, "readings", noisy)
    with pytest.raises(NoWeightError, match="no push is felt clearly"):
        weighed(episode, task)
