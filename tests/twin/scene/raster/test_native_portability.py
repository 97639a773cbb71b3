"""The kernels are plain C++ for any processor: they compile for aarch64, and draw alike there."""

import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from bridge.geometry.camera import Camera
from twin.scene.gaussians import GaussianCloud, arrays, as_float32
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser

NATIVE = Path(__file__).parents[4] / "twin" / "scene" / "native"
DRIVER = Path(__file__).with_name("native_driver.cpp")
KERNELS = ("project", "unproject", "draw", "operate", "structure", "compare", "adam")
SHARED = ("rasteriser", "depth_order", "operators", "dispatch", "similarity", "session")
CAMERA = Camera(width=70, height=45, fx=80.0, fy=80.0, cx=35.0, cy=22.5)
COUNT = 300


def compiler() -> str:
    found = shutil.which("aarch64-linux-gnu-g++")
    if found is None:
        pytest.skip("aarch64-linux-gnu-g++ is not installed")
    return found


def test_no_source_names_an_instruction_of_one_processor() -> None:
    sources = [path for path in NATIVE.iterdir() if path.suffix in (".cpp", ".hpp")]
    assert len(sources) > 10
    for path in sources:
        text = path.read_text()
        for foreign in ("immintrin", "_mm256", "_mm512", "_mm_", "arm_neon", "asm("):
            assert foreign not in text, f"{path.name}: {foreign}"


def test_every_kernel_is_compiled() -> None:
    compiled = {path.stem for path in NATIVE.glob("*.cpp")}
    assert compiled == {*KERNELS, *SHARED, "module", "module_session"}


@pytest.mark.slow
def test_the_kernels_compile_for_aarch64_and_draw_alike(tmp_path: Path) -> None:
    gxx = compiler()
    flags = ["-std=c++17", "-O2", "-fno-math-errno", "-fno-trapping-math", "-Wall", "-Wextra"]
    flags += ["-Werror", "-Wno-unknown-pragmas", f"-I{NATIVE}"]

    def build(source: Path) -> str:
        target = str(tmp_path / f"{source.stem}.o")
        isa = ["-DSPLAT_ISA=base"] if source.stem in KERNELS else []
        command = [gxx, *flags, *isa, "-c", str(source), "-o", target]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return target

    sources = [NATIVE / f"{name}.cpp" for name in (*KERNELS, *SHARED)]
    with ThreadPoolExecutor(2) as pool:
        objects = list(pool.map(build, [*sources, DRIVER]))
    program = tmp_path / "driver"
    subprocess.run([gxx, "-static", *objects, "-o", str(program)], check=True)
    emulator = shutil.which("qemu-aarch64-static") or shutil.which("qemu-aarch64")
    if emulator is None:
        pytest.skip("compiled, but not run: qemu-aarch64 is not installed")
    compare_with_this_processor(emulator, program, tmp_path)


def some_cloud() -> GaussianCloud:
    rng = np.random.default_rng(3)
    return GaussianCloud(
        means_m=as_float32(rng.uniform([-0.5, -0.4, 0.5], [0.5, 0.4, 2.0], size=(COUNT, 3))),
        quats_wxyz=as_float32(rng.normal(size=(COUNT, 4))),
        scales_log=as_float32(np.log(rng.uniform(0.005, 0.06, size=(COUNT, 3)))),
        opacities_logit=as_float32(rng.normal(size=COUNT)),
        colors=as_float32(rng.uniform(size=(COUNT, 3))),
        harmonics=as_float32(rng.normal(scale=0.2, size=(COUNT, 3, 3))),
    )


def compare_with_this_processor(emulator: str, program: Path, tmp_path: Path) -> None:
    cloud = some_cloud()
    lens = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy], dtype=np.float32)
    sizes = np.array([COUNT, CAMERA.width, CAMERA.height], dtype=np.int32)
    tables = [rows.tobytes() for _, rows in arrays(cloud)]
    pose = np.eye(4, dtype=np.float32)[:3].tobytes()
    (tmp_path / "in").write_bytes(b"".join([sizes.tobytes(), lens.tobytes(), pose, *tables]))
    command = [emulator, str(program), str(tmp_path / "in"), str(tmp_path / "out")]
    said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert said.stdout.strip() == "base"
    found = np.fromfile(tmp_path / "out", dtype=np.float32)

    rasteriser = Rasteriser(RasterConfig(threads=1, isa="base"))
    planes = rasteriser.draw_planes(cloud, CAMERA, np.eye(4))
    gradient = rasteriser.pull_back(planes, np.ones_like(planes))
    expected = [planes, *(getattr(gradient, name) for name, _ in arrays(cloud)), planes[4]]
    start = 0
    for wanted in expected:
        own = found[start : start + wanted.size].reshape(wanted.shape)
        start += wanted.size
        # Contributions near the cut may fall to either side where products are fused.
        assert np.linalg.norm(own - wanted) < 1e-2 * np.linalg.norm(wanted)
    assert start == found.size
