"""Binary glTF: what it says is read, what it claims is checked."""

import json
from pathlib import Path

import numpy as np
import pytest
from block_shape import block_mesh
from scipy.spatial.transform import Rotation
from small_files import glb_bytes, mesh_content

from twin.scene.foundation.glb import UnreadableGlbError, read_glb


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "mesh.glb"


def test_triangles_and_colours_come_back(path: Path) -> None:
    vertices, faces = block_mesh()
    colors = np.random.default_rng(0).integers(0, 256, size=(len(vertices), 4), dtype=np.uint8)
    path.write_bytes(glb_bytes(*mesh_content(vertices, faces, colors)))
    mesh = read_glb(path)
    np.testing.assert_allclose(mesh.vertices, vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, faces)
    assert mesh.colors is not None
    np.testing.assert_allclose(mesh.colors, colors[:, :3] / 255.0, atol=1e-6)


@pytest.mark.parametrize("as_matrix", [True, False])
def test_nodes_move_what_hangs_on_them(path: Path, as_matrix: bool) -> None:
    vertices, faces = block_mesh()
    rng = np.random.default_rng(1)
    turn, scale, shift = Rotation.random(rng=rng), rng.uniform(0.5, 2, 3), rng.normal(size=3)
    child = {"rotation": turn.as_quat().tolist(), "scale": scale.tolist()}
    child["translation"] = shift.tolist()
    if as_matrix:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = turn.as_matrix() @ np.diag(scale), shift
        child = {"matrix": T.T.ravel().tolist()}
    content, binary = mesh_content(vertices, faces, node=child)
    content["nodes"].append({"children": [0], "translation": [1.0, 2.0, 3.0]})
    content["scenes"] = [{"nodes": [1]}]
    path.write_bytes(glb_bytes(content, binary))
    wanted = turn.apply(vertices * scale) + shift + [1.0, 2.0, 3.0]
    np.testing.assert_allclose(read_glb(path).vertices, wanted, atol=1e-5)


def test_several_meshes_are_joined_and_those_without_colours_leave_none(path: Path) -> None:
    vertices, faces = block_mesh()
    colors = np.zeros((len(vertices), 3), dtype=np.uint8)
    content, binary = mesh_content(vertices, faces, colors)
    plain = {"attributes": {"POSITION": 0}, "indices": 1}
    content["meshes"][0]["primitives"].append(plain)
    path.write_bytes(glb_bytes(content, binary))
    mesh = read_glb(path)
    assert mesh.colors is None
    np.testing.assert_array_equal(mesh.faces[len(faces) :], faces + len(vertices))


def test_interleaved_positions_and_short_indices_are_read(path: Path) -> None:
    vertices, faces = block_mesh()
    table = np.concatenate([vertices, np.ones_like(vertices)], axis=1).astype("<f4")
    binary = table.tobytes() + faces.astype("<u2").tobytes()
    content, _ = mesh_content(vertices, faces)
    content["bufferViews"] = [
        {"buffer": 0, "byteLength": table.nbytes, "byteStride": 24},
        {"buffer": 0, "byteOffset": table.nbytes, "byteLength": faces.size * 2},
    ]
    content["accessors"][1]["componentType"] = 5123
    path.write_bytes(glb_bytes(content, binary))
    mesh = read_glb(path)
    np.testing.assert_allclose(mesh.vertices, vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, faces)


@pytest.mark.parity
@pytest.mark.slow
def test_open3d_reads_the_same_triangles(path: Path) -> None:
    import open3d

    vertices, faces = block_mesh()
    node = {"rotation": [0.5, 0.5, 0.5, 0.5], "translation": [1.0, 0.0, -1.0]}
    path.write_bytes(glb_bytes(*mesh_content(vertices, faces, node=node)))
    theirs = open3d.io.read_triangle_mesh(str(path))
    ours = read_glb(path)
    wanted = np.asarray(theirs.vertices)[np.asarray(theirs.triangles)]
    np.testing.assert_allclose(ours.vertices[ours.faces], wanted, atol=1e-5)


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (("buffers", 0, "uri"), "../../secret.bin", "another file"),
        (("extensionsRequired",), ["KHR_draco_mesh_compression"], "it needs KHR_draco"),
        (("bufferViews", 0, "byteLength"), 8, "past the end"),
        (("bufferViews", 0, "byteOffset"), 1 << 29, "past the end"),
        (("bufferViews", 0, "byteOffset"), -4, "impossible offsets"),
        (("accessors", 0, "count"), 10**9, "claims 1000000000 rows"),
        (("accessors", 0, "count"), "many", "do not read"),
        (("accessors", 0, "sparse"), {}, "do not read"),
        (("accessors", 0, "type"), "VEC2", "three floats"),
        (("accessors", 0, "count"), 3, "a vertex that is not there"),
        (("accessors", 1, "count"), 35, "whole triangles"),
        (("meshes", 0, "primitives", 0, "mode"), 1, "lines, points or strips"),
        (("meshes", 0, "primitives"), [], "no triangles"),
        (("nodes", 0, "children"), [0], "occurs twice"),
        (("nodes", 0, "matrix"), [1, 2], "broken transform"),
        (("nodes", 0, "translation"), [float("nan"), 0, 0], "not finite"),
        (("scene",), 3, "no entry 3 in scenes"),
        (("scenes", 0, "nodes"), 7, "structure is broken"),
        (("meshes", 0, "primitives"), 7, "structure is broken"),
    ],
)
def test_what_a_file_claims_is_checked(
    path: Path, place: tuple[str | int, ...], value: object, said: str
) -> None:
    content, binary = mesh_content(*block_mesh())
    target = content
    for key in place[:-1]:
        target = target[key]
    target[place[-1]] = value
    path.write_bytes(glb_bytes(content, binary))
    with pytest.raises(UnreadableGlbError, match=said):
        read_glb(path)


def test_other_files_and_cut_ones_are_refused(path: Path) -> None:
    whole = glb_bytes(*mesh_content(*block_mesh()))
    for data in (b"", b"solid", whole[:-4], whole[:40], b"\0" * 100, json.dumps({}).encode()):
        path.write_bytes(data)
        with pytest.raises(UnreadableGlbError):
            read_glb(path)
    path.unlink()
    with pytest.raises(UnreadableGlbError, match="missing"):
        read_glb(path)


def test_no_damage_leads_to_anything_but_a_mesh_or_a_refusal(path: Path) -> None:
    whole = np.frombuffer(glb_bytes(*mesh_content(*block_mesh())), dtype=np.uint8)
    rng = np.random.default_rng(2)
    refused = 0
    for _ in range(400):
        damaged = whole.copy()
        where = rng.integers(12, len(whole), size=rng.integers(1, 5))
        damaged[where] = rng.integers(0, 256, size=len(where))
        path.write_bytes(damaged.tobytes())
        try:
            mesh = read_glb(path)
        except UnreadableGlbError:
            refused += 1
        else:
            assert mesh.faces.max() < len(mesh.vertices)
            assert np.isfinite(mesh.vertices).all()
    assert 50 < refused < 400
