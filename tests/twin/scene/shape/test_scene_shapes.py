"""From training views to an object's folder."""

import json
from pathlib import Path

import cast_views
import numpy as np
import pytest
from clouds import even_cloud

from bridge.geometry import se3
from bridge.task.meshes.solids import is_closed
from bridge.task.task_file import load_task
from twin.scene.frames.rgbd import TrainingView
from twin.scene.objects.decompose import LibraryObject, ObjectSplats
from twin.scene.shape.from_training import masked_view, shapes_of
from twin.scene.shape.known import pose_of
from twin.scene.shape.mesh import volume_m3
from twin.scene.shape.reconstruct import ObjectShape

TASK, POSES = cast_views.TASK, cast_views.POSES


@pytest.fixture(scope="module")
def shapes(views: list[TrainingView]) -> dict[str, ObjectShape | str]:
    return shapes_of(views, TASK.objects, POSES)


def known_volume(key: str) -> float:
    return sum(float(np.prod(extents)) for _, extents in TASK.objects[key].panels())


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
    mean, _ = cast_views.mean_error_m(mesh, cast_views.placed("cube"))
    assert mean < 0.0015
    assert shape.is_watertight
    assert shape.volume_m3 == pytest.approx(known_volume("cube"), rel=0.1)


def test_what_cannot_be_reconstructed_says_why(views: list[TrainingView]) -> None:
    tipped = {"cube": se3.transform_from(np.array([0.7, 0.7, 0, 0]), np.array([0.5, -0.1, 0.02]))}
    assert "upright" in str(shapes_of(views, TASK.objects, tipped)["cube"])
    elsewhere = {"cube": pose_of(np.array([5.0, 5.0, 0.02, 0.0]))}
    assert "masks are empty" in str(shapes_of(views, TASK.objects, elsewhere)["cube"])
    assert "masks are empty" in str(shapes_of([], TASK.objects, POSES)["box"])


def library_object(key: str, shape: ObjectShape | str) -> LibraryObject:
    cloud = even_cloud(np.zeros((3, 3)), 1.0)
    return LibraryObject(
        model=TASK.objects[key],
        splats=ObjectSplats(cloud=cloud, T_base_object=POSES[key]),
        shape=shape,
        episode_id="scan_0001",
    )


def test_the_known_shape_stands_in_with_the_reason(tmp_path: Path) -> None:
    folder = tmp_path / "objects" / "cube"
    record = library_object("cube", "seen too little").write(folder)
    assert {p.name for p in folder.iterdir()} == set(record["files"])
    about = json.loads((folder / "object.json").read_text())
    assert about["shape_source"] == "task file"
    assert about["shape_remark"] == "seen too little"


def test_a_toy_that_could_not_be_reconstructed_keeps_its_known_mesh() -> None:
    sloth = load_task("sloth_into_basket").objects["sloth"]
    vertices, faces = cast_views.shape_mesh(sloth)
    assert is_closed(faces)
    assert volume_m3(vertices, faces) > 0
    np.testing.assert_allclose(np.ptp(vertices, axis=0), sloth.size_m, rtol=0.02)


def test_a_pixel_belongs_to_the_nearest_object(views: list[TrainingView]) -> None:
    masks = {key: masked_view(views[0], key, TASK.objects, POSES).mask for key in POSES}
    assert masks["cube"].any()
    assert masks["box"].any()
    assert not (masks["cube"] & masks["box"]).any()
