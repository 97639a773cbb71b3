from dataclasses import replace

import numpy as np
import pytest
import textured_room

from twin.scene.fit import optimise
from twin.scene.fit.initialise import fuse
from twin.scene.fit.optimise import ImageObservation, fit
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, TrainingView, training_view
from twin.scene.gaussians import GaussianCloud, arrays
from twin.scene.raster.rasteriser import psnr_db
from twin.scene.settings import FitConfig

LIMITS = DepthLimits(max_depth_m=5.0, flying_fraction=0.1)
ADAM_ALONE = FitConfig(iterations=1, threads=1)
"""One image is over before the first event of the schedule."""


@pytest.fixture(scope="module")
def room() -> tuple[GaussianCloud, list[TrainingView]]:
    surfaces = [FrameSurface(textured_room.frame(i, 4), LIMITS) for i in range(4)]
    start = fuse([surface.points() for surface in surfaces], 750)
    return start, [training_view(surface) for surface in surfaces]


def test_frames_of_different_exposure_are_told_from_the_scene(
    room: tuple[GaussianCloud, list[TrainingView]], monkeypatch: pytest.MonkeyPatch
) -> None:
    start, views = room
    gains = np.array([0.7, 0.9, 0.8, 0.6])
    exposed = [
        replace(
            view,
            half=replace(view.half, planes_u8=(view.half.planes_u8 * gain).astype(np.uint8)),
            full=replace(view.full, planes_u8=(view.full.planes_u8 * gain).astype(np.uint8)),
        )
        for view, gain in zip(views, gains, strict=True)
    ]
    config = FitConfig(iterations=30, threads=1)
    told = fit(start, exposed, config, lambda *_: None)
    monkeypatch.setattr(optimise, "EXPOSURES_AT", ())
    untold = fit(start, exposed, config, lambda *_: None)
    assert told.train_psnr_db > untold.train_psnr_db + 1.0
    np.testing.assert_allclose(told.gains.mean(axis=0), 1.0, rtol=1e-9)
    np.testing.assert_allclose(told.gains / gains[:, None] * gains.mean(), 1.0, atol=0.06)
    np.testing.assert_array_equal(untold.gains, 1.0)


def test_gaussians_are_added_within_their_budget(
    room: tuple[GaussianCloud, list[TrainingView]],
) -> None:
    start, views = room
    most = len(start) + 120
    config = FitConfig(iterations=20, threads=1)
    grown = fit(start, views, config, lambda *_: None, max_splats=most)
    assert len(start) < len(grown.cloud) <= most
    assert len(fit(start, views, config, lambda *_: None).cloud) <= len(start)


def test_errors_are_lifted_from_images_of_both_sizes_the_full_ones_last(
    room: tuple[GaussianCloud, list[TrainingView]], monkeypatch: pytest.MonkeyPatch
) -> None:
    widths: list[int] = []
    score = optimise.score

    def noted(
        cloud: GaussianCloud, observations: list[ImageObservation], *rest: object
    ) -> optimise.Scores:
        widths.append(observations[0].target.camera.width)
        return score(cloud, observations, *rest)

    monkeypatch.setattr(optimise, "score", noted)
    fit(*room, FitConfig(iterations=20, threads=1), lambda *_: None)
    half, full = (target.camera.width for target in (room[1][0].half, room[1][0].full))
    assert widths[0] == half
    assert widths[-1] == full
    assert widths == sorted(widths)


def test_a_fit_ends_with_the_mean_of_its_last_gaussians(
    room: tuple[GaussianCloud, list[TrainingView]], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[GaussianCloud] = []
    add = optimise.RunningSum.add

    def noted(self: optimise.RunningSum, cloud: GaussianCloud) -> None:
        seen.append(cloud.take(np.arange(len(cloud))))
        add(self, cloud)

    monkeypatch.setattr(optimise.RunningSum, "add", noted)
    monkeypatch.setattr(optimise, "SLAB", np.inf)
    fitted = fit(*room, FitConfig(iterations=150, threads=1), lambda *_: None)
    assert len(seen) == 3  # every fifth image of the last twelve
    assert np.abs(seen[0].colors - seen[-1].colors).max() > 1e-3
    for name, rows in arrays(fitted.cloud):
        mean = np.mean([getattr(cloud, name) for cloud in seen], axis=0, dtype=np.float64)
        np.testing.assert_allclose(rows, mean, rtol=1e-5, atol=1e-6)


def test_a_number_of_images_repeats_bit_for_bit_with_any_threads(
    room: tuple[GaussianCloud, list[TrainingView]],
) -> None:
    results = [
        fit(*room, FitConfig(iterations=6, threads=threads), lambda *_: None).cloud
        for threads in (1, 2)
    ]
    for name, rows in arrays(results[0]):
        np.testing.assert_array_equal(rows, getattr(results[1], name))


def test_pixels_that_are_passed_over_do_not_make_the_fit_look_better(
    room: tuple[GaussianCloud, list[TrainingView]], monkeypatch: pytest.MonkeyPatch
) -> None:
    start, views = room
    monkeypatch.setattr(optimise, "COARSE", 0.0)

    def masked(view: TrainingView, shown: slice) -> TrainingView:
        mask = np.zeros_like(view.full.static_mask)
        mask[:, shown] = True
        return replace(view, full=replace(view.full, static_mask=mask))

    halves = [
        fit(start, [masked(views[0], side)], ADAM_ALONE, lambda *_: None).train_psnr_db
        for side in (slice(None, 32), slice(32, None))
    ]
    whole = fit(start, views[:1], ADAM_ALONE, lambda *_: None).train_psnr_db
    nothing = fit(start, [masked(views[0], slice(0, 0))], ADAM_ALONE, lambda *_: None)
    mse = np.mean([10 ** (-half / 10) for half in halves])
    assert whole == pytest.approx(psnr_db(float(mse)), abs=1e-3)
    assert nothing.train_psnr_db is None
