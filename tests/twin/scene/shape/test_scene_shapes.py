"""From training views to an object's folder and to the static scene's distances."""

import json
from pathlib import Path

import cast_views
import numpy as np
import open3d as o3d
import pytest

from bridge.geometry import se3
from bridge.task.task_file import load_task
from twin.scene.frames.training_view import Target, TrainingView
from twin.scene.gaussians.cloud import GaussianCloud, as_float32
from twin.scene.localise.result import LocalisedObject
from twin.scene.objects.split import ObjectSplats, SceneParts, write_objects
from twin.scene.shape.from_training import (
    from_outside_m,
    masked_view,
    shapes_of,
    write_static,
)
from twin.scene.shape.known import pose_of, surface_distances
from twin.scene.shape.masked_view import ShapeError
from twin.scene.shape.mesh import is_watertight, volume_m3
from twin.scene.shape.reconstruct import ObjectShape
from twin.scene.shape.sdf import SdfGrid
from twin.scene.shape.static import FREE, SURFACE, UNSEEN, StaticConfig, StaticSdf, static_sdf

TASK = cast_views.TASK
POSES = {
    "cube": pose_of(np.array([0.50, -0.10, 0.02, 0.4])),
    "box": pose_of(np.array([0.49, 0.12, 0.0, -0.12])),
}
COARSE = StaticConfig(voxel_m=0.012, height_m=0.3)


def placed(key: str) -> cast_views.Mesh:
    vertices, faces = cast_views.shape_mesh(TASK.objects[key])
    return se3.apply(POSES[key], vertices), faces


@pytest.fixture(scope="module")
def views() -> list[TrainingView]:
    """Cube and box on a table, seen from 24 places."""
    poses = cast_views.around([0.5, 0.0, 0.02], 24, 0.6)
    meshes = [placed("cube"), placed("box"), cast_views.table()]
    training = []
    for seen in cast_views.cast(meshes, poses, noise=0.003):
        target = Target(
            camera=seen.camera,
            planes_u8=np.zeros((3, *seen.depth_m.shape), dtype=np.uint8),
            depth_m=seen.depth_m.astype(np.float32),
            static_mask=np.ones(seen.depth_m.shape, dtype=bool),
        )
        training.append(
            TrainingView(
                camera_id="wrist",
                stamp_ns=len(training),
                T_base_color=seen.T_base_camera,
                half=target,
                full=target,
            )
        )
    return training


@pytest.fixture(scope="module")
def shapes(views: list[TrainingView]) -> dict[str, ObjectShape | str]:
    return shapes_of(views, TASK.objects, POSES)


def known_volume(key: str) -> float:
    return sum(float(np.prod(extents)) for _, extents in TASK.objects[key].panels())


@pytest.mark.slow
@pytest.mark.parametrize("key", ["cube", "box"])
def test_objects_are_reconstructed_in_their_own_frame(
    shapes: dict[str, ObjectShape | str], key: str
) -> None:
    shape = shapes[key]
    assert isinstance(shape, ObjectShape), shape
    assert shape.is_watertight
    assert shape.volume_m3 == pytest.approx(known_volume(key), rel=0.1)
    known = cast_views.shape_mesh(TASK.objects[key])
    mean, _ = cast_views.mean_error_m((shape.vertices_m, shape.faces), known)
    assert mean < 0.002
    assert (shape.cavity is not None) == (key == "box")


@pytest.mark.slow
def test_an_object_whose_frame_leans_is_reconstructed_all_the_same(
    views: list[TrainingView],
) -> None:
    lean = np.radians(4.0)
    T = POSES["cube"] @ se3.transform_from(
        np.array([np.cos(lean / 2), np.sin(lean / 2), 0.0, 0.0]), np.zeros(3)
    )
    shape = shapes_of(views, TASK.objects, {"cube": T})["cube"]
    assert isinstance(shape, ObjectShape), shape
    mesh = se3.apply(T, shape.vertices_m), shape.faces
    mean, _ = cast_views.mean_error_m(mesh, placed("cube"))
    assert mean < 0.0015
    assert shape.is_watertight
    assert shape.volume_m3 == pytest.approx(known_volume("cube"), rel=0.1)


def test_a_pixel_belongs_to_the_nearest_object(views: list[TrainingView]) -> None:
    masks = {key: masked_view(views[0], key, TASK.objects, POSES).mask for key in POSES}
    assert masks["cube"].any()
    assert masks["box"].any()
    assert not (masks["cube"] & masks["box"]).any()


def test_what_cannot_be_reconstructed_says_why(views: list[TrainingView]) -> None:
    tipped = {"cube": se3.transform_from(np.array([0.7, 0.7, 0, 0]), np.array([0.5, -0.1, 0.02]))}
    assert "upright" in str(shapes_of(views, TASK.objects, tipped)["cube"])
    elsewhere = {"cube": pose_of(np.array([5.0, 5.0, 0.02, 0.0]))}
    assert "masks are empty" in str(shapes_of(views, TASK.objects, elsewhere)["cube"])
    assert "masks are empty" in str(shapes_of([], TASK.objects, POSES)["box"])


def parts_of(*keys: str) -> SceneParts:
    cloud = GaussianCloud(
        means_m=as_float32(np.zeros((3, 3))),
        quats_wxyz=as_float32(np.tile([1.0, 0, 0, 0], (3, 1))),
        scales_log=as_float32(np.full((3, 3), -6.0)),
        opacities_logit=as_float32(np.ones(3)),
        colors=as_float32(np.ones((3, 3))),
    )
    objects = {key: ObjectSplats(cloud=cloud, T_base_object=POSES[key]) for key in keys}
    return SceneParts(background=cloud, objects=objects, filling=cloud)


def localised(key: str) -> LocalisedObject:
    return LocalisedObject(
        object_id=key,
        found=True,
        T_base_object=POSES[key],
        covariance=None,
        confidence=1.0,
        method="given",
        reason=None,
        stamp_ns=1,
    )


@pytest.mark.slow
def test_the_folder_holds_what_object_json_says(
    shapes: dict[str, ObjectShape | str], tmp_path: Path
) -> None:
    where = {key: localised(key) for key in POSES}
    record = write_objects(tmp_path, parts_of("cube", "box"), where, TASK, shapes)
    for key in POSES:
        folder = tmp_path / "objects" / key
        about = json.loads((folder / "object.json").read_text())
        assert about["schema_version"] == 3
        assert about["shape_source"].startswith("reconstructed from 24")
        assert about["geometry"]["watertight"] is True
        assert about["geometry"]["mass_prior"]["material"] == "plastic"
        present = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
        assert present == set(record[key]["files"])
        parts = [name for name in present if name.startswith("collision/")]
        assert len(parts) == about["geometry"]["collision"]["num_parts"]
        mesh = o3d.io.read_triangle_mesh(str(folder / "mesh.ply"))
        assert mesh.is_edge_manifold(allow_boundary_edges=False)
        assert SdfGrid.load(folder / "sdf.npz").distance(np.zeros(3)) < 0.01
    box = json.loads((tmp_path / "objects" / "box" / "object.json").read_text())["geometry"]
    assert box["cavity"]["volume_m3"] > 0.001
    assert box["collision"]["cavity_blocked"] == 0.0


@pytest.mark.slow
def test_the_known_shape_stands_in_and_nothing_old_is_left(
    shapes: dict[str, ObjectShape | str], tmp_path: Path
) -> None:
    where = {"cube": localised("cube")}
    write_objects(tmp_path, parts_of("cube"), where, TASK, shapes)
    record = write_objects(tmp_path, parts_of("cube"), where, TASK, {"cube": "seen too little"})
    folder = tmp_path / "objects" / "cube"
    assert {p.name for p in folder.iterdir()} == set(record["cube"]["files"])
    about = json.loads((folder / "object.json").read_text())
    assert about["shape_source"] == "task file"
    assert about["shape_remark"] == "seen too little"


@pytest.fixture(scope="module")
def static(views: list[TrainingView]) -> StaticSdf:
    def cube(points: np.ndarray) -> np.ndarray:
        return surface_distances(points, TASK.objects["cube"], POSES["cube"])[0]

    return static_sdf(views, 0.0, [cube], COARSE)


def test_distances_to_the_table_and_to_what_stands_on_it(static: StaticSdf) -> None:
    above = np.array([[0.4, -0.25, z] for z in (0.05, 0.1)])
    np.testing.assert_allclose(static.observed.distance(above), [0.05, 0.1], atol=0.012)
    assert np.all(static.observed.distance(above - [0, 0, 0.12]) < 0)
    wall = se3.apply(POSES["box"], np.array([[0.078, 0.0, 0.03]]))
    assert static.observed.distance(wall)[0] < 0.006
    inside = se3.apply(POSES["box"], np.array([[0.0, 0.0, 0.045]]))
    assert static.observed.distance(inside)[0] > 0.01
    assert static.conservative.distance(inside)[0] > 0.01


def test_a_movable_object_is_not_part_of_the_static_scene(
    static: StaticSdf, views: list[TrainingView]
) -> None:
    centre = POSES["cube"][:3, 3] + [0, 0, 0.005]
    assert static.conservative.distance(centre) > 0
    with_cube = static_sdf(views, 0.0, [], COARSE)
    assert with_cube.conservative.distance(centre) < 0


def test_unseen_is_solid_for_the_careful_and_free_for_the_bold(static: StaticSdf) -> None:
    assert set(np.unique(static.state)) == {FREE, SURFACE, UNSEEN}
    assert np.all(static.conservative.values_m <= static.observed.values_m + 1e-6)
    unseen = static.state == UNSEEN
    assert np.all(static.conservative.values_m[unseen] < 0)
    assert np.all(static.observed.values_m[unseen] > 0)
    beyond = np.array([0.5, 0.0, 3.0])
    assert static.conservative.distance(beyond) < 0.7


def test_the_static_scene_is_read_back_and_described(static: StaticSdf, tmp_path: Path) -> None:
    path = tmp_path / "sdf.npz"
    static.save(path)
    again = StaticSdf.load(path)
    np.testing.assert_array_equal(again.state, static.state)
    np.testing.assert_array_equal(again.observed.values_m, static.observed.values_m)
    assert again.table_z_m == 0.0
    assert not SdfGrid.load(path).closed
    about = static.to_record()
    assert about["free"] + about["surface"] + about["unseen"] == pytest.approx(1.0, abs=1e-3)
    assert about["truncation_m"] == pytest.approx(3 * about["voxel_m"])


def test_a_budget_of_voxels_makes_them_larger(views: list[TrainingView]) -> None:
    small = static_sdf(views, 0.0, [], StaticConfig(max_voxels=8000))
    assert small.state.size <= 9000
    assert small.conservative.voxel_m > 0.008


def test_without_views_there_is_no_static_scene_but_a_reason(tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match="0 points"):
        static_sdf([], 0.0)
    (tmp_path / "sdf.npz").write_bytes(b"old")
    about = write_static(tmp_path, [], None, {})
    assert about["file"] is None
    assert "0 points" in about["remark"]
    assert not (tmp_path / "sdf.npz").exists()


def test_the_scene_folder_gets_the_static_scene(views: list[TrainingView], tmp_path: Path) -> None:
    about = write_static(tmp_path, views, TASK, POSES, COARSE)
    assert about["file"] == "sdf.npz"
    again = StaticSdf.load(tmp_path / "sdf.npz")
    assert again.conservative.distance(POSES["cube"][:3, 3]) > 0
    nameless = write_static(tmp_path, views, None, {}, COARSE)
    assert nameless["table_z_m"] is None


def test_a_toy_that_could_not_be_reconstructed_keeps_its_known_mesh() -> None:
    sloth = load_task("sloth_into_basket").objects["sloth"]
    vertices, faces = cast_views.shape_mesh(sloth)
    assert is_watertight(faces)
    assert volume_m3(vertices, faces) > 0
    np.testing.assert_allclose(np.ptp(vertices, axis=0), sloth.size_m, rtol=0.02)


def test_a_basket_takes_its_handles_and_its_rim_out_of_the_scene() -> None:
    """What stays in the grid is an obstacle that nobody may touch: a toy goes over the handles."""
    basket = load_task("sloth_into_basket").objects["basket"]
    T = pose_of(np.array([0.48, 0.2, 0.0, 0.3]))
    angle = np.linspace(0.0, np.pi, 9)
    x, _, top = (np.array(basket.inner_m) + basket.wall_m) / [2, 2, 1]
    arch = np.stack([np.full(9, x), 0.03 * np.cos(angle), top + 0.03 * np.sin(angle)], axis=1)
    rim = np.array([[0.0, basket.inner_m[1] / 2 + basket.wall_m / 2, top + 0.003]])
    inside = np.array([[0.0, 0.0, 0.05]])
    for points, is_taken in ((arch, True), (rim, True), (inside, False)):
        away = from_outside_m(se3.apply(T, points), basket, T)
        assert np.all(away < 0.001) if is_taken else np.all(away > 0.03)
