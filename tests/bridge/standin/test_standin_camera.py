"""The ray-cast cameras against geometry that can be written down."""

from dataclasses import replace

import numpy as np
import pytest

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.sources.standin.cell_file import CellFile, HiddenParameters, SensorModel
from bridge.sources.standin.render import Picture, Renderer, measure_color, measure_depth
from bridge.sources.standin.surfaces import Surface, box_surface, lab_surfaces

CAMERA = Camera(width=40, height=30, fx=35.0, fy=35.0, cx=20.0, cy=15.0)
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def lab() -> list[Surface]:
    return lab_surfaces(9_000_000)


@pytest.fixture
def plain_sensor(cell_file: CellFile) -> SensorModel:
    return replace(cell_file.sensors, depth_noise_per_m=0.0, image_noise=0.0)


def plane_depth(T_base_camera: np.ndarray) -> np.ndarray:
    """Depth of the plane z = 0 through every pixel centre."""
    rays = CAMERA.rays() @ T_base_camera[:3, :3].T
    return -T_base_camera[2, 3] / rays[..., 2]


def test_depth_of_the_table_agrees_with_the_plane(lab: list[Surface]) -> None:
    T = se3.look_at(np.array([0.1, -0.2, 0.6]), np.array([0.35, 0.0, 0.0]), UP)
    picture = Renderer(lab).render(CAMERA, T, {})
    np.testing.assert_allclose(picture.depth_m, plane_depth(T), atol=1e-5)


def test_a_box_on_the_table_is_nearer_by_its_height(lab: list[Surface]) -> None:
    box = box_surface("cube", np.array([0.0, 0.0, 0.0]), np.array([0.1, 0.1, 0.1]), (1.0, 0.0, 0.0))
    T = se3.look_at(np.array([0.3, 0.0, 0.8]), np.array([0.3001, 0.0, 0.0]), UP)
    T_base_cube = np.eye(4)
    T_base_cube[:3, 3] = [0.3, 0.0, 0.05]
    picture = Renderer([*lab, box]).render(CAMERA, T, {"cube": T_base_cube})
    assert picture.depth_m[15, 20] == pytest.approx(0.7, abs=1e-3)
    red, green, blue = picture.image[15, 20]
    assert red > 0.5
    assert green == blue == 0.0


def test_a_backdrop_changes_no_depth(lab: list[Surface]) -> None:
    box = box_surface("cube", np.zeros(3), np.array([0.1, 0.1, 0.1]), (1.0, 0.0, 0.0))
    T = se3.look_at(np.array([0.8, -0.5, 0.5]), np.array([0.35, 0.0, 0.0]), UP)
    T_base_cube = np.eye(4)
    T_base_cube[:3, 3] = [0.35, 0.0, 0.05]
    renderer = Renderer([*lab, box])
    whole = renderer.render(CAMERA, T, {"cube": T_base_cube})
    kept = renderer.render(CAMERA, T, {"cube": T_base_cube}, renderer.backdrop(CAMERA, T))
    np.testing.assert_array_equal(whole.depth_m, kept.depth_m)
    assert np.mean(np.abs(whole.image - kept.image).max(axis=2) > 0.02) < 0.05


def flat_picture(depth_m: float, cosine: float = 1.0, shape: tuple[int, int] = (60, 80)) -> Picture:
    return Picture(
        image=np.full((*shape, 3), 0.5, dtype=np.float32),
        depth_m=np.full(shape, depth_m),
        cosine=np.full(shape, cosine, dtype=np.float32),
    )


def test_depth_is_biased_as_the_hidden_parameters_say(
    plain_sensor: SensorModel, nominal: HiddenParameters
) -> None:
    hidden = replace(nominal, depth_scale=1.01, depth_offset_m=0.002)
    rng = np.random.default_rng(0)
    measured = measure_depth(flat_picture(0.8), plain_sensor, hidden, rng)
    assert set(np.unique(measured)) == {810}


def test_depth_noise_grows_with_the_square_of_the_distance(
    cell_file: CellFile, nominal: HiddenParameters
) -> None:
    rng = np.random.default_rng(0)
    spread = [
        measure_depth(flat_picture(z), cell_file.sensors, nominal, rng).astype(float).std() * 1e-3
        for z in (1.0, 2.0)
    ]
    # Rounding to millimetres adds a variance of 1/12 mm^2 to each.
    noise = [np.sqrt(value**2 - 1e-6 / 12) for value in spread]
    assert noise[0] == pytest.approx(0.0012, rel=0.05)
    assert noise[1] / noise[0] == pytest.approx(4.0, rel=0.05)


@pytest.mark.parametrize(("depth_m", "cosine"), [(0.5, 0.05), (0.05, 1.0), (3.0, 1.0), (np.inf, 0)])
def test_there_is_no_depth_at_flat_angles_or_out_of_range(
    plain_sensor: SensorModel, nominal: HiddenParameters, depth_m: float, cosine: float
) -> None:
    picture = flat_picture(depth_m, cosine)
    measured = measure_depth(picture, plain_sensor, nominal, np.random.default_rng(0))
    assert not measured.any()


def test_holes_lie_on_the_far_side_of_an_edge_only(
    plain_sensor: SensorModel, nominal: HiddenParameters
) -> None:
    picture = flat_picture(0.5)
    picture.depth_m[:, 40:] = 1.0
    measured = measure_depth(picture, plain_sensor, nominal, np.random.default_rng(0))
    empty = np.unique(np.nonzero(measured == 0)[1])
    assert list(empty) == [40]


def test_colour_follows_the_hidden_gain(
    plain_sensor: SensorModel, nominal: HiddenParameters
) -> None:
    hidden = replace(nominal, image_gain=0.8)
    image = measure_color(flat_picture(0.5), plain_sensor, hidden, np.random.default_rng(0))
    assert set(np.unique(image)) == {102}
