"""The example's policies find what they see, by a camera model of another hand."""

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageDraw

sys.path.insert(0, str(Path(__file__).parents[3] / "examples" / "policies"))

from look_and_pick import COLORS, LookAndPick, miss_20

from bridge.geometry import se3
from bridge.sources.standin.cell_file import load_cell

RED, BLUE = (200, 45, 40), (40, 90, 190)


def picture(
    T_base_tcp: np.ndarray, squares: list[tuple[tuple[int, ...], np.ndarray]]
) -> np.ndarray:
    """Squares in a grey room, as the stand-in's cell file mounts the camera on ``tool0``."""
    mount = load_cell("standin").cameras["wrist"]
    T_tool_tcp = se3.transform_from(np.eye(4)[0], np.array([0.0, 0.0, 0.14]))
    T_camera_base = se3.invert(T_base_tcp @ se3.invert(T_tool_tcp) @ mount.T_parent_camera)
    drawn = Image.new("RGB", (mount.camera.width * 4, mount.camera.height * 4), (120, 120, 120))
    for color, corners in squares:
        pixels, _ = mount.camera.project(se3.apply(T_camera_base, corners))
        seen = pixels * 4
        ImageDraw.Draw(drawn).polygon([tuple(p) for p in seen], fill=color)
    return np.asarray(drawn.resize((mount.camera.width, mount.camera.height), Image.Resampling.BOX))


def square(centre_m: tuple[float, float], turn_rad: float, size_m: float, z_m: float) -> np.ndarray:
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size_m / 2
    return np.column_stack([corners @ [[c, s], [-s, c]] + centre_m, np.full(4, z_m)])


def tool_at(row: np.ndarray) -> np.ndarray:
    return se3.transform_from(row[3:7], row[:3])


def seen_from(T_base_tcp: np.ndarray, squares: list, prompt: str) -> dict:
    q_wxyz, p_m = se3.split(T_base_tcp)
    about = {"tool": np.concatenate([p_m, q_wxyz]).astype(np.float32), "prompt": prompt}
    return {"wrist": picture(T_base_tcp, squares), **about}


@pytest.mark.parametrize("turn_rad", [0.0, 0.35, -0.7])
def test_it_goes_down_on_the_cube_and_beside_the_other(turn_rad: float) -> None:
    cube, other = (0.53, -0.11), (0.47, 0.12)
    squares = [(RED, square(cube, turn_rad, 0.04, 0.04)), (BLUE, square(other, 0.2, 0.04, 0.04))]
    policy, T = LookAndPick(), tool_at(np.array([0.42, 0, 0.42, 0, 0, 1, 0]))
    policy.reset()
    ends = []
    for _ in range(12):
        rows = policy.infer(seen_from(T, squares, "Put it to the left of the blue cube."))
        assert np.abs(np.diff(rows[:, :3], axis=0)).max(initial=0.0) <= 0.1 * 0.22 * 1.05
        T = tool_at(rows[-1])
        ends.append((T, rows[-1, 7]))
        if len(ends) == 5:  # it is in the hand
            squares = squares[1:]
    grasp, _ = ends[3]
    np.testing.assert_allclose(grasp[:3, 3], [*cube, 0.02], atol=0.0015)
    across = np.arctan2(-grasp[0, 1], grasp[1, 1])  # along the tool's y the fingers close
    assert abs((across - turn_rad + np.pi / 4) % (np.pi / 2) - np.pi / 4) < 0.03
    assert [width for _, width in ends[2:6]] == [0.085, 0.085, 0.0, 0.0]
    far_y = square(other, 0.2, 0.04, 0.04)[:, 1].max()
    release = ends[9][0]
    np.testing.assert_allclose(release[:3, 3], [other[0], far_y + 0.04, 0.022], atol=0.003)
    assert abs(release[0, 1]) > 0.999  # fingers open away from the other cube
    assert ends[10][1] == 0.085
    assert policy.infer(seen_from(T, squares, "")) == {"done": True}


def test_a_worse_policy_misses_by_as_much_as_it_says_and_a_hidden_cube_is_told() -> None:
    squares = [(RED, square((0.5, -0.1), 0.0, 0.04, 0.04))]
    off = []
    for policy in (LookAndPick(), miss_20()):
        policy.reset()
        T = tool_at(np.array([0.42, 0, 0.42, 0, 0, 1, 0]))
        for _ in range(4):
            T = tool_at(policy.infer(seen_from(T, squares, "into the box."))[-1])
        off.append(T[:2, 3])
    wave = (np.cos(60 * 0.5 - 2.5), np.sin(35 * 0.5 + 5.0))
    np.testing.assert_allclose(off[1] - off[0], 0.02 * np.array(wave), atol=0.003)
    policy = LookAndPick()
    policy.reset()
    policy.infer(seen_from(T, squares, "into the box."))
    with pytest.raises(LookupError, match="nothing red is seen"):
        policy.infer(seen_from(T, [], "into the box."))
    assert set(COLORS) == {"red", "green", "blue"}
