from dataclasses import replace

import numpy as np
import pytest
import textured_room
from seen_colors import view_directions

from twin.scene import gaussians
from twin.scene.fit import appearance
from twin.scene.fit.appearance import gain_between, solve_gains
from twin.scene.fit.initialise import fuse
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, training_view
from twin.scene.harmonics import harmonic_terms
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser

Room = tuple[gaussians.GaussianCloud, list[appearance.ImageObservation]]
LIMITS = DepthLimits(max_depth_m=5.0, flying_fraction=0.1)
GAINS = np.array([[1.1, 0.9, 1.0], [0.8, 1.2, 1.05], [1.1, 0.9, 0.95]])


@pytest.fixture(scope="module")
def room() -> Room:
    """Sixty Gaussians and three half-size images, each with a hole and a brightness of its own."""
    surfaces = [FrameSurface(textured_room.frame(i, 3), LIMITS) for i in range(3)]
    cloud = fuse([surface.points() for surface in surfaces], 60)
    observations = []
    for index, surface in enumerate(surfaces):
        view = training_view(surface)
        mask = view.half.static_mask.copy()
        mask[5:12, 6 + 4 * index : 14 + 4 * index] = False
        observations.append(
            appearance.ImageObservation(
                target=replace(view.half, static_mask=mask),
                T_base_camera=view.T_base_color,
                gain=GAINS[index],
            )
        )
    return cloud, observations


def rasteriser() -> Rasteriser:
    return Rasteriser(RasterConfig(threads=1))


def weights(cloud: gaussians.GaussianCloud, item: appearance.ImageObservation) -> np.ndarray:
    """The matrix A of one view, (pixels, Gaussians): each column drawn by itself in white."""
    draw = rasteriser()
    columns = []
    for first in range(0, len(cloud), 3):
        colors = np.zeros((len(cloud), 3), dtype=np.float32)
        for channel, index in enumerate(range(first, min(first + 3, len(cloud)))):
            colors[index, channel] = 1.0
        plain = replace(gaussians.with_harmonics(cloud, 0), colors=colors)
        columns += list(draw.draw_planes(plain, item.target.camera, item.T_base_camera)[:3])
    return np.stack([column.ravel() for column in columns[: len(cloud)]], axis=1)


def dense_solution(
    start: gaussians.GaussianCloud, observations: list[appearance.ImageObservation]
) -> np.ndarray:
    """Colour and harmonics (terms, Gaussians, channels) by one least squares of all channels."""
    count, terms = len(start), 1 + start.num_harmonics
    ridge = np.array([appearance.RIDGE_COLOR] + [appearance.RIDGE_HARMONICS] * start.num_harmonics)
    normal = np.diag(np.repeat(ridge, 3 * count))
    right = np.zeros((terms * count, 3))
    origin = np.concatenate([start.colors[:, None], start.harmonics], axis=1).transpose(1, 0, 2)
    for item in observations:
        A = weights(start, item).astype(np.float64)
        towards = view_directions(start.means_m, item.T_base_camera[:3, 3])
        basis = np.ones((count, terms))
        if terms > 1:
            basis[:, 1:] = np.stack(harmonic_terms(*towards.T), axis=1)
        seen = item.target.static_mask.ravel()
        blocks = np.concatenate([A * basis[:, term] for term in range(terms)], axis=1)[seen]
        M = np.diag(item.gain)
        missing = item.target.image().reshape(3, -1).T[seen]
        missing -= blocks @ origin.reshape(-1, 3) @ M.T
        normal += np.kron(blocks.T @ blocks, M.T @ M)
        right += blocks.T @ missing @ M
    change = np.linalg.solve(normal, right.ravel())
    return np.asarray(origin + change.reshape(terms, count, 3))


@pytest.mark.parametrize("num_harmonics", [0, 3])
def test_the_solution_is_that_of_a_dense_least_squares(room: Room, num_harmonics: int) -> None:
    cloud, observations = room
    start = gaussians.with_harmonics(cloud, num_harmonics)
    solved = appearance.solve_appearance(start, observations, rasteriser(), steps=250)[0]
    found = np.concatenate([solved.colors[:, None], solved.harmonics], axis=1)
    expected = dense_solution(start, observations)
    np.testing.assert_allclose(found.transpose(1, 0, 2), expected, atol=3e-3)


def test_what_a_mask_hides_does_not_matter(room: Room) -> None:
    cloud, observations = room
    spoilt = []
    for item in observations:
        planes = item.target.planes_u8.copy()
        planes[:, ~item.target.static_mask] = 255
        spoilt.append(replace(item, target=replace(item.target, planes_u8=planes)))
    clean, other = (
        appearance.solve_appearance(cloud, items, rasteriser(), steps=3)[0]
        for items in (observations, spoilt)
    )
    np.testing.assert_array_equal(clean.colors, other.colors)
    np.testing.assert_array_equal(
        solve_gains(cloud, observations, rasteriser()), solve_gains(cloud, spoilt, rasteriser())
    )


def test_a_gaussian_that_no_pixel_shows_keeps_its_colour(room: Room) -> None:
    cloud, observations = room
    means = cloud.means_m.copy()
    means[7] = (0.0, -30.0, 0.0)
    moved = replace(cloud, means_m=means)
    solved = appearance.solve_appearance(moved, observations, rasteriser(), steps=3)[0]
    np.testing.assert_array_equal(solved.colors[7], cloud.colors[7])
    assert not np.array_equal(solved.colors[8], cloud.colors[8])


def test_gains_are_found_up_to_their_mean(room: Room) -> None:
    cloud, observations = room
    true = np.array([[0.8, 1.0, 0.9], [0.9, 0.7, 0.6], [0.7, 0.8, 0.9]])
    draw = rasteriser()
    exposed = []
    for item, gain in zip(observations, true, strict=True):
        planes = draw.draw_planes(cloud, item.target.camera, item.T_base_camera)[:3]
        recorded = np.rint(np.clip(planes * gain[:, None, None], 0, 1) * 255).astype(np.uint8)
        exposed.append(replace(item, target=replace(item.target, planes_u8=recorded)))
    found = solve_gains(cloud, exposed, draw)
    expected = true / true.mean(axis=0)
    np.testing.assert_allclose(found, expected, rtol=5e-3)
    np.testing.assert_allclose(found.mean(axis=0), 1.0, rtol=1e-12)


def test_a_saturated_pixel_says_nothing_about_the_gain(room: Room) -> None:
    cloud, observations = room
    item = observations[0]
    drawn = rasteriser().draw_planes(cloud, item.target.camera, item.T_base_camera)[:3]
    recorded = np.rint(np.clip(drawn, 0, 0.9) * 255).astype(np.uint8)
    recorded[:, :4] = 255
    target = replace(item.target, planes_u8=recorded)
    np.testing.assert_allclose(gain_between(gaussians.as_float32(drawn), target), 1.0, atol=0.03)


def test_conjugate_gradients_end_after_as_many_steps_as_unknowns() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(5, 5))
    A = (A @ A.T + np.eye(5)).astype(np.float32)
    right = rng.normal(size=(5, 1, 2)).astype(np.float32)
    diagonal = np.ones_like(right) * np.diag(A)[:, None, None]
    x, steps = appearance.conjugate_gradients(
        lambda v: np.einsum("ij,jkc->ikc", A, v), right, diagonal, steps=50
    )
    assert steps < 20
    expected = np.linalg.solve(A.astype(np.float64), right[:, 0])
    np.testing.assert_allclose(x[:, 0], expected, atol=2e-4)
