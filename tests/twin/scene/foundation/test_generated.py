"""The shape generator as a program of its own, obedient and not."""

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from block_shape import CAMERA, block_depth, block_mesh, camera_pose, placed
from block_source import PYTORCH3D, SCALE, known_cloud, stored_quaternion, write_source
from other_processes import is_running
from small_files import glb_bytes, mesh_content

from bridge.errors import UsageError
from bridge.geometry import se3
from twin.scene.foundation.metric_fit import MetricFitConfig, MetricFitError
from twin.scene.foundation.sam3d import (
    GeneratorConfig,
    GeneratorError,
    GeneratorInput,
    generate_object,
    pointmap,
    read_pose,
    run_generator,
    scaled_cloud,
)

WORKER = Path(__file__).with_name("generator_worker.py")


@pytest.fixture
def source(tmp_path: Path) -> Path:
    return write_source(tmp_path / "source")


def wanted() -> GeneratorInput:
    depth = block_depth(placed(), SCALE, camera_pose())
    image = np.full((CAMERA.height, CAMERA.width, 3), 90, dtype=np.uint8)
    return GeneratorInput(image_u8=image, mask=depth > 0, depth_m=depth, camera=CAMERA)


def worker(behaviour: str, source: Path, **settings: Any) -> GeneratorConfig:
    command = (sys.executable, str(WORKER), behaviour, str(source))
    return GeneratorConfig(command=command, **({"timeout_s": 60.0} | settings))


def test_the_point_map_has_x_left_y_up_and_nothing_where_nothing_was_measured() -> None:
    depth = np.zeros((CAMERA.height, CAMERA.width), dtype=np.float32)
    depth[10, 80] = 2.0  # above the centre and right of it
    points = pointmap(depth, CAMERA)
    x, y, z = points[10, 80]
    assert x == pytest.approx(-(80.5 - 48.0) / 110.0 * 2.0, abs=1e-5)
    assert y == pytest.approx(-(10.5 - 36.0) / 110.0 * 2.0, abs=1e-5)
    assert z == pytest.approx(2.0)
    assert np.isnan(points).all(axis=2).sum() == depth.size - 1


@pytest.mark.slow
def test_an_obedient_worker_s_shape_ends_metric_and_upright_where_it_was_seen(
    source: Path, tmp_path: Path
) -> None:
    T_true = placed()
    found = generate_object(
        wanted(),
        camera_pose(),
        T_true[2, 3],
        tmp_path / "work",
        worker("obey", source),
    )
    vertices, faces = block_mesh()
    truth = se3.apply(T_true, SCALE * vertices)
    # Depth without noise; what is left is the spacing of samples on the surface.
    assert np.linalg.norm(found.vertices_m - truth, axis=1).mean() < 0.0005
    assert found.fit.scale == pytest.approx(SCALE, rel=0.01)
    np.testing.assert_array_equal(found.faces, faces)
    np.testing.assert_allclose(found.colors, 200 / 255, atol=1e-6)
    assert (found.iou, found.fit.is_snapped) == (0.8, True)
    # The Gaussians went with the mesh: same corners, grown alike, their long axis still up.
    np.testing.assert_allclose(found.cloud.means_m, found.vertices_m, atol=1e-5)
    np.testing.assert_allclose(
        np.exp(found.cloud.scales_log[0]), np.array([0.01, 0.02, 0.05]) * found.fit.scale, rtol=1e-4
    )
    up = se3.rotation_from_quaternion(found.cloud.quats_wxyz[0].astype(np.float64))[:, 2]
    assert up[2] > 0.999


def test_clouds_grow_and_move() -> None:
    T = placed()
    moved = scaled_cloud(known_cloud(), 0.3, T)
    np.testing.assert_allclose(
        moved.means_m, se3.apply(T, 0.3 * known_cloud().means_m.astype(np.float64)), atol=1e-6
    )


@pytest.mark.parametrize(
    ("behaviour", "said"),
    [
        ("crash", "ended with exit code 1.*out of memory on the GPU"),
        ("exit", "ended with exit code 7.*the exit worker speaks"),
        ("signal", "ended by signal 6"),
        ("nothing", "left no mesh.glb; it left nothing"),
        ("without_splat", "left no splat.ply; it left mesh.glb, pose.json, splats.ply"),
        ("link", "left mesh.glb as a link, which is not followed"),
        ("replaced_folder", "replaced its output folder"),
    ],
)
def test_a_worker_that_breaks_the_contract_is_told_apart(
    source: Path, tmp_path: Path, behaviour: str, said: str
) -> None:
    with pytest.raises(GeneratorError, match=said) as caught:
        run_generator(wanted(), tmp_path / "work", worker(behaviour, source))
    assert len(caught.value.stderr) <= 1500
    assert "docs/foundation_models.md" in str(caught.value)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc to see processes")
def test_a_worker_that_hangs_is_ended_with_all_it_started(source: Path, tmp_path: Path) -> None:
    with pytest.raises(GeneratorError, match=r"stopped after 1\.5 s.*the hang worker speaks"):
        run_generator(wanted(), tmp_path / "work", worker("hang", source, timeout_s=1.5))
    child = int((source / "child").read_text())
    for _ in range(100):
        if not is_running(child):
            break
        time.sleep(0.05)
    assert not is_running(child)


def test_a_worker_that_fills_the_disk_is_ended(source: Path, tmp_path: Path) -> None:
    limited = worker("huge", source, max_output_bytes=3_000_000)
    with pytest.raises(GeneratorError, match="wrote more than 3000000 bytes"):
        run_generator(wanted(), tmp_path / "work", limited)
    written = sum(path.stat().st_size for path in (tmp_path / "work").rglob("*"))
    assert written < 500_000_000


def test_a_shape_that_is_not_the_object_s_is_refused(source: Path, tmp_path: Path) -> None:
    vertices, faces = block_mesh()
    needle = glb_bytes(*mesh_content(vertices * [0.05, 3.0, 0.05], faces))
    (source / "mesh.glb").write_bytes(needle)
    quick = MetricFitConfig(num_samples=500, max_points=200, yaw_starts_rad=(0.0,))
    with pytest.raises(MetricFitError, match=r"generate it again|times as large"):
        generate_object(
            wanted(), camera_pose(), 0.02, tmp_path / "work", worker("obey", source), quick
        )


def test_input_that_is_no_object_and_commands_that_cannot_be_run_are_refused(
    source: Path, tmp_path: Path
) -> None:
    given = wanted()
    nothing = GeneratorInput(
        image_u8=given.image_u8, mask=~given.mask, depth_m=given.depth_m, camera=CAMERA
    )
    with pytest.raises(UsageError, match="0 with depth"):
        run_generator(nothing, tmp_path / "work", worker("obey", source))
    small = CAMERA.scaled(0.5)
    other = GeneratorInput(
        image_u8=given.image_u8, mask=given.mask, depth_m=given.depth_m, camera=small
    )
    with pytest.raises(UsageError, match="do not fit a camera"):
        run_generator(other, tmp_path / "work", worker("obey", source))
    missing = GeneratorConfig(command=(str(tmp_path / "no_such_program"),))
    with pytest.raises(UsageError, match="cannot be started"):
        run_generator(given, tmp_path / "work", missing)
    with pytest.raises(UsageError, match="a new folder"):
        run_generator(given, source, worker("obey", source))
    with pytest.raises(UsageError, match="needs a command"):
        run_generator(given, tmp_path / "other", GeneratorConfig(command=()))


GOOD_POSE = {"rotation_wxyz": [1, 0, 0, 0], "translation": [0, 0, 1], "scale": 0.1, "iou": 0.9}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"rotation_wxyz": [0, 0, 0, 0]}, "without a rotation"),
        ({"rotation_wxyz": [1, 0, 0]}, "not 4 finite numbers"),
        ({"translation": [0, 0, float("nan")]}, "not 3 finite numbers"),
        ({"translation": "here"}, "cannot be used"),
        ({"scale": 0}, "without a rotation or a size"),
        ({"scale": [0.1, 0.1, 0.3]}, "differs between axes"),
        ({"scale": None}, "cannot be used"),
        ({"iou": 0.05}, "layout failed"),
        ({"iou": float("nan")}, "layout failed"),
    ],
)
def test_a_pose_that_cannot_be_meant_is_refused(
    tmp_path: Path, change: dict[str, Any], said: str
) -> None:
    path = tmp_path / "pose.json"
    path.write_text(json.dumps(GOOD_POSE | change))
    with pytest.raises(GeneratorError, match=said):
        read_pose(path)


def test_broken_pose_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "pose.json"
    for text in ("", "[1, 2]", "{}", "[" * 90_000, " " * 200_000):
        path.write_text(text)
        with pytest.raises(GeneratorError, match=r"pose\.json"):
            read_pose(path)


def test_the_pose_is_turned_from_rows_and_pytorch3d_axes_to_columns_and_opencv_axes(
    tmp_path: Path,
) -> None:
    T = se3.invert(camera_pose()) @ placed()
    about = {
        "rotation_wxyz": [stored_quaternion(T)],
        "translation": [(PYTORCH3D @ T[:3, 3]).tolist()],
        "scale": [[SCALE] * 3],
    }
    path = tmp_path / "pose.json"
    path.write_text(json.dumps(about))
    pose = read_pose(path)
    np.testing.assert_allclose(pose.T_camera_shape, T, atol=1e-9)
    assert (pose.scale, pose.iou) == (pytest.approx(SCALE), None)
