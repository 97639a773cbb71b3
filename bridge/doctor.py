"""What is installed, what is missing, and how to get it."""

import re
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

from bridge.errors import MissingDependencyError

EXTRAS = {
    "base": "read, write, check and list episodes",
    "record": "record from zenoh; ROS 2 messages; colour images",
    "replay": "rebuild, render, replay, gate, calibrate",
    "report": "evaluate: tables, figures, report",
    "dashboard": "review pages, Rerun view",
    "policies": "policies in the loop",
    "cluster": "replays on Ray",
    "standin": "the stand-in cell of the demo",
    "video": "LeRobot videos",
    "realsense": "RealSense cameras",
    "ur": "the UR arm's model",
    "mujoco": "replay --engine mujoco",
    "twin": "what needs torch in the twin",
    "foundation": "SAM 3, CLIP from folders of weights",
    "lpips": "LPIPS",
    "gpu": "drawing on CUDA",
}
"""What packages that come together are for; which they are, the installed package says itself."""
NEEDED = ("base", "record", "replay", "report", "dashboard", "standin")
"""Nothing is wrong without the others: the demo and all it shows run on one machine's CPU."""
PACKAGES = {
    "PIL": "pillow",
    "fcl": "python-fcl",
    "pinocchio": "pin",
    "rerun": "rerun-sdk",
    "rerun_bindings": "rerun-sdk",
    "ruamel": "ruamel.yaml",
    "zenoh": "eclipse-zenoh",
}
"""What brings a module of another name."""
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
    """Look at packages, the native extensions and system libraries; import nothing."""
    findings = [_package(name, extra) for extra in EXTRAS for name in packages_of(extra)]
    findings.extend(_native(*each) for each in NATIVE)
    findings.extend(_system_libraries())
    return findings


def how_to_get(missing: ModuleNotFoundError) -> str:
    """Name the package that brings a missing module, and its extra; raise where none does."""
    module = str(missing.name).partition(".")[0]
    package = PACKAGES.get(module, module)
    for extra in EXTRAS:
        if package in packages_of(extra):
            return str(MissingDependencyError(package=package, extra=extra, purpose="this"))
    raise missing


def packages_of(extra: str) -> list[str]:
    """Packages that an extra brings by itself; ``base``: what is always there."""
    found = []
    for text in metadata.requires("robot-gst") or ():
        name, of = re.split(r"[^\w.-]", text)[0], re.search(r'extra == "([^"]+)"', text)
        if (of[1] if of else "base") == extra and name != "robot-gst":
            found.append(name)
    return found


def _package(name: str, extra: str) -> InstallCheck:
    found, advice, is_optional = "", "", extra not in NEEDED
    try:
        found = metadata.version(name)
    except metadata.PackageNotFoundError:
        wanted = "robot-gst" if extra == "base" else f"'robot-gst[{extra}]'"
        advice = f"pip install {wanted}"
    return InstallCheck(
        what=f"{name} [{extra}]",
        found=found or ("missing (optional)" if is_optional else "missing"),
        ok=bool(found) or is_optional,
        advice=advice,
        purpose=EXTRAS[extra],
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
