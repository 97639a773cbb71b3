"""Varied rollouts: what is drawn, what it changes, and which of it goes with failure."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_rollouts import QUIET, config

from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.exchange.trials_csv import read_trials
from bridge.geometry import se3
from twin.policies.cell import TwinCell
from twin.policies.runs import TABLE, describe_rollouts, roll_out_run
from twin.policies.starts import Start, open_start, trial_episodes
from twin.policies.variation import draw, effects, read_quantities, varied_start
from twin.policies.views import TwinCameras

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


def test_cameras_turn_about_themselves_and_light_scales_pictures(run: RunFolder) -> None:
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
    cell = TwinCell(start)
    dim = TwinCameras(run, start, drawn={"light": (-0.5,)}).draw(cell)
    bright = plain.draw(cell)
    cell.close()
    for name, picture in bright.items():
        assert picture.max() > 100
        np.testing.assert_allclose(dim[name], picture / 2, atol=0.51)


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
