from pathlib import Path

import numpy as np
import pytest
from clouds import any_cloud
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from bridge.geometry import se3
from twin.errors import TwinError
from twin.scene.gaussians import (
    GaussianCloud,
    arrays,
    as_float32,
    concatenate,
    moved_cloud,
    read_ply,
    with_harmonics,
    write_ply,
)
from twin.scene.harmonics import NUM_FIRST, harmonic_terms, turned_harmonics


def plain_cloud(count: int = 30) -> GaussianCloud:
    return any_cloud(4, count, [[-0.4, -0.3, 0.6], [0.4, 0.3, 1.5]], (0.02, 0.08))


def shiny_cloud(count: int = 30) -> GaussianCloud:
    harmonics = np.random.default_rng(5).normal(scale=0.3, size=(count, NUM_FIRST, 3))
    return GaussianCloud(
        **(dict(arrays(plain_cloud(count))) | {"harmonics": as_float32(harmonics)})
    )


def some_motion() -> np.ndarray:
    return se3.look_at(
        np.array([0.3, -0.2, -0.4]), np.array([0.0, 0.1, 1.0]), np.array([0.2, -1.0, 0.1])
    )


def test_two_harmonics_are_refused() -> None:
    with pytest.raises(TwinError, match="2 harmonics per colour"):
        with_harmonics(plain_cloud(), 2)


def test_harmonics_follow_selection_and_concatenation() -> None:
    shiny, plain = shiny_cloud(6), plain_cloud(4)
    np.testing.assert_array_equal(shiny.take(np.array([5, 0])).harmonics, shiny.harmonics[[5, 0]])
    both = concatenate([plain, shiny])
    assert both.num_harmonics == 3
    assert not both.harmonics[:4].any()
    np.testing.assert_array_equal(both.harmonics[4:], shiny.harmonics)
    assert with_harmonics(both, 0).num_harmonics == 0


def test_the_basis_is_the_real_part_of_the_complex_harmonics() -> None:
    directions = some_directions()
    polar = np.arccos(directions[:, 2])
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    expected = []
    for order in (-1, 0, 1):
        value = sph_harm_y(1, abs(order), polar, azimuth)
        part = value.imag if order < 0 else value.real
        expected.append(part if order == 0 else np.sqrt(2) * part)
    np.testing.assert_allclose(harmonic_terms(*directions.T), expected, atol=1e-12)


def some_directions(count: int = 50) -> np.ndarray:
    directions = np.random.default_rng(6).normal(size=(count, 3))
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def test_turned_harmonics_are_seen_along_turned_directions() -> None:
    harmonics = shiny_cloud(20).harmonics
    rng = np.random.default_rng(7)
    one = se3.rotation_from_quaternion(np.array([0.3, -0.5, 0.7, 0.4]) / np.sqrt(0.99))
    each = se3.rotation_from_vector(rng.normal(size=3)) @ one
    many = np.stack([each if index % 2 else one for index in range(20)])
    directions = some_directions()
    before = np.stack(harmonic_terms(*directions.T), axis=1) @ harmonics
    for R, ways in ((one, one), (many, many)):
        turned = turned_harmonics(harmonics, R)
        x, y, z = np.moveaxis(directions @ np.swapaxes(ways, -1, -2), -1, 0)
        after = np.stack(harmonic_terms(x, y, z), axis=-1) @ turned
        np.testing.assert_allclose(after, before, atol=2e-6)
        assert np.abs(turned - harmonics).max() > 0.2
        back = turned_harmonics(turned, np.swapaxes(R, -1, -2))
        np.testing.assert_allclose(back, harmonics, atol=1e-6)


def test_harmonics_are_written_and_read_back(tmp_path: Path) -> None:
    cloud = shiny_cloud(7)
    write_ply(tmp_path / "a.ply", cloud)
    again = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(again.harmonics, cloud.harmonics)
    np.testing.assert_allclose(again.colors, cloud.colors, atol=1e-6)
    head = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")[0].decode().split()
    assert head[head.index("f_dc_2") + 3] == "f_rest_0"
    assert head[head.index("f_rest_8") + 3] == "opacity"


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_all_degrees_of_other_programs_files_are_read(tmp_path: Path, degree: int) -> None:
    cloud = shiny_cloud(3)
    per_color = (degree + 1) ** 2 - 1
    rest = np.full((3, 3, per_color), 7.0, dtype=np.float32)
    rest[:, :, : cloud.num_harmonics] = np.swapaxes(cloud.harmonics, 1, 2)
    write_ply(tmp_path / "a.ply", with_harmonics(cloud, 0))
    head, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    table = np.frombuffer(body, dtype="<f4").reshape(3, -1)
    names = "".join(f"property float f_rest_{index}\n" for index in range(3 * per_color))
    wider = np.concatenate([table, rest.reshape(3, -1)], axis=1)
    (tmp_path / "b.ply").write_bytes(
        head + names.encode() + b"end_header\n" + wider.astype("<f4").tobytes()
    )
    np.testing.assert_array_equal(read_ply(tmp_path / "b.ply").harmonics, cloud.harmonics)


def test_marks_of_what_nobody_measured_go_with_the_gaussians(tmp_path: Path) -> None:
    plain, guessed = shiny_cloud(4), plain_cloud(3).as_completed()
    both = moved_cloud(concatenate([plain, guessed]), some_motion())
    np.testing.assert_array_equal(both.completed, [False] * 4 + [True] * 3)
    np.testing.assert_array_equal(both.take(np.array([6, 0])).completed, [True, False])
    assert with_harmonics(both, 0).completed.sum() == 3
    for cloud in (both, plain):
        write_ply(tmp_path / "a.ply", cloud)
        np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").completed, cloud.completed)
        # A file without guesses has the columns that it always had.
        assert (b"property float completed" in (tmp_path / "a.ply").read_bytes()) == (cloud is both)


def test_a_header_with_line_ends_of_windows_is_read(tmp_path: Path) -> None:
    cloud = plain_cloud(5)
    write_ply(tmp_path / "a.ply", cloud)
    head, mark, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    windows = (head + mark).replace(b"\n", b"\r\n")
    (tmp_path / "b.ply").write_bytes(windows + body)
    np.testing.assert_array_equal(read_ply(tmp_path / "b.ply").means_m, cloud.means_m)


def test_moving_a_cloud_moves_covariances_like_points() -> None:
    rng = np.random.default_rng(1)
    cloud = GaussianCloud(
        means_m=as_float32(rng.normal(size=(5, 3))), quats_wxyz=as_float32(rng.normal(size=(5, 4))),
        scales_log=as_float32(np.log([[0.1, 0.2, 0.3]] * 5)),
        opacities_logit=as_float32(np.zeros(5)), colors=as_float32(np.zeros((5, 3))),
    )  # fmt: skip
    T = se3.transform_from(np.array([0.5, 0.5, -0.1, 0.7]), np.array([1.0, 2.0, 3.0]))

    def covariances(item: GaussianCloud) -> np.ndarray:
        R = Rotation.from_quat(item.quats_wxyz, scalar_first=True).as_matrix()
        return np.einsum("nij,nj,nkj->nik", R, np.exp(2 * item.scales_log), R)

    moved, turn = moved_cloud(cloud, T), T[:3, :3]
    np.testing.assert_allclose(covariances(moved), turn @ covariances(cloud) @ turn.T, atol=1e-6)
    np.testing.assert_allclose(moved.means_m, cloud.means_m @ turn.T + T[:3, 3], atol=1e-6)
