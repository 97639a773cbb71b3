"""A run with two trials whose objects are known, a scene of a few Gaussians, and two cameras."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "replay"))
sys.path.insert(0, str(Path(__file__).parent))

from drawn_run import CAMERA, HOME, block, write_recording, write_scene
from scripted_plans import scene_of_test
from scripted_policies import Scripted

from bridge.episode.run_folder import RunFolder
from bridge.media.color import encode_png
from twin.policies import starts
from twin.policies.starts import Start
from twin.replay.config import ReplayConfig
from twin.replay.scene import StartState, StartStates
from twin.scene.localise.episode import Phase


@pytest.fixture
def start() -> Start:
    """The arm over a table with a cube and a box."""
    return Start(
        id="one",
        episode_path=Path("none.mcap"),
        scene=scene_of_test(),
        joints_rad=HOME,
        width_m=0.085,
        stamp_ns=0,
        config=ReplayConfig(),
    )


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunFolder:
    """Two trials of cube_into_box; where their objects were, a person has measured."""
    folder, scene = RunFolder.create(tmp_path / "run"), scene_of_test()
    write_scene(folder, scene, "cube", block())
    shape = (CAMERA.height, CAMERA.width, 3)  # grey that gets lighter
    shades = tuple(encode_png(np.full(shape, 20 * index, dtype=np.uint8)) for index in range(11))
    for number in (1, 2):
        about = {"start_id": f"start {number}", "policy": "Scripted"}
        begun = Scripted().path.joints_rad[0]
        write_recording(folder, scene.urdf, f"trial_{number}", home=begun, images=shades, **about)
    state = StartState(Ts_base_object=scene.Ts_base_object)
    phase = Phase(name="start", plan_id=None, after_ns=None, before_ns=None)

    def measured(*_: object, **__: object) -> StartStates:
        return StartStates(scene.task, [phase], [state])

    monkeypatch.setattr(starts, "localised_starts", measured)
    return folder
