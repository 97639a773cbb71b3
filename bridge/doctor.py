"""What is installed, what is missing, and how to get it."""

import shutil
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path


@dataclass(frozen=True)
class Extra:
    """Packages that come together, and what for."""

    purpose: str
    packages: tuple[str, ...]
    is_optional: bool = False
    """Nothing is wrong without it: the demo and all it shows run on one machine's CPU."""


EXTRAS = {
    "base": Extra(
        "read, write, check and list episodes",
        (
            *("numpy", "mcap", "cyclopts", "rich", "zstandard", "jaxtyping"),
            *("jsonschema-rs", "msgspec", "lz4"),
        ),
    ),
    "record": Extra(
        "record from zenoh; ROS 2 messages; colour images",
        ("eclipse-zenoh", "simplejpeg", "rosbags", "pillow", "ruamel.yaml"),
    ),
    "replay": Extra(
        "rebuild, render, replay, gate, calibrate",
        ("open3d", "pybullet", "pin", "scipy", "example-robot-data", "python-fcl"),
    ),
    "report": Extra(
        "evaluate: tables, figures, report",
        ("jinja2", "pandas", "pyarrow", "scipy", "openpyxl", "pillow"),
    ),
    "dashboard": Extra(
        "review pages, Rerun view", ("starlette", "uvicorn", "rerun-sdk", "simplejpeg")
    ),
    "policies": Extra(
        "policies in the loop", ("gymnasium", "websockets", "pillow"), is_optional=True
    ),
    "cluster": Extra("replays on Ray", ("ray",), is_optional=True),
    "standin": Extra(
        "the stand-in cell of the demo", ("mujoco", "open3d", "pin", "example-robot-data", "scipy")
    ),
    "video": Extra("LeRobot videos", ("av",), is_optional=True),
    "realsense": Extra("RealSense cameras", ("pyrealsense2",), is_optional=True),
    "ur": Extra("the UR arm's model", ("example-robot-data",), is_optional=True),
    "mujoco": Extra("replay --engine mujoco or both", ("mujoco",), is_optional=True),
    "twin": Extra("what needs torch in the twin", ("torch",), is_optional=True),
    "foundation": Extra(
        "SAM 3, CLIP from folders of weights", ("transformers", "safetensors"), is_optional=True
    ),
    "lpips": Extra("LPIPS", ("torch", "safetensors", "torchmetrics"), is_optional=True),
    "gpu": Extra("drawing on CUDA", ("gsplat",), is_optional=True),
}
"""As ``pyproject.toml`` has them."""
NATIVE = (
    ("splat rasteriser", "twin.scene._splat", "no scene can be rebuilt"),
    ("depth codec", "bridge.media._depth", "no compact depth is written or read"),
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
    purpose: str = ""


def examine() -> list[InstallCheck]:
    """Look at packages, the native extensions, system libraries and programs; import nothing."""
    findings = [_package(name, extra) for extra in EXTRAS for name in EXTRAS[extra].packages]
    findings.extend(_native(*each) for each in NATIVE)
    has = shutil.which("chromium") is not None
    advice = "" if has else "needed only to test the dashboard: apt install chromium"
    found = "present" if has else "missing"
    findings.append(InstallCheck(what="chromium", found=found, ok=True, advice=advice))
    findings.extend(_system_libraries())
    return findings


def _package(name: str, extra: str) -> InstallCheck:
    about, found, advice = EXTRAS[extra], "", ""
    try:
        found = metadata.version(name)
    except metadata.PackageNotFoundError:
        wanted = "robot-gst" if extra == "base" else f"'robot-gst[{extra}]'"
        advice = f"pip install {wanted}"
    return InstallCheck(
        what=f"{name} [{extra}]",
        found=found or ("missing (optional)" if about.is_optional else "missing"),
        ok=bool(found) or about.is_optional,
        advice=advice,
        purpose=about.purpose,
    )


def _native(what: str, module: str, without: str) -> InstallCheck:
    if find_spec(module) is not None:
        return InstallCheck(what=what, found="built", ok=True)
    advice = "run make, or pip install . with a C++17 compiler present"
    return InstallCheck(what=what, found=f"not built: {without}", ok=False, advice=advice)


def _system_libraries() -> list[InstallCheck]:
    """Open3D opens these when imported."""
    wanted = {"libEGL.so.1": "libegl1", "libGL.so.1": "libgl1", "libX11.so.6": "libx11-6"}
    wanted |= {"libusb-1.0.so.0": "libusb-1.0-0", "libudev.so.1": "libudev1"}
    wanted |= {"libidn2.so.0": "libidn2-0"}
    folders = [Path("/lib"), Path("/usr/lib"), *Path("/usr/lib").glob("*-linux-gnu")]
    findings = []
    for library, package in wanted.items():
        ok = any((folder / library).exists() for folder in folders)
        found = "present" if ok else "missing"
        advice = "" if ok else f"apt-get install --no-install-recommends {package}"
        findings.append(InstallCheck(what=library, found=found, ok=ok, advice=advice))
    return findings
