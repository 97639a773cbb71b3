"""The visual gap of a policy that goes by brightness is the difference of brightness."""

import numpy as np
import pytest

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from twin.policies.gap import describe_gap, visual_gap
from twin.policies.mapping import DEFAULT, Interpreter
from twin.policies.policy import open_policy
from twin.policies.starts import open_start
from twin.policies.views import Gains, TwinCameras
from twin.robot.model import load_robot
from twin.scene.render import render
from twin.scene.settings import RenderConfig


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


def mean_of(run: RunFolder, name: str) -> float:
    from PIL import Image

    return float(np.asarray(Image.open(run.path / name)).mean()) / 255


def test_a_policy_that_sees_nothing_has_no_gap(run: RunFolder) -> None:
    found = gap_of(run, "still")
    assert found["rendered"] == {"all": 0.0, "side": 0.0, "wrist": 0.0}
    assert found["following"] == 0.0
    assert describe_gap(found)[0].endswith("is the same whatever it sees")
