"""The light of trials is known from other trials, by its effect on what was drawn."""

import numpy as np
import pytest

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from twin.policies import colours
from twin.policies.cell import TwinCell
from twin.policies.colours import gains_of
from twin.policies.gap import State
from twin.policies.starts import open_start
from twin.policies.views import TwinCameras, lit
from twin.robot.posture import Posture

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
    assert found["wrist"].max() > 0
    assert np.abs(dark["wrist"] - 0.5 * expected).max() <= 0.5 + 1e-3
    assert np.array_equal(lit(plain, gains)["wrist"], found["wrist"])
