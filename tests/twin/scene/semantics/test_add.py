"""What rebuild calls: files in the scene folder, and the record that names them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from table_scene import World, make_world, table

from bridge.geometry import se3
from twin.naming import scene_file
from twin.naming.phrases import Asker
from twin.scene.gaussians import GaussianCloud, concatenate, moved_cloud
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.semantics.describe import scene_by_default

T_ABOVE = se3.transform_from(np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.1, 0.1, 0.02]))


def added(folder: Path, world: World, **options: object) -> dict[str, object]:
    """Take the red cube out as an object, as rebuild does."""
    cube = world.true_instances() == 1
    return written(folder, world.cloud.take(~cube), world.cloud.take(cube), world, **options)


def written(
    folder: Path, background: GaussianCloud, cube: GaussianCloud, world: World, **options: object
) -> dict[str, object]:
    cloud = concatenate([background, cube])
    scene = scene_by_default(
        cloud,
        [shot.viewpoint for shot in world.train],
        Rasteriser(RasterConfig(threads=1)),
        known={"red_cube": np.arange(len(cloud)) >= len(background)} if len(cube) else {},
        **options,  # type: ignore[arg-type]
    )
    rows = {"background": len(background)} | ({"red_cube": len(cube)} if len(cube) else {})
    return scene_file.write_semantics(folder, scene, rows)


def rows_of(world: World) -> dict[str, int]:
    cube = int((world.true_instances() == 1).sum())
    return {"background": len(world.cloud) - cube, "red_cube": cube}


def test_what_is_written_comes_back(tabletop: World, tmp_path: Path) -> None:
    told: list[tuple[int, str]] = []
    record = added(tmp_path, tabletop, advance=lambda *step: told.append(step))
    assert [done for done, _ in told] == sorted(done for done, _ in told)
    assert told[0] == (30, "4 things found")
    assert told[-1][0] == 100
    scene = scene_file.read_semantics(tmp_path, rows_of(tabletop))
    assert {item.label for item in scene.instances} == set(tabletop.names.values())
    assert record["source"] == scene.source == "default segmenter"
    about = {item["label"]: item for item in record["instances"]}  # type: ignore[attr-defined]
    assert about["red cube"]["object"] == "red_cube"
    assert about["green ball"]["object"] is None
    box = next(item for item in scene.instances if item.label == "blue open container")
    assert set(box.parts) == {"rim", "floor", "walls"}
    assert not any((mask & ~box.mask).any() for mask in box.parts.values())
    rim = Asker(scene=scene).find("rim of the box").found
    assert [(each.item.id, each.part) for each in rim] == [(box.id, "rim")]
    np.testing.assert_allclose(
        box.T_base_instance[:3, :3] @ box.T_base_instance[:3, :3].T, np.eye(3), atol=1e-9
    )


def test_semantics_of_other_splats_are_refused(tabletop: World, tmp_path: Path) -> None:
    added(tmp_path, tabletop)
    rows = rows_of(tabletop)
    with pytest.raises(scene_file.UnreadableSemanticsError, match="made for files with"):
        scene_file.read_semantics(tmp_path, {**rows, "red_cube": rows["red_cube"] + 1})
    path = tmp_path / "semantics.npz"
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(scene_file.UnreadableSemanticsError, match="unreadable"):
        scene_file.read_semantics(tmp_path, rows)


def test_completed_gaussians_are_nothing_and_change_no_thing(
    tabletop: World, tmp_path: Path
) -> None:
    """A second copy of what stands on the table, lifted beside it, would be things."""
    is_cube = tabletop.true_instances() == 1
    background = tabletop.cloud.take(~is_cube)
    is_thing = tabletop.true_instances()[~is_cube] > 1
    ghosts = moved_cloud(background.take(is_thing), T_ABOVE)
    assert len(ghosts) > 100
    labels = []
    for name, more in (("plain", []), ("ghosts", [ghosts.as_completed()])):
        folder = tmp_path / name
        folder.mkdir()
        whole = concatenate([background, *more])
        cube = tabletop.cloud.take(is_cube)
        written(folder, whole, cube, tabletop)
        rows = {"background": len(whole), "red_cube": len(cube)}
        labels.append(scene_file.read_semantics(folder, rows).labels)
    plain, ghostly = labels
    first = len(background)
    assert plain.any()
    assert not ghostly[first : first + len(ghosts)].any()
    np.testing.assert_array_equal(np.delete(ghostly, np.s_[first : first + len(ghosts)]), plain)


def test_an_empty_table_is_a_remark_not_an_error(tmp_path: Path) -> None:
    world = make_world([table()], num_train=4, num_held_out=0)
    record = written(tmp_path, world.cloud, world.cloud.take(np.zeros(0, dtype=int)), world)
    assert record["instances"] == []
    assert str(record["remark"]).startswith("nothing stands on the level plane")
    scene = scene_file.read_semantics(tmp_path, {"background": len(world.cloud)})
    assert not scene.labels.any()


def test_an_empty_scene_is_a_remark_too(tabletop: World, tmp_path: Path) -> None:
    nothing = tabletop.cloud.take(np.zeros(0, dtype=int))
    record = written(tmp_path, nothing, nothing, tabletop)
    assert "no level plane among 0 points" in str(record["remark"])


def test_vectors_lie_beside_the_labels_and_fit_this_scene_only(
    tabletop: World, tmp_path: Path
) -> None:
    added(tmp_path, tabletop)
    scene = scene_file.read_semantics(tmp_path, rows_of(tabletop))
    assert scene_file.read_vectors(tmp_path, scene) is None
    vectors = np.random.default_rng(0).normal(size=(len(scene.instances), 3)).astype(np.float32)
    scene_file.write_vectors(tmp_path, scene, vectors, "made model")
    back = scene_file.read_vectors(tmp_path, scene)
    assert back is not None
    np.testing.assert_array_equal(back[0], vectors)
    assert back[1] == "made model"
    with pytest.raises(scene_file.UnreadableSemanticsError, match="made for another scene"):
        scene_file.read_vectors(tmp_path, replace(scene, instances=scene.instances[1:]))
