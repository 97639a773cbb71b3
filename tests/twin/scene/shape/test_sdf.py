"""Signed distances on a grid: sign, slope, and never too far beyond the grid."""

import zipfile
from pathlib import Path

import numpy as np
import pytest

from twin.npz import UnreadableArraysError, read_npz, write_npz
from twin.scene.shape.sdf import SdfGrid, distances_of_solid, smoothed

VOXEL, RADIUS = 0.004, 0.04


def ball(closed: bool = True) -> SdfGrid:
    axis = (np.arange(30) - 14.5) * VOXEL
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    solid = np.linalg.norm(points, axis=-1) < RADIUS
    values = smoothed(distances_of_solid(solid, VOXEL), VOXEL, 0.8)
    return SdfGrid(values_m=values, origin_m=np.full(3, axis[0]), voxel_m=VOXEL, closed=closed)


def directions(num: int) -> np.ndarray:
    rows = np.random.default_rng(0).normal(size=(num, 3))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_distances_have_the_right_sign_and_size() -> None:
    grid, ways = ball(), directions(200)
    for radius in (0.01, 0.03, 0.036, 0.044, 0.05):
        np.testing.assert_allclose(grid.distance(radius * ways), radius - RADIUS, atol=0.75 * VOXEL)


@pytest.mark.parametrize("closed", [True, False])
def test_beyond_the_grid_the_distance_is_a_lower_bound(closed: bool) -> None:
    grid, ways = ball(closed), directions(300)
    for radius in (0.1, 0.3, 2.0):
        bound = grid.distance(radius * ways)
        assert np.all(bound <= radius - RADIUS + 0.1 * VOXEL)
        if closed:
            assert np.all(bound > 0.55 * (radius - RADIUS))
    assert np.all(np.isfinite(grid.distance(np.array([[1e6, 0, 0]]))))


def test_a_grid_is_read_back_and_its_file_has_the_same_bytes_every_time(tmp_path: Path) -> None:
    grid = ball()
    grid.save(tmp_path / "a.npz")
    grid.save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    again = SdfGrid.load(tmp_path / "a.npz")
    np.testing.assert_array_equal(again.values_m, grid.values_m)
    np.testing.assert_array_equal(again.origin_m, grid.origin_m)
    assert (again.voxel_m, again.closed) == (grid.voxel_m, grid.closed)
    assert np.load(tmp_path / "a.npz")["values_m"].shape == grid.values_m.shape


def test_damaged_large_or_foreign_files_are_refused_with_their_name(tmp_path: Path) -> None:
    path = tmp_path / "sdf.npz"
    ball().save(path)
    whole = path.read_bytes()
    with pytest.raises(UnreadableArraysError, match="more than"):
        read_npz(path, ["values_m"], 1000)
    for broken in (b"", b"no zip", whole[: len(whole) // 2], whole[:400] + b"x" * 40 + whole[440:]):
        path.write_bytes(broken)
        with pytest.raises(UnreadableArraysError, match="sdf"):
            SdfGrid.load(path)
    with pytest.raises(UnreadableArraysError):
        SdfGrid.load(tmp_path / "missing.npz")
    write_npz(path, {"values_m": np.zeros((3, 3, 3), np.float32)})
    with pytest.raises(UnreadableArraysError, match="without origin_m"):
        SdfGrid.load(path)
    arrays = ball().arrays()
    for name, rows in (
        ("values_m", np.zeros((3, 3), np.float32)),
        ("values_m", np.full((3, 3, 3), np.nan, np.float32)),
        ("voxel_m", np.array(-1.0)),
        ("origin_m", np.zeros(2)),
    ):
        write_npz(path, arrays | {name: rows})
        with pytest.raises(UnreadableArraysError):
            SdfGrid.load(path)


def test_an_array_of_objects_and_a_lying_header_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "arrays.npz"
    np.savez(path, rows=np.array([{}], dtype=object))
    with pytest.raises(UnreadableArraysError, match="objects"):
        read_npz(path, ["rows"], 10**6)
    write_npz(path, {"rows": np.zeros(4)})
    with zipfile.ZipFile(path) as archive:
        data = archive.read("rows.npy")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("rows.npy", data.replace(b"(4,)", b"(9,)"))
    with pytest.raises(UnreadableArraysError, match="bytes"):
        read_npz(path, ["rows"], 10**6)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("rows", data)
    with pytest.raises(UnreadableArraysError, match="without rows"):
        read_npz(path, ["rows"], 10**6)


def test_smoothing_keeps_the_number_of_solid_voxels_even_in_thin_walls() -> None:
    solid = np.zeros((20, 20, 20), dtype=bool)
    solid[9:11, 4:16, 4:16] = True
    before = distances_of_solid(solid, 1.0)
    after = smoothed(before, 1.0, 0.8)
    assert abs(int((after < 0).sum()) - int(solid.sum())) <= 0.08 * solid.sum()
    assert (after < 0)[9:11, 6:14, 6:14].all()
