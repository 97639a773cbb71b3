"""What is installed, what is missing, and how to get it."""

import shutil
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

EXTRAS: dict[str, tuple[str, ...]] = {
    "base": ("numpy", "mcap", "cyclopts", "rich", "zstandard", "jaxtyping", "jsonschema"),
    "record": ("eclipse-zenoh", "simplejpeg", "rosbags", "pillow"),
    "twin": ("torch", "open3d", "pybullet", "python-fcl", "pin", "scipy", "example-robot-data"),
    "report": ("pandas", "pyarrow", "plotly", "matplotlib"),
    "dashboard": ("starlette", "uvicorn", "jinja2", "rerun-sdk"),
    "standin": ("mujoco", "open3d", "pin", "example-robot-data"),
    "video": ("av",),
    "realsense": ("pyrealsense2",),
    "ur": ("example-robot-data",),
    "foundation": ("transformers", "safetensors"),
    "lpips": ("torch", "safetensors", "torchmetrics"),
    "gpu": ("gsplat",),
    "cluster": ("ray",),
}
OPTIONAL = ("foundation", "lpips", "gpu", "cluster")
"""Nothing is wrong without these: all works on one machine's CPU and without weights of others."""
NATIVE = (
    ("splat rasteriser", "twin.scene._splat", "no scene can be rebuilt"),
    ("depth codec", "bridge.media._depth", "slow fallback, for playing back only"),
    ("checksum", "bridge.episode._crc32", "slower fallback (zlib)"),
)
"""What our own extensions are for, and how it goes without each."""


@dataclass(frozen=True, kw_only=True)
class InstallCheck:
    """One line of the report."""

    what: str
    found: str
    ok: bool
    advice: str = ""


def examine() -> list[InstallCheck]:
    """Look at packages, the native extensions, system libraries and programs; import nothing."""
    findings = [_package(name, extra) for extra, names in EXTRAS.items() for name in names]
    findings.extend(_native(*each) for each in NATIVE)
    findings.append(_program("chromium", "needed only to test the dashboard: apt install chromium"))
    findings.extend(_system_libraries())
    return findings


def _package(name: str, extra: str) -> InstallCheck:
    try:
        found = metadata.version(name)
    except metadata.PackageNotFoundError:
        advice = f"pip install 'robot-gst[{extra}]'" if extra != "base" else "pip install robot-gst"
        is_optional = extra in OPTIONAL
        found = "missing (optional)" if is_optional else "missing"
        return InstallCheck(what=f"{name} [{extra}]", found=found, ok=is_optional, advice=advice)
    return InstallCheck(what=f"{name} [{extra}]", found=found, ok=True)


def _native(what: str, module: str, without: str) -> InstallCheck:
    if find_spec(module) is not None:
        return InstallCheck(what=what, found="built", ok=True)
    advice = "run make, or pip install . with a C++17 compiler present"
    return InstallCheck(what=what, found=f"not built: {without}", ok=False, advice=advice)


def _program(name: str, advice: str) -> InstallCheck:
    found = shutil.which(name)
    return InstallCheck(
        what=name, found="present" if found else "missing", ok=True, advice="" if found else advice
    )


def _system_libraries() -> list[InstallCheck]:
    """Open3D opens these when imported."""
    wanted = {"libEGL.so.1": "libegl1", "libGL.so.1": "libgl1", "libX11.so.6": "libx11-6"}
    wanted |= {"libusb-1.0.so.0": "libusb-1.0-0", "libudev.so.1": "libudev1"}
    wanted |= {"libidn2.so.0": "libidn2-0"}
    folders = [Path("/lib"), Path("/usr/lib"), *Path("/usr/lib").glob("*-linux-gnu")]
    findings = []
    for library, package in wanted.items():
        present = any((folder / library).exists() for folder in folders)
        findings.append(
            InstallCheck(
                what=library,
                found="present" if present else "missing",
                ok=present,
                advice="" if present else f"apt-get install --no-install-recommends {package}",
            )
        )
    return findings
