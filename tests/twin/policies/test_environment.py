"""The twin as Gymnasium has it."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from drawn_run import GREY, cloud
from gymnasium.utils.env_checker import check_env

from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.geometry import se3
from twin.policies.environment import ID, TwinEnv
from twin.policies.shutter import ALWAYS
from twin.replay.images import Drawable
from twin.robot.posture import Posture
from twin.scene.gaussians import as_float32
from twin.scene.raster.backend import open_rasteriser
from twin.scene.shape.sdf import SdfGrid

pytestmark = pytest.mark.filterwarnings("ignore:.*WARN.*")


def states(env: TwinEnv, actions: list[np.ndarray], **options: str) -> list[bytes]:
    env.reset(options=options)
    found = []
    for action in actions:
        observation, _, _, _, _ = env.step(action)
        pixels = observation["pixels"]
        found.append(b"".join(pixels[name].tobytes() for name in sorted(pixels)))
        found.append(observation["agent_pos"].tobytes())
    return found


def test_gymnasium_finds_nothing_wrong(run: RunFolder) -> None:
    env = gymnasium.make(ID, run=str(run.path), size=(32, 32), render_mode="rgb_array")
    check_env(env.unwrapped, skip_render_check=True)
    observation, info = env.reset(seed=3)
    assert observation["pixels"]["side"].shape == (24, 32, 3)
    assert info["start_id"] == "drawn_3_0"
    picture = env.render()
    assert isinstance(picture, np.ndarray)
    np.testing.assert_array_equal(picture, observation["pixels"]["side"])
    env.close()


def test_the_same_actions_give_the_same_bytes(run: RunFolder) -> None:
    env = TwinEnv(run.path, size=(32, 32))
    start = env.reset()[0]["agent_pos"].astype(float)
    rng = np.random.default_rng(1)
    actions = [start + np.append(rng.normal(0, 0.02, 6), 0.0) for _ in range(4)]
    first = states(env, actions, start_id="start 2")
    assert states(env, actions, start_id="start 2") == first
    assert states(env, actions[::-1], start_id="start 2") != first
    env.close()


def test_an_action_takes_effect_after_the_latency(run: RunFolder) -> None:
    env = TwinEnv(run.path, cameras=["side"], latency_s=0.2)
    start = env.reset()[0]["agent_pos"].astype(float)
    turned = start + np.array([0.1, 0, 0, 0, 0, 0, 0])
    went = [env.step(turned)[0]["agent_pos"][0] - start[0] for _ in range(4)]
    assert np.abs(went[:2]).max() < 0.005
    assert went[3] > 0.09
    env.close()


@pytest.mark.parametrize(
    ("control", "action"),
    [
        ("joint_velocity", [1.0, 0, 0, 0, 0, 0, 0.08]),
        ("joint_delta", [0.1, 0, 0, 0, 0, 0, 0.08]),
    ],
)
def test_kinds_of_control_mean_the_same(run: RunFolder, control: str, action: list[float]) -> None:
    env = TwinEnv(run.path, cameras=["side"], control=control)  # type: ignore[arg-type]
    before = env.reset()[0]["agent_pos"]
    for _ in range(3):
        found = env.step(np.array(action))[0]["agent_pos"]
    assert found[0] - before[0] == pytest.approx(0.3, abs=0.03)
    assert env.action_space.shape == (7,)
    env.close()


def test_a_limit_ends_the_episode_with_its_name(run: RunFolder) -> None:
    env = TwinEnv(run.path, cameras=["side"])
    start = env.reset()[0]["agent_pos"].astype(float)
    _, reward, over, cut, info = env.step(start + np.array([3.0, 0, 0, 0, 0, 0, 0]))
    assert (reward, over, cut) == (0.0, True, False)
    assert info["stopped"].startswith("limits: shoulder_pan_joint moves at 30.00 rad/s")
    assert info["is_success"] is False
    env.close()


def test_time_is_up(run: RunFolder) -> None:
    env = TwinEnv(run.path, cameras=["side"], max_s=0.3)
    action = env.reset()[0]["agent_pos"]
    assert [env.step(action)[3] for _ in range(3)] == [False, False, True]
    env.close()


def test_what_is_not_there_is_told(run: RunFolder) -> None:
    with pytest.raises(Exception, match="no camera top in trial_1; it has: side, wrist"):
        TwinEnv(run.path, cameras=["top"])
    env = TwinEnv(run.path, cameras=["side"])
    with pytest.raises(UsageError, match=r"call reset\(\) before step"):
        env.step(np.zeros(7))
    with pytest.raises(UsageError, match=r"no start 'x' in .*; there are: start 1, start 2"):
        env.reset(options={"start_id": "x"})


def with_a_table(drawable: Drawable, T_base_cube: np.ndarray) -> Drawable:
    """The same on a table, of which a solid cube covers what is in it."""
    grid = np.mgrid[-0.1:0.1:40j, -0.1:0.1:40j].reshape(2, -1).T
    points = np.column_stack([grid, np.zeros(len(grid))]) + T_base_cube[:3, 3]
    x, y, z = (np.mgrid[:9, :9, :9] - 4) * 0.01
    box = np.maximum(np.maximum(abs(x), abs(y)), abs(z)) - 0.02
    sdf = SdfGrid(values_m=as_float32(box), origin_m=np.full(3, -0.04), voxel_m=0.01)
    objects = dict(drawable.parts.objects)
    objects["cube"] = replace(objects["cube"], sdf=sdf)
    parts = replace(drawable.parts, background=cloud(points, GREY), objects=objects)
    return replace(drawable, parts=parts)


def test_pictures_are_those_of_drawing_everything_anew(run: RunFolder) -> None:
    env = TwinEnv(run.path)
    start = env.reset()[0]["agent_pos"].astype(float)
    cell, cameras, rasteriser = env._opened(), env._cameras, open_rasteriser()
    begun = cell.sight(0).places
    cameras.shutters = dict.fromkeys(cameras.shutters, ALWAYS)
    drawable = with_a_table(cameras._drawable, begun["cube"])
    cameras._drawable, cameras._resting = drawable, None
    # The cube rests, moves, rests again; the arm moves all the time.
    for step, shift_m in enumerate((0.0, 0.0, 0.01, 0.03, 0.03, 0.03)):
        cell.go(start[:6] + np.array([0.01 * step, 0, 0, 0, 0, 0]), start[6], 0.1)
        at = np.array([shift_m, shift_m, 0.0])
        places = begun | {"cube": se3.transform_from(np.eye(4)[0], at) @ begun["cube"]}
        with pytest.MonkeyPatch.context() as patch:
            seen = cell.sight(cell.t_ns)._replace(places=places)
            patch.setattr(cell, "sight", lambda _, seen=seen: seen)
            pictures = cameras.draw(cell)
        joints_rad, width_m = cell.posture()
        everything = drawable.at(places, {}, Posture(joints_rad=joints_rad, width_m=width_m))
        for name, place in cameras.viewpoints.items():
            T = place.T(cell.robot.T_base_tcp(joints_rad))
            wanted = drawable.parts.draw(rasteriser, everything, place.camera, T).image_u8
            np.testing.assert_array_equal(pictures[name], wanted)
    env.close()
