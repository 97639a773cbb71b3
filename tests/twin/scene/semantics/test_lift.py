import numpy as np
import pytest
from table_scene import World, iou

from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.semantics.describe import scene_from_masks
from twin.scene.semantics.lift import render_labels


@pytest.fixture
def rasteriser() -> Rasteriser:
    return Rasteriser(RasterConfig(threads=1))


def test_lifting_perfect_masks_returns_them(tabletop: World, rasteriser: Rasteriser) -> None:
    frames = [(shot.viewpoint, tabletop.masks(shot)) for shot in tabletop.train]
    scene = scene_from_masks(tabletop.cloud, frames, rasteriser, "truth")
    assert {item.label for item in scene.instances} == set(tabletop.names.values())
    assert scene.source == "truth"
    for shot in tabletop.held_out:
        ids = render_labels(rasteriser, tabletop.cloud, scene.labels, shot.viewpoint)
        for item in scene.instances:
            number = next(k for k, name in tabletop.names.items() if name == item.label)
            assert iou(ids == item.id, shot.instance == number) > 0.87


def test_instances_know_their_box_colour_and_support(
    tabletop: World, rasteriser: Rasteriser
) -> None:
    frames = [(shot.viewpoint, tabletop.masks(shot)) for shot in tabletop.train]
    scene = scene_from_masks(tabletop.cloud, frames, rasteriser, "truth")
    cube = next(item for item in scene.instances if item.label == "red cube")
    np.testing.assert_allclose(cube.T_base_instance[:3, 3], [-0.13, -0.10, 0.02], atol=0.004)
    np.testing.assert_allclose(cube.size_m, [0.04, 0.04, 0.04], atol=0.007)
    assert cube.color_srgb[0] > 2 * cube.color_srgb[1]


def test_no_masks_give_no_instance_and_say_so(tabletop: World, rasteriser: Rasteriser) -> None:
    shot = tabletop.train[0]
    scene = scene_from_masks(
        tabletop.cloud, [(shot.viewpoint, tabletop.masks(shot))], rasteriser, "truth"
    )
    assert scene.instances == ()
    assert "4 masks in 1 frames gave no instance" in scene.remark
