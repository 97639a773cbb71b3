"""What one size of voxels finds by chance is no thing; what most find is, wherever points lie."""

from dataclasses import replace

import numpy as np
from table_scene import World

from twin.scene.gaussians import GaussianCloud
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.semantics.describe import scene_by_default
from twin.scene.semantics.segment import Look, stable


def looked(*found: list[range]) -> list[Look]:
    """Looks that find these things among 100 points."""
    looks = []
    for things in found:
        labels = np.zeros(100, dtype=np.int64)
        for number, members in enumerate(things, start=1):
            labels[list(members)] = number
        looks.append((labels, 0.004))
    return looks


def kept(looks: list[Look]) -> list[list[int]]:
    return [np.flatnonzero(mask).tolist() for mask, _ in stable(looks)]


def test_most_looks_decide() -> None:
    firm, rare = range(50), range(60, 90)
    assert kept(looked([firm, rare], [firm], [range(48)], [firm], [range(30)])) == [list(firm)]


def test_a_thing_and_its_pieces_are_not_both_things() -> None:
    whole, left, right = range(100), range(50), range(50, 100)
    assert kept(looked([whole], [whole], [whole], [left, right])) == [list(whole)]


def test_looks_that_do_not_agree_give_nothing() -> None:
    assert kept(looked(*[[range(10 * k, 10 * k + 10)] for k in range(6)])) == []


def clumped(cloud: GaussianCloud, rng: np.random.Generator) -> GaussianCloud:
    """The same surface with Gaussians where a fit may leave them: few, and in clumps."""
    p = cloud.means_m
    seeds = p[rng.choice(len(p), 60, replace=False)]
    near = np.min(np.linalg.norm(p[:, None] - seeds[None], axis=2), axis=1)
    return cloud.take(np.flatnonzero(rng.random(len(p)) < np.exp(-near / 0.02)))


def test_things_do_not_depend_on_where_a_fit_put_the_gaussians(tabletop: World) -> None:
    rng = np.random.default_rng(0)
    sparse = clumped(tabletop.cloud, rng)
    assert len(sparse) < 0.6 * len(tabletop.cloud)
    rasteriser = Rasteriser(RasterConfig(threads=1))
    fused = scene_by_default(sparse, [], rasteriser, fused=tabletop.cloud)
    assert {item.label for item in fused.instances} == set(tabletop.names.values())
    alone = scene_by_default(sparse, [], rasteriser)
    assert {item.label for item in alone.instances} != set(tabletop.names.values())


def test_gaussians_far_from_what_was_measured_belong_to_nothing(tabletop: World) -> None:
    rasteriser = Rasteriser(RasterConfig(threads=1))
    lifted = replace(tabletop.cloud, means_m=tabletop.cloud.means_m + np.float32([0, 0, 1]))
    scene = scene_by_default(lifted, [], rasteriser, fused=tabletop.cloud)
    assert not scene.labels.any()
