"""A scene in parts: reading gives the parts back, and putting together gives the scene."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clouds import even_cloud

from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.task.task_file import load_task
from twin.scene.gaussians import GaussianCloud, as_float32, concatenate, moved_cloud
from twin.scene.movable_scene import MovableScene
from twin.scene.objects.decompose import LibraryObject, ObjectSplats, read_objects
from twin.scene.shape.sdf import SdfGrid


def cube_on_table(T_base_cube: np.ndarray) -> GaussianCloud:
    rng = np.random.default_rng(0)
    face = rng.uniform(-0.02, 0.02, (600, 3))
    face[np.arange(600), rng.integers(0, 3, 600)] = np.sign(rng.normal(size=600)) * 0.02
    cube = se3.apply(T_base_cube, face)
    table = np.column_stack(
        [rng.uniform(0.2, 0.8, 900), rng.uniform(-0.4, 0.4, 900), np.zeros(900)]
    )
    means = np.concatenate([cube, table])
    colors = np.tile([0.55, 0.42, 0.30], (1500, 1))
    colors[:600] = np.array([200, 45, 40]) / 255
    return even_cloud(means, colors, logit=3.0)


@pytest.fixture
def written(tmp_path: Path) -> tuple[RunFolder, dict, GaussianCloud, np.ndarray]:
    T = se3.transform_from(np.array([0.97, 0, 0, 0.24]), np.array([0.5, -0.1, 0.02]))
    cloud, task = cube_on_table(T), load_task("cube_into_box")
    cube = LibraryObject(
        model=task.objects["cube"],
        splats=ObjectSplats(
            cloud=moved_cloud(cloud.take(np.arange(600)), se3.invert(T)), T_base_object=T
        ),
        shape="seen too little",
        episode_id="scan_0001",
    )
    run = RunFolder.create(tmp_path / "run")
    record = {"objects": {"cube": cube.write(run.scene_dir / "objects" / "cube")}}
    return run, record, cloud.take(np.arange(600, 1500)), T


def test_an_object_name_cannot_leave_the_scene_folder(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="not usable as a file name"):
        read_objects(RunFolder(tmp_path), {"objects": {"../../etc": {}}})


def test_a_table_just_under_a_closed_object_is_not_drawn_and_one_beside_it_is(
    written: tuple[RunFolder, dict, GaussianCloud, np.ndarray],
) -> None:
    run, record, background, T = written
    centres = np.arange(-0.03, 0.0301, 0.001)
    from_middle = np.abs(np.stack(np.meshgrid(centres, centres, centres, indexing="ij"), axis=-1))
    sdf = SdfGrid(
        values_m=(from_middle.max(axis=-1) - 0.02).astype(np.float32),
        origin_m=np.full(3, -0.03),
        voxel_m=0.001,
    )
    closed = replace(read_objects(run, record)["cube"], T_base_object=T, sdf=sdf)
    scene = MovableScene(background=background, objects={"cube": closed}, links={})
    p = se3.apply(se3.invert(T), background.means_m.astype(np.float64))
    under = (np.abs(p[:, :2]) < 0.0195).all(axis=1)
    beside = (np.abs(p[:, :2]) > 0.0205).any(axis=1)
    added = background.take(np.flatnonzero(beside)[:1])
    added = replace(added, means_m=as_float32(T[:3, 3][None] - [[0.0, 0.0, 0.026]]))
    scene = replace(scene, background=concatenate([background, added]))
    before, drawn = scene.background.opacities(), scene.at({}).opacities()[: len(background) + 1]
    hidden = drawn < 1e-6
    assert hidden[-1]  # 6 mm below the cube
    assert hidden[:-1][under].all()
    np.testing.assert_array_equal(drawn[:-1][beside], before[:-1][beside])
    z, off_m = scene.at({}).means_m[: len(p), 2], (np.abs(p) - 0.02).max(axis=1)
    assert (z[off_m < 0.012] <= -0.002).all()  # nothing of it is drawn over the cube's foot
    np.testing.assert_array_equal(z[off_m > 0.035], background.means_m[off_m > 0.035, 2])
    elsewhere = T.copy()
    elsewhere[:3, 3] += [0.0, 0.2, 0.1]
    np.testing.assert_array_equal(scene.at({"cube": elsewhere}).opacities()[: len(before)], before)
