"""The native rasteriser against plain torch with autograd, and both backends call by call."""

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from splat_pull import pull_back

from bridge.episode.run_folder import RunFolder
from bridge.errors import MissingDependencyError, UsageError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.scene.gaussians import GaussianCloud, arrays, as_float32
from twin.scene.raster import backend as cuda_module
from twin.scene.raster.backend import CudaMissingError, CudaRasteriser, open_rasteriser
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser, load_native
from twin.scene.render import render
from twin.scene.settings import RenderConfig

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.parity


def beside(name: str) -> Any:
    """The module of that name in this folder."""
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


splat_reference = beside("splat_reference")
CAMERA = Camera(width=45, height=37, fx=50.0, fy=48.0, cx=21.3, cy=19.1)
ISAS = load_native().available_isas()


BOX = ([-0.6, -0.5, 0.8], [0.6, 0.5, 2.5])
INSIDE = ([-0.4, -0.35, 1.2], [0.4, 0.35, 2.5])
"""Beyond the border of the image the two backends hold their Jacobians at different places."""


def random_cloud(
    rng: np.random.Generator, count: int, *, num_harmonics: int = 3, box_m: Any = BOX
) -> GaussianCloud:
    return GaussianCloud(
        means_m=as_float32(rng.uniform(*box_m, size=(count, 3))),
        quats_wxyz=as_float32(rng.normal(size=(count, 4))),
        scales_log=as_float32(np.log(rng.uniform(0.01, 0.12, size=(count, 3)))),
        opacities_logit=as_float32(rng.normal(size=count)),
        colors=as_float32(rng.uniform(size=(count, 3))),
        harmonics=as_float32(rng.normal(scale=0.2, size=(count, num_harmonics, 3))),
    )


def tilted_pose() -> np.ndarray:
    return se3.look_at(
        np.array([0.2, -0.1, -0.3]), np.array([0.0, 0.0, 1.6]), np.array([0.1, -1.0, 0.0])
    )


def reference_planes(
    cloud: GaussianCloud, T_base_camera: np.ndarray, alpha_cut: float
) -> tuple[list[Any], Any, Any]:
    tensors = [
        torch.tensor(rows, dtype=torch.float64, requires_grad=True) for _, rows in arrays(cloud)
    ]
    T = as_float32(se3.invert(T_base_camera))[:3]
    T_camera_base = torch.tensor(T, dtype=torch.float64, requires_grad=True)
    planes = splat_reference.draw(
        *tensors, camera=CAMERA, T_camera_base=T_camera_base, alpha_cut=alpha_cut
    )
    return tensors, T_camera_base, planes


def relative_error(found: np.ndarray, wanted: np.ndarray) -> float:
    return float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize("num_harmonics", [0, 3])
def test_images_agree_with_the_reference(isa: str, num_harmonics: int) -> None:
    cloud = random_cloud(np.random.default_rng(1), 60, num_harmonics=num_harmonics)
    config = RasterConfig(alpha_cut=1 / 255, transmittance_stop=0.0, threads=1, isa=isa)
    planes = Rasteriser(config).draw_planes(cloud, CAMERA, tilted_pose())
    expected = reference_planes(cloud, tilted_pose(), 1 / 255)[-1].detach().numpy()
    error = np.abs(planes - expected)
    # At the cut a contribution of 1/255 may fall to either side in float32: a few pixels.
    assert np.quantile(error, 0.995) < 2e-4
    assert error.max() < 2 * 2.5 / 255
    assert expected[4].max() > 0.9  # the scene is not empty


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize("num_harmonics", [0, 3])
def test_gradients_agree_with_autograd(isa: str, num_harmonics: int) -> None:
    rng = np.random.default_rng(2)
    cloud = random_cloud(rng, 60, num_harmonics=num_harmonics)
    rasteriser = Rasteriser(
        RasterConfig(alpha_cut=2.0**-24, transmittance_stop=0.0, threads=1, isa=isa)
    )
    planes = rasteriser.draw_planes(cloud, CAMERA, tilted_pose())
    upstream = rng.normal(size=planes.shape).astype(np.float32)
    gradient = pull_back(rasteriser, planes, upstream)

    tensors, T_camera_base, expected = reference_planes(cloud, tilted_pose(), 2.0**-24)
    (expected * torch.tensor(upstream, dtype=torch.float64)).sum().backward()
    for (name, _), tensor in zip(arrays(cloud), tensors, strict=True):
        # float32 sums over a few thousand pixels, some behind almost opaque Gaussians
        assert relative_error(getattr(gradient, name), tensor.grad.numpy()) < 5e-4, name
    assert relative_error(gradient.T_camera_base, T_camera_base.grad.numpy()) < 5e-4
    assert gradient.harmonics.shape == cloud.harmonics.shape


@pytest.mark.parametrize("isa", ISAS)
def test_features_lift_and_labels_agree_with_the_reference(isa: str) -> None:
    rng = np.random.default_rng(8)
    cloud = random_cloud(rng, 60)
    rasteriser = Rasteriser(
        RasterConfig(alpha_cut=2.0**-24, transmittance_stop=0.0, threads=1, isa=isa)
    )
    rasteriser.draw_planes(cloud, CAMERA, tilted_pose())
    tensors = [torch.tensor(rows, dtype=torch.float64) for _, rows in arrays(cloud)][:4]
    T = torch.tensor(as_float32(se3.invert(tilted_pose())), dtype=torch.float64)
    weight, _ = splat_reference.weights(*tensors, CAMERA, T, 2.0**-24)
    A = weight.numpy()

    features = as_float32(rng.normal(size=(60, 37)))
    drawn = np.einsum("nhw,nd->dhw", A, features)
    np.testing.assert_allclose(rasteriser.draw_features(features), drawn, atol=2e-5)
    maps = as_float32(rng.normal(size=(37, CAMERA.height, CAMERA.width)))
    lifted = np.einsum("nhw,dhw->nd", A, maps)
    np.testing.assert_allclose(rasteriser.lift(maps), lifted, atol=2e-4)

    labels = rng.integers(0, 5, size=60).astype(np.uint16) * 1000
    by_label = np.stack([A[labels == label].sum(axis=0) for label in range(0, 5000, 1000)])
    ids, best = rasteriser.label_map(labels)
    np.testing.assert_allclose(best, by_label.max(axis=0), atol=2e-5)
    first, second = np.sort(by_label, axis=0)[-1], np.sort(by_label, axis=0)[-2]
    clear = first - second > 1e-4  # float32 may choose either of two equals
    np.testing.assert_array_equal(ids[clear], 1000 * by_label.argmax(axis=0)[clear])
    assert len(np.unique(ids)) > 3


@pytest.mark.parametrize("isa", ISAS)
def test_the_depth_of_the_surface_agrees_with_the_reference(isa: str) -> None:
    cloud = random_cloud(np.random.default_rng(9), 120, num_harmonics=0)
    config = RasterConfig(alpha_cut=2.0**-24, transmittance_stop=0.0, threads=1, isa=isa)
    rasteriser = Rasteriser(config)
    alpha = rasteriser.draw_planes(cloud, CAMERA, tilted_pose())[4]
    tensors = [torch.tensor(rows, dtype=torch.float64) for _, rows in arrays(cloud)][:4]
    T = torch.tensor(as_float32(se3.invert(tilted_pose())), dtype=torch.float64)
    weight, depth = splat_reference.weights(*tensors, CAMERA, T, 2.0**-24)
    expected = splat_reference.surface_depth(weight, depth, tensors[0], T).numpy()
    found = rasteriser.surface_depth()
    clear = np.abs(alpha - 0.5) > 1e-4  # float32 may see half of the light gone one Gaussian later
    np.testing.assert_array_equal((found > 0)[clear], (expected > 0)[clear])
    off = np.abs(found - expected)[clear]
    assert np.quantile(off, 0.99) < 2e-5
    assert (expected > 0).mean() > 0.3


@pytest.mark.parametrize("isa", ISAS)
def test_all_instruction_sets_agree(isa: str) -> None:
    cloud = random_cloud(np.random.default_rng(4), 200, num_harmonics=3)
    pose = tilted_pose()
    results = []
    for name in ("base", isa):
        rasteriser = Rasteriser(RasterConfig(isa=name, threads=1))
        assert rasteriser.isa == name
        planes = rasteriser.draw_planes(cloud, CAMERA, pose)
        gradient = pull_back(rasteriser, planes, np.ones_like(planes))
        results.append((planes, gradient))
    assert np.quantile(np.abs(results[0][0] - results[1][0]), 0.99) < 1e-4
    for name, _ in arrays(cloud):
        first, second = (getattr(gradient, name) for _, gradient in results)
        # Contributions near the cut may fall to either side.
        assert relative_error(second, first) < 2e-2, name


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize(("height", "width"), [(23, 31), (3, 2), (171, 133), (80, 270)])
def test_ssim_agrees_with_a_torch_convolution(isa: str, height: int, width: int) -> None:
    from twin.scene.raster.rasteriser import load_native

    rng = np.random.default_rng(5)
    x = rng.uniform(size=(3, height, width)).astype(np.float32)
    y = np.clip(x + 0.1 * rng.normal(size=x.shape), 0, 1).astype(np.float32)
    value, gradient = load_native().Similarity(1, isa).mean(x, y)

    offsets = torch.arange(11, dtype=torch.float64) - 5
    tap = torch.exp(-(offsets**2) / (2 * 1.5**2))
    window = torch.outer(tap, tap)[None, None] / tap.sum() ** 2

    def blur(planes: Any) -> Any:
        return torch.nn.functional.conv2d(planes[:, None], window, padding=5)[:, 0]

    a = torch.tensor(x, dtype=torch.float64, requires_grad=True)
    b = torch.tensor(y, dtype=torch.float64)
    ma, mb = blur(a), blur(b)
    va, vb, cov = blur(a * a) - ma**2, blur(b * b) - mb**2, blur(a * b) - ma * mb
    ssim = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4)
    ssim = (ssim / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))).mean()
    ssim.backward()
    assert value == pytest.approx(float(ssim.detach()), abs=1e-5)
    assert np.linalg.norm(gradient - a.grad.numpy()) < 1e-3 * np.linalg.norm(a.grad.numpy())


def test_adam_agrees_with_torch() -> None:
    from twin.scene.raster.rasteriser import load_native

    rng = np.random.default_rng(6)
    values = rng.normal(size=1000).astype(np.float32)
    parameter = torch.tensor(values.copy(), requires_grad=True)
    optimiser = torch.optim.Adam([parameter], lr=0.01, eps=1e-15)
    first, second = np.zeros_like(values), np.zeros_like(values)
    for step in range(1, 6):
        gradient = rng.normal(size=1000).astype(np.float32)
        load_native().adam_step(values, gradient, first, second, step, 0.01)
        parameter.grad = torch.tensor(gradient)
        optimiser.step()
    np.testing.assert_allclose(values, parameter.detach().numpy(), rtol=1e-4, atol=1e-6)


@pytest.fixture(params=["stand-in", pytest.param("gsplat", marks=pytest.mark.gpu)])
def cuda(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> CudaRasteriser:
    if request.param == "gsplat":
        pytest.importorskip("gsplat", reason="the extra [gpu] is not installed")
        if not torch.cuda.is_available():
            pytest.skip("no CUDA device")
        return CudaRasteriser()
    monkeypatch.setitem(sys.modules, "gsplat", beside("gsplat_stand_in"))
    return CudaRasteriser(device="cpu")


def cloud_of(seed: int, count: int = 60, num_harmonics: int = 3) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    return random_cloud(rng, count, num_harmonics=num_harmonics, box_m=INSIDE)


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
    monkeypatch.setitem(sys.modules, "gsplat", beside("gsplat_stand_in"))
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
    monkeypatch.setattr(cuda_module, "find_spec", lambda name: None)
    assert not cuda_module.has_cuda()
