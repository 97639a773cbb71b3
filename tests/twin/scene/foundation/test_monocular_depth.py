"""A guess of depth is laid onto what was measured, or refused; holes are closed with it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from bridge.terminal import Output
from twin.scene.fit.completion import ClosedHoles, complete_holes
from twin.scene.fit.initialise import fuse
from twin.scene.foundation import monocular_depth
from twin.scene.foundation.monocular_depth import (
    DepthDisagreesError,
    DepthGuesser,
    align_depth,
    describe_guesses,
)
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, TrainingView, training_view
from twin.scene.frames.selection import Sources
from twin.scene.gaussians import GaussianCloud, read_ply
from twin.scene.raster.rasteriser import RasterConfig
from twin.scene.rebuild.record import describe_scene
from twin.scene.rebuild.run import rebuild
from twin.scene.settings import FitConfig, InitialiseConfig, ModelConfig, RebuildConfig

SHAPE = (40, 60)
QUIET = Output(quiet=True)


def surface_m(rng: np.random.Generator) -> np.ndarray:
    """A table that rises to a wall, with a box before it."""
    row, column = np.indices(SHAPE)
    depth = 0.6 + 0.03 * row[::-1] + 0.004 * column
    depth[20:30, 20:35] -= 0.15
    return (depth + rng.normal(scale=1e-3, size=SHAPE)).astype(np.float32)


def with_outliers(depth_m: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    wrong = rng.random(depth_m.shape) < share
    return np.where(wrong, rng.uniform(0.2, 4.0, depth_m.shape), depth_m).astype(np.float32)


EVERYWHERE = np.ones(SHAPE, dtype=bool)


@pytest.mark.parametrize("is_inverse", [True, False])
def test_scale_and_shift_are_found_where_a_third_of_what_was_measured_is_wrong(
    is_inverse: bool,
) -> None:
    rng = np.random.default_rng(1)
    truth = surface_m(rng)
    value = 1.0 / truth if is_inverse else truth
    guessed = ((value - 0.2) / 0.7).astype(np.float32)
    measured = with_outliers(truth, 0.3, rng)
    measured[:10, :20] = 0.0
    found = align_depth(guessed, measured, EVERYWHERE, is_inverse=is_inverse)
    assert found.scale == pytest.approx(0.7, rel=3e-3)
    assert found.shift == pytest.approx(0.2, abs=3e-3)
    np.testing.assert_allclose(found.depth_m(guessed), truth, rtol=4e-3)
    assert 0.65 < found.agreeing < 0.85
    assert found.scatter < 5e-3


@pytest.mark.parametrize("is_inverse", [True, False])
def test_nothing_changes_when_the_guess_is_scaled_and_shifted(is_inverse: bool) -> None:
    rng = np.random.default_rng(2)
    truth = surface_m(rng)
    value = 1.0 / truth if is_inverse else truth
    guessed = (value * np.exp(rng.normal(scale=0.02, size=SHAPE))).astype(np.float32)
    measured = with_outliers(truth, 0.2, rng)
    wanted = align_depth(guessed, measured, EVERYWHERE, is_inverse=is_inverse)
    for scale, shift in ((5.0, -3.0), (0.01, 0.0), (300.0, 1000.0)):
        other = (scale * guessed.astype(np.float64) + shift).astype(np.float64)
        found = align_depth(other, measured, EVERYWHERE, is_inverse=is_inverse)
        np.testing.assert_allclose(
            found.depth_m(other), wanted.depth_m(guessed), rtol=1e-4, atol=1e-5
        )
        assert found.scatter == pytest.approx(wanted.scatter, rel=1e-3)


def test_pixels_that_must_not_count_do_not() -> None:
    rng = np.random.default_rng(3)
    truth = surface_m(rng)
    wrong, usable = truth.copy(), EVERYWHERE.copy()
    wrong[:, :40] *= 3.0
    usable[:, :40] = False
    found = align_depth(1.0 / truth, wrong, usable, is_inverse=True)
    assert found.scale == pytest.approx(1.0, rel=5e-3)
    assert found.agreeing == 1.0


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda guessed, measured, rng: (guessed, measured * (rng.random(SHAPE) < 0.03)), "only "),
        (lambda guessed, measured, rng: (np.ones(SHAPE), measured), "same is guessed everywhere"),
        (lambda guessed, measured, rng: (-guessed, measured), "not nearer|agree|fits"),
        (
            lambda guessed, measured, rng: (rng.random(SHAPE), measured),
            "not nearer|agree|fits about as well",
        ),
        (lambda guessed, measured, rng: (guessed, with_outliers(measured, 0.7, rng)), "agree"),
        (
            lambda guessed, measured, rng: (
                rng.random(SHAPE),
                np.full(SHAPE, 1.0) + rng.normal(scale=1e-3, size=SHAPE),
            ),
            "not nearer|fits about as well",
        ),
    ],
)
def test_a_guess_that_explains_nothing_is_refused(change: Any, found: str) -> None:
    rng = np.random.default_rng(4)
    truth = surface_m(rng)
    guessed, measured = change(1.0 / truth, truth, rng)
    with pytest.raises(DepthDisagreesError, match=found):
        align_depth(
            guessed.astype(np.float32), measured.astype(np.float32), EVERYWHERE, is_inverse=True
        )


def test_far_from_what_was_measured_nothing_is_guessed() -> None:
    rng = np.random.default_rng(5)
    truth = surface_m(rng)
    guessed = 1.0 / truth
    guessed[0, 0], guessed[0, 1], guessed[0, 2] = 0.0, 1.0 / 30.0, 1.0 / 0.1
    depth = align_depth(guessed, truth, EVERYWHERE, is_inverse=True).depth_m(guessed)
    assert depth[0, :3].tolist() == [0.0, 0.0, 0.0]
    assert (depth[1:] > 0).all()


# Holes in the textured room, with a network that knows its true depth up to an affine map.

LIMITS = DepthLimits(max_depth_m=5.0, flying_fraction=0.1)
CONFIG = InitialiseConfig(max_splats=20_000, completion=0.5)
RASTER = RasterConfig(threads=1)
HOLE_M, RADIUS_M = np.array([0.0, 0.25]), 0.2
NUM_FRAMES = 9


def black_hole(frame: RgbdFrame) -> RgbdFrame:
    """A disc on the table, all black, with no depth: views look alike there at many distances."""
    import textured_room

    def inside(camera: Any, T: np.ndarray) -> np.ndarray:
        _, p = textured_room.depth_and_points(camera, T)
        on_table = np.abs(p[..., 2]) < 0.01
        return on_table & (np.linalg.norm(p[..., :2] - HOLE_M, axis=-1) < RADIUS_M)

    image_u8 = frame.image_u8.copy()
    image_u8[inside(frame.color_camera, frame.T_base_color)] = 8
    dark = inside(frame.depth_camera, frame.T_base_depth)
    return replace(frame, image_u8=image_u8, depth_m=np.where(dark, np.float32(0.0), frame.depth_m))


class KnowsTheRoom:
    """Says a function of the true depth of the room's images, which it knows by heart."""

    source = "stand-in"

    def __init__(self, change: Any, *, is_metric: bool = False, num_frames: int) -> None:
        """Say what is answered: a function of true depth."""
        import textured_room

        self.is_metric = is_metric
        self._change = change
        self._frames = [textured_room.frame(index, num_frames) for index in range(num_frames)]
        self.asked = 0

    def predict(self, image_u8: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        import textured_room

        self.asked += 1
        off = [np.abs(f.image_u8.astype(int) - image_u8).mean() for f in self._frames]
        frame = self._frames[int(np.argmin(off))]
        camera = training_view(FrameSurface(frame, LIMITS)).half.camera
        assert (camera.height, camera.width) == size
        depth, _ = textured_room.depth_and_points(camera, frame.T_base_color)
        return np.asarray(self._change(depth), dtype=np.float32)


@pytest.fixture(scope="module")
def scanned() -> tuple[GaussianCloud, list[TrainingView]]:
    import textured_room

    frames = [black_hole(textured_room.frame(index, NUM_FRAMES)) for index in range(NUM_FRAMES)]
    surfaces = [FrameSurface(frame, LIMITS) for frame in frames]
    cloud = fuse([surface.points() for surface in surfaces], CONFIG)
    return cloud, [training_view(surface) for surface in surfaces]


def off_surface_m(added: GaussianCloud) -> np.ndarray:
    """Distance of what was added near the hole to the table, or the wall behind it."""
    p = added.means_m
    near = np.linalg.norm(p[:, :2] - HOLE_M, axis=1) < RADIUS_M + 0.1
    return np.minimum(np.abs(p[near, 2]), np.abs(p[near, 1] - 0.6))


def closed_with(
    scanned: tuple[GaussianCloud, list[TrainingView]], change: Any, *, is_metric: bool = False
) -> tuple[ClosedHoles, dict[str, Any]]:
    network = KnowsTheRoom(change, is_metric=is_metric, num_frames=NUM_FRAMES)
    guesser = DepthGuesser(network, "0" * 64)
    closed = complete_holes(*scanned, CONFIG, RASTER, guesser)
    record = guesser.to_record(closed)
    assert record["images_asked"] == network.asked
    return closed, record


@pytest.mark.parametrize(
    ("change", "is_metric"),
    [
        (lambda z: 3.0 / z + 2.0, False),
        (lambda z: 0.02 / z, False),
        (lambda z: 1.3 * z + 0.2, True),
    ],
)
def test_a_true_guess_up_to_its_own_scale_closes_a_black_hole_where_the_surface_is(
    scanned: tuple[GaussianCloud, list[TrainingView]], change: Any, is_metric: bool
) -> None:
    without = off_surface_m(complete_holes(*scanned, CONFIG, RASTER).cloud)
    closed, record = closed_with(scanned, change, is_metric=is_metric)
    off_m = off_surface_m(closed.cloud)
    assert len(off_m) > 30
    assert np.median(off_m) < 0.3 * np.median(without)
    assert np.quantile(off_m, 0.9) < 0.03
    assert record["images_used"] == record["images_asked"] > 0
    assert record["guesses"] == ("depth" if is_metric else "inverse depth")
    assert 0 < record["num_splats"] == closed.guessed.sum() <= len(closed.cloud)
    assert record["pixels"] >= record["num_splats"]
    assert closed.cloud.completed.all()


def test_a_guess_refused_in_every_image_changes_nothing(
    scanned: tuple[GaussianCloud, list[TrainingView]],
) -> None:
    without = complete_holes(*scanned, CONFIG, RASTER)
    rng = np.random.default_rng(0)
    closed, record = closed_with(scanned, lambda z: rng.random(z.shape))
    np.testing.assert_array_equal(closed.cloud.means_m, without.cloud.means_m)
    assert record["images_used"] == record["num_splats"] == record["pixels"] == 0
    assert record["median_scatter"] is None
    assert len(record["refused"]) == record["images_asked"] > 0
    told = describe_guesses(record)
    assert "0 Gaussians" in told
    assert record["refused"][0]["why"] in told


def test_a_guess_before_what_a_view_measured_is_never_used(
    scanned: tuple[GaussianCloud, list[TrainingView]],
) -> None:
    """True where depth was measured, far too near in the hole: other views measured through it."""
    _, views = scanned

    def too_near(depth: np.ndarray) -> np.ndarray:
        return 1.0 / np.where(hole(depth), 0.62 * depth, depth)

    def hole(depth: np.ndarray) -> np.ndarray:
        for view in views:
            if np.median(np.abs(depth - view.half.depth_m)[view.half.depth_m > 0]) < 0.01:
                return view.half.depth_m == 0
        raise AssertionError("a view is drawn that nobody trained on")

    closed, record = closed_with(scanned, too_near)
    assert record["images_used"] > 0
    p = closed.cloud.means_m[closed.guessed].astype(np.float64)
    for view in views:  # whatever is left of it hides no measurement
        q = se3.apply(se3.invert(view.T_base_color), p)
        camera = view.half.camera
        uv, z = camera.project(q)
        u, v = np.floor(uv[:, 0]).astype(int), np.floor(uv[:, 1]).astype(int)
        seen = (z > 0.05) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        measured = view.half.depth_m[v[seen], u[seen]]
        assert not (measured > z[seen] + 0.03 + 0.03 * z[seen] + 1e-6).any()
    honest, _ = closed_with(scanned, lambda z: 1.0 / z)
    assert closed.num_guessed_px < honest.num_guessed_px


SMALL = RebuildConfig(
    fit=FitConfig(iterations=60, threads=1),
    initialise=InitialiseConfig(max_splats=6000, flying_fraction=0.1, completion=0.5),
)


def room_with_a_hole(folder: Path, monkeypatch: pytest.MonkeyPatch) -> RunFolder:
    import textured_room

    whole = textured_room.frame
    run = RunFolder.create(folder)
    with monkeypatch.context() as patch:
        patch.setattr(textured_room, "frame", lambda index, count: black_hole(whole(index, count)))
        textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=9)
    return run


def completed_off_m(run: RunFolder) -> float:
    """Median distance to the surface of what the scene holds in the hole without a measurement."""
    cloud = read_ply(run.scene_dir / "background.ply")
    return float(np.median(off_surface_m(cloud.take(cloud.completed))))


@pytest.mark.slow
@pytest.mark.usefixtures("few_voxels")
def test_a_rebuild_says_what_the_model_did_and_the_hole_is_closed_on_the_surface(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = room_with_a_hole(tmp_path / "run", monkeypatch)
    before = rebuild(run, SMALL, QUIET)
    assert "depth_model" not in before
    off_before_m = completed_off_m(run)
    network = KnowsTheRoom(lambda z: 3.0 / z + 2.0, num_frames=9)

    class Loaded(DepthGuesser):
        @staticmethod
        def load(config: ModelConfig, sha256: str) -> DepthGuesser:
            return DepthGuesser(network, "f" * 64)

    monkeypatch.setattr("twin.scene.rebuild.run.DepthGuesser", Loaded)
    after = rebuild(run, replace(SMALL, force=True), QUIET)
    about = after["depth_model"]
    assert about["sha256"] == "f" * 64
    assert about["num_splats"] > 0
    assert about["images_used"] == about["images_asked"]
    assert describe_guesses(about) in describe_scene(after)
    assert after["background"]["num_completed"] >= about["num_splats"]
    assert completed_off_m(run) < 0.3 * off_before_m


def test_the_key_of_a_scene_depends_on_the_model_only_where_one_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from twin.scene.rebuild import run as stages

    hashed: list[dict[str, Any]] = []
    monkeypatch.setattr(
        stages.provenance, "hash_settings", lambda content: hashed.append(content) or "key"
    )

    nothing = Sources(episodes=(), remark="")
    monkeypatch.setattr(stages, "scanned_tasks", lambda sources: type("T", (), {"task": None}))
    for config in (ModelConfig(), ModelConfig(depth_model="depth-anything:folder")):
        stages._key(nothing, RebuildConfig(models=config), None, {})
    assert "depth_model" not in hashed[0]["settings"]["models"]
    assert hashed[1]["settings"]["models"]["depth_model"] == "depth-anything:folder"


def test_without_a_named_model_nothing_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(monocular_depth, "DepthAnything", None)
    assert DepthGuesser.load(ModelConfig(), "") is None


@pytest.mark.slow
@pytest.mark.usefixtures("few_voxels", "without_network")
@pytest.mark.parametrize("name", ["depth_anything", "metric_depth_anything"])
def test_a_network_that_knows_nothing_runs_through_a_rebuild_and_does_no_harm(
    saved: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    pytest.importorskip("transformers", reason="the extra [foundation] is not installed")
    run = room_with_a_hole(tmp_path / "run", monkeypatch)
    before = rebuild(run, SMALL, QUIET)
    models = ModelConfig(depth_model=f"depth-anything:{saved(name)}", device="cpu")
    after = rebuild(run, replace(SMALL, models=models), QUIET)
    assert after["key"] != before["key"]
    about = after["depth_model"]
    assert about["images_asked"] > 0
    assert len(about["sha256"]) == 64
    assert about["images_used"] == 0
    assert after["scene_hash"] == before["scene_hash"]
    again = rebuild(run, replace(SMALL, models=models), QUIET)
    assert again["cost"] == after["cost"]  # not done twice
