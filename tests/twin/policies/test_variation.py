"""Varied rollouts, the light of trials, and the visual gap: what is drawn and what it changes."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from drawn_run import T0
from test_rollouts import QUIET, config

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.exchange.trials_csv import read_trials
from bridge.geometry import se3
from twin.policies import colours
from twin.policies.cell import TwinCell
from twin.policies.colours import gains_of
from twin.policies.errors import PolicyError
from twin.policies.gap import State, describe_gap, recorded_states, visual_gap
from twin.policies.mapping import DEFAULT, Interpreter
from twin.policies.policy import open_policy
from twin.policies.runs import TABLE, describe_rollouts, roll_out_run
from twin.policies.starts import Start, open_start, trial_episodes
from twin.policies.variation import draw, effects, read_quantities, varied_start
from twin.policies.views import Gains, TwinCameras, lit
from twin.robot.model import load_robot
from twin.robot.posture import Posture, PostureTrack
from twin.scene.render import render
from twin.scene.settings import RenderConfig

ALL = ("light=20%", "mass=30%,friction=10%", "objects.position=10mm", "camera.side.angle=3deg")


def test_values_fill_their_spread_and_depend_on_nothing_but_their_own_name() -> None:
    quantities = read_quantities(ALL)
    rows = [draw(quantities, 1, "start", number) for number in range(400)]
    for item in quantities:
        values = np.array([row[item.name] for row in rows])
        assert values.shape[1] == item.size
        assert np.abs(values).max() <= item.spread
        np.testing.assert_allclose(values.std(axis=0), item.spread / np.sqrt(3), rtol=0.1)
        np.testing.assert_allclose(values.mean(axis=0), 0.0, atol=0.1 * item.spread)
    alone = draw(read_quantities(("mass=30%",)), 1, "start", 7)
    assert alone["mass"] == rows[7]["mass"] != draw(quantities, 1, "another", 7)["mass"]


@pytest.mark.parametrize(
    "wrong", ["light", "light=20mm", "colour=3%", "mass=0%", "mass=100%", "mass=1%,mass=2%", "=1%",
              "camera.side.position=3%", "camera.side=3mm", "light=-2%", "light=nan%"]
)  # fmt: skip
def test_what_makes_no_sense_is_refused_by_its_words(wrong: str) -> None:
    with pytest.raises(UsageError, match="--vary"):
        read_quantities((wrong,))


def test_masses_frictions_and_places_are_changed_by_their_shares(start: Start) -> None:
    drawn = {"mass": (0.25,), "friction": (-0.5,), "objects.position": (0.01, -0.02)}
    varied = varied_start(start, drawn)
    was, now = start.task.objects, varied.task.objects
    assert now["cube"].mass_kg == pytest.approx(1.25 * was["cube"].mass_kg)
    assert now["box"] == was["box"]  # it is fixed
    physics = varied.config.physics
    assert physics.object_friction == pytest.approx(start.config.physics.object_friction / 2)
    assert physics.finger_friction == pytest.approx(start.config.physics.finger_friction / 2)
    moved = varied.scene.Ts_base_object["cube"] - start.scene.Ts_base_object["cube"]
    np.testing.assert_allclose(moved[:3, 3], [0.01, -0.02, 0.0], atol=1e-12)
    np.testing.assert_array_equal(
        varied.scene.Ts_base_object["box"], start.scene.Ts_base_object["box"]
    )


def test_cameras_turn_about_themselves(run: RunFolder) -> None:
    start = open_start(run, trial_episodes(run, "")[0])
    plain = TwinCameras(run, start)
    drawn = {"camera.side.angle": (0.0, 0.0, 0.1), "camera.side.position": (0.0, 0.0, 0.02)}
    moved = TwinCameras(run, start, drawn=drawn)
    T = se3.invert(plain.viewpoints["side"].T_base_camera) @ moved.viewpoints["side"].T_base_camera
    np.testing.assert_allclose(se3.vector_from_rotation(T[:3, :3]), [0, 0, 0.1], atol=1e-9)
    np.testing.assert_allclose(T[:3, 3], [0, 0, 0.02], atol=1e-9)
    wrist = [cameras.viewpoints["wrist"].T_tcp_camera for cameras in (moved, plain)]
    assert wrist[0] is not None
    np.testing.assert_allclose(*wrist, atol=1e-12)


def test_a_rollout_begins_when_its_trial_moved(run: RunFolder) -> None:
    """Not before: pictures are as old as they were then."""
    start = open_start(run, trial_episodes(run, "")[0])
    assert T0 <= start.stamp_ns <= T0 + 200_000_000  # it moves from its first joint state on
    shutters = TwinCameras(run, start).shutters.values()
    assert {shutter.first_ns for shutter in shutters} == {T0 - start.stamp_ns}


def rows_where(is_failure: np.ndarray, amounts: np.ndarray) -> list[dict[str, Any]]:
    return [
        {"success": not bad, "varied": {"light": a, "mass": b}}
        for bad, (a, b) in zip(is_failure, amounts, strict=True)
    ]


def test_the_quantity_that_goes_with_failure_is_found_and_no_other() -> None:
    quantities = read_quantities(("light=50%", "mass=50%"))
    amounts = np.random.default_rng(3).uniform(-50, 50, (60, 2))
    rows = rows_where(np.abs(amounts[:, 0]) > 25, amounts)
    light, mass = effects([*rows, {"success": None, "varied": {}}], quantities)
    assert light["high"] < 0 < mass["high"]
    assert mass["low"] < 0
    assert sum(light["varied_most"]) + sum(light["varied_least"]) >= 60
    assert not list(effects(rows[:7], quantities))


def test_the_interval_is_newcombes() -> None:
    """His example: 56 of 70 against 48 of 80 gives 0.20 [0.0524, 0.3339] (1998, table II, (a))."""
    most = np.arange(150) < 70
    amounts = np.column_stack([np.where(most, 2.0, 1.0)] * 2)
    failed = np.concatenate([np.arange(70) >= 56, np.arange(80) >= 48])
    found = next(effects(rows_where(failed, amounts), read_quantities(("light=50%", "mass=50%"))))
    assert found["difference"] == pytest.approx(0.2)
    assert (found["low"], found["high"]) == pytest.approx((0.0524, 0.3339), abs=5e-5)


def test_varied_rollouts_say_what_was_drawn_and_stay_out_of_the_comparison(run: RunFolder) -> None:
    roll_out_run(run, config("Scripted"), QUIET)
    before = read_trials(run.path / TABLE)
    asked = replace(config("Scripted", times=4, max_s=30.0), vary=("objects.position=25mm",))
    found = roll_out_run(run, asked, QUIET)
    drawn = [row["varied"]["objects.position"] for row in found["rows"]]
    assert len(set(drawn)) == 8
    assert 0 < min(drawn) < max(drawn) <= 25 * np.sqrt(2)
    assert {row["success"] for row in found["rows"]} == {True, False}  # it does not look
    assert "objects.position: beyond" in describe_rollouts(found)
    assert read_trials(run.path / TABLE) == before
    with pytest.raises(UsageError, match="no camera top in trial_1; it has: side, wrist"):
        roll_out_run(run, replace(asked, vary=("camera.top.position=3mm",)), QUIET)


LIGHT = (0.75, 0.8, 1.3)
CAMERAS = ("side", "wrist")


def seen(run: RunFolder, light: tuple[float, ...], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Let trials show noise in a light, one part of it something else; which were looked at."""
    rng, asked = np.random.default_rng(0), []

    def states(_: RunFolder, episode: Episode, names: tuple[str, ...], count: int) -> list[State]:
        asked.append(episode.info.id)
        found = []
        for _ in range(count):
            drawn = {name: rng.integers(0, 256, (1, 1, 3)) for name in names}
            drawn = {name: np.tile(x, (122, 163, 1)) for name, x in drawn.items()}
            for x in drawn.values():
                x[::8] = rng.integers(60, 200, (1, 163, 3))
                x[:, :80] = rng.integers(30, 180, (122, 80, 3))
            shown = {name: x * light + rng.normal(0, 3, x.shape) for name, x in drawn.items()}
            for x in shown.values():
                x[:30] = 90  # somebody stands there
            u8 = {name: np.clip(x, 0, 255).astype(np.uint8) for name, x in shown.items()}
            posture = Posture(joints_rad=np.zeros(6), width_m=0.0)
            rendered = {name: x.astype(np.uint8) for name, x in drawn.items()}
            state = State(posture=posture, recorded=u8, following=u8, rendered=rendered)
            found.append(state)
        return found

    colours._ratios.cache_clear()
    monkeypatch.setattr(colours, "recorded_states", states)
    return asked


def test_another_light_is_found_in_other_trials(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = seen(run, LIGHT, monkeypatch)
    for path in run.episodes():
        found = gains_of(run, Episode.open(path), CAMERAS)
        assert found.keys() == set(CAMERAS)
        for gain in found.values():
            assert gain == pytest.approx(LIGHT, abs=0.02)
        assert path.stem not in asked
        asked.clear()
        colours._ratios.cache_clear()


def test_the_same_light_changes_nothing(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    seen(run, (1.01, 0.99, 1.0), monkeypatch)
    assert gains_of(run, Episode.open(run.episodes()[0]), CAMERAS) == {}


def test_one_trial_alone_teaches_nothing(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    seen(run, LIGHT, monkeypatch)
    last, *others = run.episodes()
    for path in others:
        path.unlink()
    colours._trials.cache_clear()
    assert gains_of(run, Episode.open(last), CAMERAS) == {}


def test_no_start_without_the_width(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """A gripper of which nobody spoke may hold something: it is not taken for open."""
    monkeypatch.setattr("twin.robot.posture.GRIPPER_STATE", "/nobody/says")
    with pytest.raises(PolicyError, match="trial_1 gives no start: nobody says the gripper's"):
        open_start(run, trial_episodes(run, "")[0])


def test_too_little_that_is_bright_enough_teaches_nothing(run: RunFolder) -> None:
    """The drawn run is almost black."""
    assert gains_of(run, Episode.open(run.episodes()[0]), CAMERAS) == {}


def test_a_policy_sees_the_light(run: RunFolder) -> None:
    start = open_start(run, Episode.open(run.episodes()[0]))
    cell = TwinCell(start)
    try:
        gains = {"wrist": LIGHT}
        plain = TwinCameras(run, start).draw(cell)
        found = TwinCameras(run, start, gains=gains).draw(cell)
        dark = TwinCameras(run, start, drawn={"light": (-0.5,)}, gains=gains).draw(cell)
    finally:
        cell.close()
    assert np.array_equal(found["side"], plain["side"])
    expected = np.clip(plain["wrist"] * np.array(LIGHT), 0, 255)
    assert np.abs(found["wrist"] - expected).max() <= 0.5 + 1e-3
    assert found["wrist"].max() > 100
    assert np.abs(dark["wrist"] - 0.5 * expected).max() <= 0.5 + 1e-3
    assert np.abs(dark["side"] - 0.5 * plain["side"]).max() <= 0.5 + 1e-3
    assert np.array_equal(lit(plain, gains)["wrist"], found["wrist"])


def gap_of(run: RunFolder, policy: str, gains: Gains | None = None) -> dict[str, object]:
    episode = Episode.open(run.episodes()[0])
    start = open_start(run, episode)
    assert TwinCameras(run, start).viewpoints.keys() == {"side", "wrist"}
    speak = Interpreter(DEFAULT, load_robot(start.scene.urdf), "do it")
    opened = open_policy(f"scripted_policies:{policy}", 1.0)
    return visual_gap(run, episode, opened, speak, 0, gains or {})


def test_brightness_is_what_it_goes_by(run: RunFolder) -> None:
    """Against pictures that `render` draws of the same instants."""
    found = gap_of(run, "brightness")
    assert found["instants"] == 10
    assert found["again"] == 0.0
    assert found["following"] == pytest.approx(20 / 255, abs=1e-6)
    shades = {}
    for camera in ("side", "wrist"):
        shades[camera] = []
        for index in range(10):
            config = RenderConfig(
                camera=camera, episode="trial_1", at_s=index * 0.2,
                out=run.path / f"{camera}_{index}.png",
            )  # fmt: skip
            render(run, config)
            shades[camera].append(mean_of(run, f"{camera}_{index}.png"))
    grey = np.arange(10) * 20 / 255
    side, wrist = (np.array(shades[name]) - grey for name in ("side", "wrist"))
    rms = {
        "all": np.sqrt(np.mean(((side + wrist) / 2) ** 2)),
        "side": np.sqrt(np.mean((side / 2) ** 2)),
        "wrist": np.sqrt(np.mean((wrist / 2) ** 2)),
    }
    assert found["rendered"] == pytest.approx(rms, abs=2e-3)
    assert rms["all"] > 0.05
    dark = {"side": (0.0, 0.0, 0.0), "wrist": (0.0, 0.0, 0.0)}
    found = gap_of(run, "brightness", dark)
    assert found["rendered"]["lit"] == pytest.approx(np.sqrt(np.mean(grey**2)), abs=1e-6)
    assert f"in the light of other trials {found['rendered']['lit']:.3g}" in describe_gap(found)[0]
    text = describe_gap(found)[0]
    assert f"by {rms['all']:.3g}"[:6] in text
    assert "10 states of trial_1" in text


def test_states_end_where_fingers_close(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    def closing(track: PostureTrack, stamp_ns: int) -> Posture:
        return replace(at(track, stamp_ns), width_m=0.05 - 0.01 * (stamp_ns > T0 + 700_000_000))

    at = PostureTrack.at
    monkeypatch.setattr(PostureTrack, "at", closing)
    states = recorded_states(run, trial_episodes(run, "")[0], CAMERAS, 20)  # pictures every 0.2 s
    assert [state.posture.width_m for state in states] == [0.05] * 4


def mean_of(run: RunFolder, name: str) -> float:
    from PIL import Image

    return float(np.asarray(Image.open(run.path / name)).mean()) / 255


def test_a_policy_that_sees_nothing_has_no_gap(run: RunFolder) -> None:
    found = gap_of(run, "still")
    assert found["rendered"] == {"all": 0.0, "side": 0.0, "wrist": 0.0}
    assert found["following"] == 0.0
    assert describe_gap(found)[0].endswith("is the same whatever it sees")
