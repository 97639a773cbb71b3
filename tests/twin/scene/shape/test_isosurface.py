"""The surface of a grid: closed, facing outwards, where the values say."""

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.measure import marching_cubes

from bridge.errors import PathNotFoundError
from bridge.task.meshes.solids import is_closed
from twin.scene.shape import mesh
from twin.scene.shape.isosurface import isosurface


def sphere(radius_m: float, step_m: float) -> tuple[np.ndarray, np.ndarray]:
    axis = np.arange(-radius_m - 3 * step_m, radius_m + 3 * step_m, step_m)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    values = (np.linalg.norm(points, axis=-1) - radius_m).astype(np.float32)
    return isosurface(values, np.full(3, axis[0]), step_m)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), share=st.floats(0.05, 0.95))
def test_any_values_whatever_give_a_closed_surface(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    values = (rng.random((7, 6, 5)) - share).astype(np.float32)
    vertices, faces = isosurface(values, np.zeros(3), 1.0)
    if (values < 0).any():
        assert is_closed(faces)
        assert mesh.volume_m3(vertices, faces) > 0
        assert vertices.min() > -1.0


@pytest.mark.parity
def test_the_surface_lies_where_scikit_image_puts_it() -> None:
    axis = np.linspace(-1, 1, 24)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    ring = (np.hypot(np.hypot(x, y) - 0.55, z) - 0.27).astype(np.float32)
    step = axis[1] - axis[0]
    vertices, faces = isosurface(ring, np.full(3, -1.0), step)
    theirs, their_faces, _, _ = marching_cubes(ring, 0.0, spacing=(step,) * 3)
    assert is_closed(faces)
    assert len(vertices) == len(theirs)
    ours = vertices[np.lexsort(vertices.round(5).T)]
    np.testing.assert_allclose(ours, (theirs - 1.0)[np.lexsort((theirs - 1.0).round(5).T)],
                               atol=0.02 * step)  # fmt: skip
    their_volume = abs(mesh.volume_m3(theirs.astype(np.float64), their_faces.astype(np.int64)))
    assert mesh.volume_m3(vertices, faces) == pytest.approx(their_volume, rel=5e-3)


def test_an_open_mesh_a_flipped_face_and_no_mesh_are_not_watertight() -> None:
    _, faces = sphere(0.05, 0.01)
    assert is_closed(faces)
    assert not is_closed(faces[1:])
    flipped = faces.copy()
    flipped[0] = flipped[0][::-1]
    assert not is_closed(flipped)
    assert not is_closed(np.concatenate([faces, faces[:1]]))
    assert not is_closed(np.zeros((0, 3), dtype=np.int64))
    degenerate = faces.copy()
    degenerate[0, 1] = degenerate[0, 0]
    assert not is_closed(degenerate)


def test_a_written_mesh_is_read_back_and_open3d_reads_it_too(tmp_path: Path) -> None:
    vertices, faces = sphere(0.05, 0.01)
    path = tmp_path / "mesh.ply"
    path.write_bytes(mesh.mesh_ply(vertices, faces))
    again, same = mesh.read_mesh(path)
    np.testing.assert_allclose(again, vertices, atol=1e-7)
    np.testing.assert_array_equal(same, faces)
    other = o3d.io.read_triangle_mesh(str(path))
    np.testing.assert_allclose(np.asarray(other.vertices), again, atol=1e-7)
    np.testing.assert_array_equal(np.asarray(other.triangles), faces)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (b"end_header", b"end_headed", "no usable PLY header"),
        (b"float x", b"double x", "another header"),
        (b"element vertex 3", b"element vertex 4", "bytes for 4 vertices"),
        (b"\x03\x00\x00\x00\x00", b"\x04\x00\x00\x00\x00", "no triangles"),
        (b"\x03\x00\x00\x00\x00", b"\x03\x09\x00\x00\x00", "do not exist"),
        (b"\x00\x00\x80\x3f", b"\x00\x00\xc0\x7f", "not finite"),
    ],
)
def test_a_damaged_mesh_is_refused(tmp_path: Path, old: bytes, new: bytes, says: str) -> None:
    path = tmp_path / "mesh.ply"
    data = mesh.mesh_ply(np.eye(3), np.array([[0, 1, 2]]))
    assert old in data
    path.write_bytes(data.replace(old, new, 1))
    with pytest.raises(mesh.UnreadableMeshError, match=says):
        mesh.read_mesh(path)
    with pytest.raises(PathNotFoundError):
        mesh.read_mesh(tmp_path / "none.ply")
