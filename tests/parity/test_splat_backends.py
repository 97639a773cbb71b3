"""Both backends of the rasteriser, call by call."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from bridge.episode.run_folder import RunFolder
from bridge.errors import MissingDependencyError, UsageError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.scene.gaussians import GaussianCloud, as_float32
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


@pytest.mark.parametrize("num_harmonics", [0, 3])
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


@pytest.mark.parametrize("num_channels", [0, 1, 5, 70])
def test_features_are_drawn_alike(cuda: CudaRasteriser, num_channels: int) -> None:
    cloud, rng = cloud_of(5), np.random.default_rng(6)
    cpu = Rasteriser()
    cpu.draw_planes(cloud, CAMERA, pose())
    cuda.draw_planes(cloud, CAMERA, pose())
    features = rng.normal(size=(60, num_channels)).astype(np.float32)
    drawn = cuda.draw_features(features)
    assert drawn.shape == (num_channels, 37, 45)
    if num_channels:
        assert np.quantile(np.abs(drawn - cpu.draw_features(features)), 0.99) < 1e-3


def test_wrong_use_is_refused(cuda: CudaRasteriser) -> None:
    fresh = CudaRasteriser(device="cpu") if cuda._device.type == "cpu" else CudaRasteriser()
    with pytest.raises(UsageError, match="nothing was drawn yet"):
        fresh.draw_features(np.ones((60, 1), dtype=np.float32))
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
