"""What a policy is told, and how its rows become targets."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from bridge.errors import GstError
from twin.policies.errors import PolicyError, StoppedError
from twin.policies.mapping import Actions, Interpreter, PolicyMap, fitted, read_mapping
from twin.policies.starts import Start
from twin.robot.model import RobotModel, load_robot

DROID = """
rate_hz = 15
horizon = 8
[images."observation/exterior_image_1_left"]
camera = "side"
size = [224, 224]
[images.flat]
camera = "side"
order = "bgr"
layout = "chw"
scale = "0..1"
[state]
"observation/joint_position" = ["joints_rad"]
"observation/gripper_position" = ["closed"]
both = ["joints_deg", "tool_m", "tool_wxyz", "width_m", "open"]
[actions]
kind = "joint_velocity"
gripper = "closed"
binary_at = 0.5
"""


@pytest.fixture
def robot(start: Start) -> RobotModel:
    return load_robot(start.scene.urdf)


def speaker(robot: RobotModel, **actions: object) -> Interpreter:
    return Interpreter(PolicyMap(actions=Actions(**actions)), robot, "do it")  # type: ignore[arg-type]


def test_an_observation_has_what_the_file_asks_for(
    tmp_path: Path, robot: RobotModel, start: Start
) -> None:
    path = tmp_path / "droid.toml"
    path.write_text(DROID)
    speak = Interpreter(read_mapping(path), robot, "Put it away.")
    assert speak.cameras() == ("side",)
    assert speak.sizes() == {}  # one picture is wanted as it is
    picture = np.zeros((48, 64, 3), dtype=np.uint8)
    picture[..., 0] = 255
    found = speak.observation({"side": picture}, start.joints_rad, 0.02125)
    square = found["observation/exterior_image_1_left"]
    assert square.shape == (224, 224, 3)
    assert square[:28].max() == 0  # 224 x 168 in the middle of 224 x 224
    assert (square[28:196] == [255, 0, 0]).all()
    assert found["flat"].shape == (3, 48, 64)
    assert (found["flat"][2] == 1.0).all()
    assert found["flat"][0].max() == 0.0
    np.testing.assert_allclose(found["observation/joint_position"], start.joints_rad, rtol=1e-6)
    assert found["observation/gripper_position"] == pytest.approx([0.75])
    np.testing.assert_allclose(found["both"][:6], start.joints_rad * 180 / np.pi, rtol=1e-6)
    np.testing.assert_allclose(found["both"][6:9], robot.T_base_tcp(start.joints_rad)[:3, 3], 1e-5)
    assert found["both"][-2:] == pytest.approx([0.02125, 0.25])
    assert found["prompt"] == "Put it away."


def test_without_a_file_it_is_lerobots_own(robot: RobotModel, start: Start) -> None:
    picture = np.zeros((4, 4, 3), dtype=np.uint8)
    found = speaker(robot).observation({"side": picture}, start.joints_rad, 0.05)
    assert set(found) == {"pixels", "agent_pos", "task"}
    assert found["agent_pos"].tolist() == pytest.approx([*start.joints_rad, 0.05])


def test_rows_become_targets(robot: RobotModel, start: Start) -> None:
    now = start.joints_rad
    row = np.array([1, 2, 3, 4, 5, 6, 0.04])
    for actions, joints, width in (
        ({}, row[:6], 0.04),
        ({"degrees": True}, row[:6] * np.pi / 180, 0.04),
        ({"kind": "joint_delta", "scale": 0.1}, now + row[:6] / 10, 0.04),
        ({"kind": "joint_velocity"}, now + row[:6] / 10, 0.04),
        ({"gripper": "open"}, row[:6], 0.085 * 0.04),
        ({"gripper": "closed"}, row[:6], 0.085 * 0.96),
        ({"gripper": "closed", "binary_at": 0.01}, row[:6], 0.0),
        ({"gripper": "open", "binary_at": 0.5}, row[:6], 0.0),
    ):
        target, width_m = speaker(robot, **actions).target(row, now, 0.01)
        np.testing.assert_allclose(target, joints, atol=1e-12)
        assert width_m == pytest.approx(width), actions
    target, width_m = speaker(robot, gripper="none").target(row[:6], now, 0.01)
    assert width_m == 0.01


def test_the_tool_goes_where_it_is_sent(robot: RobotModel, start: Start) -> None:
    """Against pinocchio's own exponential map."""
    now = robot.T_base_tcp(start.joints_rad)
    turn = np.array([0.0, 0.1, -0.2])
    speak = speaker(robot, kind="ee_delta", gripper="none")
    target, _ = speak.target(np.array([0.01, -0.02, 0.03, *turn]), start.joints_rad, 0.0)
    reached = robot.T_base_tcp(target)
    np.testing.assert_allclose(reached[:3, 3], now[:3, 3] + [0.01, -0.02, 0.03], atol=6e-4)
    np.testing.assert_allclose(reached[:3, :3], pin.exp3(turn) @ now[:3, :3], atol=3e-3)
    q = pin.Quaternion(now[:3, :3])
    pose = np.array([*(now[:3, 3] + [0, 0, 0.05]), *(3 * np.array([q.w, q.x, q.y, q.z]))])
    target, _ = speaker(robot, kind="ee_pose", gripper="none").target(pose, start.joints_rad, 0.0)
    np.testing.assert_allclose(robot.T_base_tcp(target)[:3, 3], pose[:3], atol=6e-4)
    far = np.array([5.0, 0, 0, 0, 0, 0])
    with pytest.raises(StoppedError, match=r"reach: the arm does not bring the tool to .*mm and"):
        speak.target(far, start.joints_rad, 0.0)


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ({"action": [[0.0] * 7]}, "no 'actions'; it has: action"),
        ({"actions": [[0.0] * 8]}, r"shape \(1, 8\); joint_position of .* takes rows of 7"),
        ({"actions": np.zeros((0, 7))}, r"shape \(0, 7\)"),
        ({"actions": [[0.0] * 7, [np.nan] * 7]}, "not finite from row 1 on"),
        ({"actions": "open the gripper"}, "no numbers"),
        ({"actions": [[0.0] * 7, [0.0]]}, "no numbers"),
        (None, r"no numbers|shape"),
    ],
)
def test_an_answer_that_is_none_is_told(robot: RobotModel, answer: object, words: str) -> None:
    with pytest.raises(PolicyError, match=words):
        speaker(robot).rows(answer)


def test_one_row_is_a_chunk_of_one(robot: RobotModel) -> None:
    assert speaker(robot).rows(np.arange(7)).shape == (1, 7)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("rate = 3", "unknown field `rate`"),
        ("rate_hz = 0", "rate_hz 0 is not within"),
        ("horizon = -1", "horizon -1 is negative"),
        ("[actions]\nkind = 'velocity'", "Invalid enum value 'velocity'"),
        ("[", "mapping"),
    ],
)
def test_a_mapping_that_is_none_is_told(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "map.toml"
    path.write_text(text)
    with pytest.raises(PolicyError, match=words):
        read_mapping(path)
    with pytest.raises(GstError, match="mapping not found"):
        read_mapping(tmp_path / "none.toml")


@pytest.mark.parametrize("name", ["droid_joint_position", "lerobot_so101", "ur_joint_position"])
def test_with_a_ready_mapping_a_policy_that_answers_what_it_sees_stays(
    robot: RobotModel, name: str
) -> None:
    folder = Path(__file__).parents[3] / "examples" / "policies"
    speak = Interpreter(read_mapping(folder / f"{name}.toml"), robot, "Put it away.")
    assert set(speak.cameras()) == {"side", "wrist"}
    pictures = dict.fromkeys(speak.cameras(), np.zeros((48, 64, 3), dtype=np.uint8))
    joints_rad, width_m = np.linspace(-1.0, 1.0, 6), robot.record.gripper.max_width_m
    found = speak.observation(pictures, joints_rad, width_m)
    assert found[speak.mapping.prompt_key] == "Put it away."
    seen = np.concatenate([found[key] for key in speak.mapping.state])
    (row,) = speak.rows({speak.mapping.actions.key: seen})
    wanted_rad, wanted_m = speak.target(row, np.zeros(6), 0.0)
    np.testing.assert_allclose(wanted_rad, joints_rad, atol=1e-6)
    assert wanted_m == pytest.approx(width_m)


def test_a_picture_is_fitted_in_black() -> None:
    tall = np.full((64, 32, 3), 200, dtype=np.uint8)
    found = fitted(tall, (64, 64))
    assert found.shape == (64, 64, 3)
    assert (found[:, 16:48] == 200).all()
    assert found[:, :16].max() == found[:, 48:].max() == 0
