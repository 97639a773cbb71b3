"""RTDE packages, recipes, gripper signals and the arm's messages, against the guide's layout."""

import json
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.episode.cdr.batch import joint_writer, pose_writer
from bridge.episode.cdr.messages import FrameTransform, JointSample, PoseSample, transforms_to_cdr
from bridge.episode.cdr.messages import transforms_from_cdr as read_transforms
from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.robots.default import ARM_JOINTS
from bridge.sources.ur import messages, rtde
from bridge.sources.ur.config import UrConfig, parse_signal
from bridge.sources.ur.messages import tool_pose
from bridge.task.record import check_record


@given(
    st.lists(st.tuples(st.sampled_from(list(rtde.Kind)), st.binary(max_size=80)), max_size=20),
    st.integers(1, 40),
)
def test_packages_survive_any_way_of_being_cut(
    packages: list[tuple[rtde.Kind, bytes]], size: int
) -> None:
    stream = b"".join(rtde.encode_package(kind, payload) for kind, payload in packages)
    splitter = rtde.PackageSplitter()
    found = [
        package
        for start in range(0, len(stream), size)
        for package in splitter.feed(stream[start : start + size])
    ]
    assert found == [rtde.Package(kind=kind, payload=payload) for kind, payload in packages]


@given(st.binary(max_size=300))
def test_bytes_that_are_no_rtde_are_refused_or_waited_for(data: bytes) -> None:
    splitter = rtde.PackageSplitter()
    try:
        found = list(splitter.feed(data))
    except rtde.BrokenPackageError:
        return
    assert all(package.kind in set(rtde.Kind) for package in found)


@pytest.mark.parametrize("greeting", [b"SSH-2.0-OpenSSH_9.6\r\n", b"HTTP/1.1 400 Bad", b"\0\0V"])
def test_another_protocol_is_recognised_at_once(greeting: bytes) -> None:
    with pytest.raises(rtde.BrokenPackageError, match="it sent"):
        list(rtde.PackageSplitter().feed(greeting))


def test_a_recipe_reads_every_type() -> None:
    types = ("BOOL", "UINT8", "UINT32", "UINT64", "INT32", "DOUBLE", "VECTOR3D", "VECTOR6D")
    types += ("VECTOR6INT32", "VECTOR6UINT32")
    names = tuple(name.lower() for name in types)
    payload = struct.pack(">B?BIQid3d6d6i6I", 7, True, 1, 2, 3, -4, 0.5, *range(21))
    values = rtde.Recipe(names, types, 7).unpack(payload)
    assert values["bool"] is True
    assert (values["uint64"], values["int32"], values["double"]) == (3, -4, 0.5)
    assert values["vector6d"] == (3.0, 4.0, 5.0, 6.0, 7.0, 8.0)
    assert values["vector6uint32"] == (15, 16, 17, 18, 19, 20)


def test_data_of_another_length_or_recipe_is_refused() -> None:
    recipe = rtde.Recipe(("timestamp",), ("DOUBLE",), 1)
    with pytest.raises(rtde.BrokenPackageError, match="8 bytes, expected 9"):
        recipe.unpack(bytes(8))
    with pytest.raises(rtde.BrokenPackageError, match="recipe 2, expected 1"):
        recipe.unpack(b"\x02" + bytes(8))
    with pytest.raises(rtde.BrokenPackageError, match="MATRIX"):
        rtde.Recipe(("a",), ("MATRIX",), 1)


@given(st.binary(max_size=40))
def test_any_text_message_can_be_read(payload: bytes) -> None:
    rtde.text_of(payload)
    assert rtde.text_of(b"\x02hi\x03urc\x01") == "urc: hi"


def test_a_gripper_on_a_tool_input() -> None:
    config = UrConfig(gripper="digital_in:17", gripper_open_value=1.0, gripper_closed_value=0.0)
    gripper = config.make_gripper()
    assert gripper is not None
    assert gripper.width_m({"actual_digital_input_bits": 1 << 17}) == 0.085
    assert gripper.width_m({"actual_digital_input_bits": 0xFFFF}) == 0.0


@given(st.floats(-1e9, 1e9))
def test_a_width_stays_between_its_ends(volts: float) -> None:
    config = UrConfig(
        gripper="tool_analog_in:0",
        gripper_open_value=0.0,
        gripper_closed_value=10.0,
        gripper_open_m=0.14,
        gripper_closed_m=0.002,
    )
    gripper = config.make_gripper()
    assert gripper is not None
    width_m = gripper.width_m({"tool_analog_input0": volts})
    assert 0.002 - 1e-12 <= width_m <= 0.14 + 1e-12
    assert gripper.width_m({"tool_analog_input0": 5.0}) == pytest.approx(0.071)


def test_a_robotiq_position_in_a_register() -> None:
    config = UrConfig(gripper="double_register:0", gripper_closed_value=255.0)
    gripper = config.make_gripper()
    assert gripper is not None
    assert gripper.width_m({"output_double_register_0": 51.0}) == pytest.approx(0.068)


@pytest.mark.parametrize("text", ["digital_in:18", "analog_in:2", "voltage:0", "digital_in", ""])
def test_signals_that_do_not_exist_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="is no signal"):
        parse_signal(text)
    with pytest.raises(UsageError):
        UrConfig(gripper=text)


def test_settings_that_tell_nothing_are_refused() -> None:
    with pytest.raises(UsageError, match="tell an open gripper"):
        UrConfig(gripper_open_value=1.0, gripper_closed_value=1.0)
    with pytest.raises(UsageError, match="rate-hz"):
        UrConfig(rate_hz=0.0)


def T_base_link_tcp(reported: np.ndarray) -> np.ndarray:
    x, y, z, qx, qy, qz, qw = tool_pose(reported.tolist())
    assert qw >= 0
    return se3.transform_from(np.array([qw, qx, qy, qz]), np.array([x, y, z]))


def test_the_tool_pose_agrees_with_the_urdf_and_the_vendors_table() -> None:
    """Denavit-Hartenberg numbers of the UR5 (vendor's table) against the URDF, by Pinocchio."""
    pinocchio = pytest.importorskip("pinocchio")
    from scipy.spatial.transform import Rotation

    from bridge.robots.default import ROBOT

    model = pinocchio.buildModelFromXML(ROBOT.arm_urdf())
    data = model.createData()
    rng = np.random.default_rng(3)
    rows = [
        (0.089159, 0.0, np.pi / 2),
        (0.0, -0.425, 0.0),
        (0.0, -0.39225, 0.0),
        (0.10915, 0.0, np.pi / 2),
        (0.09465, 0.0, -np.pi / 2),
        (0.0823, 0.0, 0.0),
    ]
    for q in rng.uniform(-np.pi, np.pi, (20, 6)):
        T_base_tool = np.eye(4)
        for angle, (d, a, alpha) in zip(q, rows, strict=True):
            ca, sa = np.cos(alpha), np.sin(alpha)
            c, s = np.cos(angle), np.sin(angle)
            T_base_tool = T_base_tool @ np.array(
                [
                    [c, -s * ca, s * sa, a * c],
                    [s, c * ca, -c * sa, a * s],
                    [0, sa, ca, d],
                    [0, 0, 0, 1],
                ]
            )
        rotation_vector = Rotation.from_matrix(T_base_tool[:3, :3]).as_rotvec()
        reported = np.concatenate([T_base_tool[:3, 3], rotation_vector])
        pinocchio.framesForwardKinematics(model, data, q)
        expected = data.oMf[model.getFrameId("tool0")].homogeneous
        np.testing.assert_allclose(T_base_link_tcp(reported), expected, atol=2e-5)


def test_no_rotation_is_a_pose_too() -> None:
    T = T_base_link_tcp(np.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(T[:3, 3], [-0.1, -0.2, 0.3])
    np.testing.assert_allclose(T[:3, :3], np.diag([-1.0, -1.0, 1.0]), atol=1e-12)


stamps = st.integers(0, 2**31 * 10**9 - 1)
numbers = st.floats(-1e6, 1e6)


@given(stamps, st.lists(numbers, min_size=12, max_size=12))
def test_joint_states_are_those_of_the_record(stamp_ns: int, values: list[float]) -> None:
    expected = JointSample(
        stamp_ns=stamp_ns,
        names=ARM_JOINTS,
        position=np.array(values[:6]),
        velocity=np.array(values[6:]),
        effort=np.zeros(0),
    )
    assert joint_writer(ARM_JOINTS, velocities=True)(stamp_ns, values) == expected.to_cdr()


@given(stamps, st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6))
def test_poses_and_frames_are_those_of_the_record(stamp_ns: int, pose: list[float]) -> None:
    turned = messages.tool_pose(pose)
    found = PoseSample.from_cdr(pose_writer("base_link")(stamp_ns, turned))
    assert (found.stamp_ns, found.frame_id) == (stamp_ns, "base_link")
    q_wxyz, p_m = np.array([turned[6], *turned[3:6]]), np.array(turned[:3])
    np.testing.assert_allclose(found.T_frame_body, se3.transform_from(q_wxyz, p_m), atol=1e-12)
    (item,) = read_transforms(messages.frame_writer("base_link")(stamp_ns, turned))
    assert (item.parent, item.child) == ("base_link", "tool0_controller")
    np.testing.assert_array_equal(item.T_parent_child, found.T_frame_body)
    again = FrameTransform(
        stamp_ns=stamp_ns, parent=item.parent, child=item.child, T_parent_child=np.eye(4)
    )
    identity = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    filled = messages.frame_writer("base_link")(stamp_ns, identity)
    assert filled == transforms_to_cdr([again])


def test_forces_are_turned_like_positions() -> None:
    wrench = messages.tool_wrench((1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
    assert wrench == (-1.0, -2.0, 3.0, -4.0, -5.0, 6.0)


@pytest.mark.parametrize("modes", [(7, 3), (None, 1), (99, None)])
def test_modes_are_events_of_the_schema(modes: tuple[int | None, int | None]) -> None:
    message = messages.mode_event("lab", *modes, 5)
    record = json.loads(message.data)
    check_record(record, name="event", package="bridge.episode")
    assert (message.topic, record["stamp_ns"]) == ("/lab/event", 5)
    if modes == (7, 3):
        assert record["text"] == "robot mode RUNNING, safety mode PROTECTIVE_STOP"
