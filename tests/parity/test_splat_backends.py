"""Both backends of the rasteriser, call by call.

``gsplat`` itself runs where there is a CUDA device (marker ``gpu``). Everywhere else a plain torch
function with its documented behaviour stands in for it, so that what we add around it is tested.
"""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from bridge.episode.run_folder import RunFolder
from bridge.errors import MissingDependencyError, UsageError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.scene.gaussians import GaussianCloud, arrays, as_float32
from twin.scene.raster import backend as cuda_module
from twin.scene.raster import backend as raster_cuda
from twin.scene.raster.backend import CudaMissingError, CudaRasteriser, open_rasteriser
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.render import render
from twin.scene.settings import RenderConfig

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.parity

CAMERA = Camera(width=45, height=37, fx=50.0, fy=48.0, cx=21.3, cy=19.1)


def load_stand_in() -> object:
    place = Path(__file__).with_name("gsplat_stand_in.py")
    spec = importlib.util.spec_from_file_location("gsplat_stand_in", place)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(params=["stand-in", pytest.param("gsplat", marks=pytest.mark.gpu)])
def cuda(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> CudaRasteriser:
    if request.param == "gsplat":
        pytest.importorskip("gsplat", reason="the extra [gpu] is not installed")
        if not torch.cuda.is_available():
            pytest.skip("no CUDA device")
        return CudaRasteriser()
    monkeypatch.setitem(sys.modules, "gsplat", load_stand_in())
    return CudaRasteriser(device="cpu")


def cloud_of(seed: int, count: int = 60, num_harmonics: int = 3) -> GaussianCloud:
    """Inside the image: beyond the border the two hold their Jacobians at different places."""
    rng = np.random.default_rng(seed)
    return GaussianCloud(
        means_m=as_float32(rng.uniform([-0.4, -0.35, 1.2], [0.4, 0.35, 2.5], size=(count, 3))),
        quats_wxyz=as_float32(rng.normal(size=(count, 4))),
        scales_log=as_float32(np.log(rng.uniform(0.015, 0.1, size=(count, 3)))),
        opacities_logit=as_float32(rng.normal(size=count)),
        colors=as_float32(rng.uniform(size=(count, 3))),
        harmonics=as_float32(0.2 * rng.normal(size=(count, num_harmonics, 3))),
    )


def pose() -> np.ndarray:
    return se3.look_at(
        np.array([0.1, -0.1, -0.2]), np.array([0.0, 0.0, 1.8]), np.array([0.1, -1.0, 0.0])
    )


@pytest.mark.parametrize("num_harmonics", [0, 3, 8, 15])
def test_both_draw_the_same_planes(cuda: CudaRasteriser, num_harmonics: int) -> None:
    cloud = cloud_of(1, num_harmonics=num_harmonics)
    theirs = cuda.draw_planes(cloud, CAMERA, pose())
    ours = Rasteriser().draw_planes(cloud, CAMERA, pose())
    assert theirs.shape == ours.shape == (5, 37, 45)
    error = np.abs(theirs - ours)
    # A contribution of 1/255 may fall to either side of the cut in float32: a few pixels.
    assert np.quantile(error, 0.995) < 3e-4
    assert error.max() < 2 * 2.5 / 255
    assert ours[4].max() > 0.9
    view = cuda.view(cloud, CAMERA, pose())
    solid = ours[4] > 0.51
    assert solid.sum() > 100
    assert np.median(np.abs(view.depth_m[solid] - ours[3][solid] / ours[4][solid])) < 1e-4


def test_a_gaussian_at_a_known_pixel_is_drawn_there(cuda: CudaRasteriser) -> None:
    x_px, y_px, depth_m = 30.5, 12.5, 2.0
    mean = [(x_px - CAMERA.cx) / CAMERA.fx * depth_m, (y_px - CAMERA.cy) / CAMERA.fy * depth_m]
    cloud = GaussianCloud(
        means_m=as_float32(np.array([[*mean, depth_m]])),
        quats_wxyz=as_float32(np.array([[1.0, 0, 0, 0]])),
        scales_log=as_float32(np.full((1, 3), np.log(0.05))),
        opacities_logit=as_float32(np.array([2.0])),
        colors=as_float32(np.ones((1, 3))),
    )
    planes = cuda.draw_planes(cloud, CAMERA, np.eye(4))
    assert np.unravel_index(planes[4].argmax(), planes[4].shape) == (12, 30)
    assert planes[3, 12, 30] / planes[4, 12, 30] == pytest.approx(depth_m, rel=1e-4)
    np.testing.assert_allclose(planes[4, 11, 30], planes[4, 13, 30], rtol=1e-3)  # centred


@pytest.mark.parametrize("num_harmonics", [3, 15])
def test_gradients_agree_in_every_array_and_in_the_pose(
    cuda: CudaRasteriser, num_harmonics: int
) -> None:
    cloud = cloud_of(2, num_harmonics=num_harmonics)
    cpu = Rasteriser()
    planes = cpu.draw_planes(cloud, CAMERA, pose())
    upstream = np.random.default_rng(3).normal(size=planes.shape).astype(np.float32)
    ours = cpu.pull_back(planes, upstream)
    theirs = cuda.pull_back(cuda.draw_planes(cloud, CAMERA, pose()), upstream)
    for name in [*dict(arrays(cloud)), "T_camera_base"]:
        found, wanted = getattr(theirs, name), getattr(ours, name)
        assert found.shape == wanted.shape, name
        # Contributions near the cut count in one and not in the other.
        assert np.linalg.norm(found - wanted) < 2e-2 * np.linalg.norm(wanted), name


def test_gradients_of_a_cloud_without_harmonics_have_none(cuda: CudaRasteriser) -> None:
    cloud = cloud_of(4, num_harmonics=0)
    planes = cuda.draw_planes(cloud, CAMERA, pose())
    gradient = cuda.pull_back(planes, np.ones_like(planes))
    assert gradient.harmonics.shape == (60, 0, 3)
    again = cuda.pull_back(planes, np.ones_like(planes))
    np.testing.assert_allclose(again.means_m, gradient.means_m, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("num_channels", [0, 1, 5, 70])
def test_features_are_drawn_and_lifted_alike(cuda: CudaRasteriser, num_channels: int) -> None:
    cloud, rng = cloud_of(5), np.random.default_rng(6)
    cpu = Rasteriser()
    cpu.draw_planes(cloud, CAMERA, pose())
    cuda.draw_planes(cloud, CAMERA, pose())
    features = rng.normal(size=(60, num_channels)).astype(np.float32)
    maps = rng.normal(size=(num_channels, 37, 45)).astype(np.float32)
    drawn, lifted = cuda.draw_features(features), cuda.lift(maps)
    assert drawn.shape == (num_channels, 37, 45)
    assert lifted.shape == (60, num_channels)
    # One is the other's adjoint: <A F, M> = <F, A^T M>.
    assert float((drawn * maps).sum()) == pytest.approx(
        float((features * lifted).sum()), rel=1e-3, abs=1e-2
    )
    if num_channels:
        assert np.quantile(np.abs(drawn - cpu.draw_features(features)), 0.99) < 1e-3
        wanted = cpu.lift(maps)
        assert np.linalg.norm(lifted - wanted) < 1e-2 * np.linalg.norm(wanted)


def test_labels_win_alike(cuda: CudaRasteriser) -> None:
    cloud, rng = cloud_of(7), np.random.default_rng(8)
    labels = rng.choice(np.array([0, 3, 40, 65535], dtype=np.uint16), size=60)
    cpu = Rasteriser()
    cpu.draw_planes(cloud, CAMERA, pose())
    cuda.draw_planes(cloud, CAMERA, pose())
    ids, weight = cuda.label_map(labels)
    ids_cpu, weight_cpu = cpu.label_map(labels)
    assert (ids == ids_cpu).mean() > 0.995
    assert np.quantile(np.abs(weight - weight_cpu), 0.99) < 1e-3
    many = np.arange(60, dtype=np.uint16)
    assert (cuda.label_map(many)[0] == cpu.label_map(many)[0]).mean() > 0.99


def test_what_is_seen_is_seen_by_both(cuda: CudaRasteriser) -> None:
    cloud = cloud_of(9)
    behind = as_float32(cloud.means_m - [0, 0, 5.0] * (np.arange(60) % 2)[:, None])
    moved = GaussianCloud(**(dict(arrays(cloud)) | {"means_m": behind}))
    cpu = Rasteriser()
    cpu.draw_planes(moved, CAMERA, pose())
    cuda.draw_planes(moved, CAMERA, pose())
    np.testing.assert_array_equal(cuda.visible_mask(), cpu.visible_mask())
    assert not cuda.visible_mask()[1::2].any()


def test_wrong_use_is_refused(cuda: CudaRasteriser) -> None:
    fresh = CudaRasteriser(device="cpu") if cuda._device.type == "cpu" else CudaRasteriser()
    with pytest.raises(UsageError, match="nothing was drawn yet"):
        fresh.visible_mask()
    cuda.draw_planes(cloud_of(1), CAMERA, pose())
    other = np.zeros((5, 3, 4), dtype=np.float32)
    with pytest.raises(UsageError, match="not those drawn last"):
        cuda.pull_back(other, other)
    with pytest.raises(UsageError, match="backend cpu for other values"):
        CudaRasteriser(RasterConfig(alpha_cut=0.1), device="cpu")


def test_the_configuration_chooses_the_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    assert isinstance(open_rasteriser(), Rasteriser)
    monkeypatch.setattr(cuda_module, "has_cuda", lambda: False)
    assert isinstance(open_rasteriser(RasterConfig(backend="auto")), Rasteriser)
    monkeypatch.setitem(sys.modules, "gsplat", load_stand_in())
    monkeypatch.setattr(cuda_module, "has_cuda", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch, "device", lambda name: name)
    assert isinstance(open_rasteriser(RasterConfig(backend="auto")), CudaRasteriser)


def test_without_a_device_or_without_gsplat_one_sentence_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(CudaMissingError, match=r"needs an NVIDIA GPU.*robot-gst\[gpu\]") as caught:
        open_rasteriser(RasterConfig(backend="cuda"))
    assert isinstance(caught.value, MissingDependencyError)
    with pytest.raises(CudaMissingError, match="Use the backend cpu"):
        render(RunFolder.create(tmp_path / "run"), RenderConfig(backend="cuda"))
    monkeypatch.setitem(sys.modules, "gsplat", None)  # importing it now fails
    with pytest.raises(MissingDependencyError, match=r"gsplat is not installed.*\[gpu\]"):
        CudaRasteriser(device="cpu")
    monkeypatch.delitem(sys.modules, "gsplat")
    monkeypatch.setattr(raster_cuda, "find_spec", lambda name: None)
    assert not raster_cuda.has_cuda()
