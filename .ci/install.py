"""Install one stage into .venv, after saying what will be downloaded and how large it is.

.. code-block:: shell

    .venv/bin/python .ci/install.py demo           # what the demo needs
    .venv/bin/python .ci/install.py test           # the rest: tests, checks, benchmarks
    .venv/bin/python .ci/install.py test no-torch  # the rest without torch and what needs it
"""

import ast
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VENV = Path(sys.prefix)
SITE = next(Path(path) for path in sys.path if path.endswith("site-packages"))
TEMPORARY = VENV / "tmp"
"""Wheels wait here until all are there; a /tmp in memory is too small for them."""

TOOLS = TEMPORARY / "tools"
"""What compiles the extension modules and is not in .venv, removed afterwards: always the same
place, so that a second build goes on where the first ended."""

CACHE = TEMPORARY / "cache"
"""Beside .venv, so that uv links a package instead of copying it."""
UV = ("pip", "install", "--no-config", "--python", sys.executable, "--cache-dir", str(CACHE))
BUILD_TOOLS = ("scikit-build-core>=1.0", "nanobind>=2.4", "cmake", "ninja")
AS_ENVIRONMENT = {
    "cert": "SSL_CERT_FILE",
    "proxy": "ALL_PROXY",
    "timeout": "UV_HTTP_TIMEOUT",
    "default-timeout": "UV_HTTP_TIMEOUT",
}
"""Settings of pip that uv takes from the environment; the others are its flags, by their names."""
WITHOUT_EFFECT = {"disable-pip-version-check", "no-cache-dir", "progress-bar", "root-user-action"}
"""Settings of pip that change nothing of what is installed."""
SELDOM_IMPORTED = (
    "/tests/|/transformers/models/|/torch/(_inductor|testing)/|/ray/(rllib|data|serve|tune|train|llm)/"
    "|/sympy/physics/|/(plotly|dash|OpenGL|IPython|networkx|fontTools|Cython|mypyc?|statsmodels|seaborn"
    "|pybullet_envs|pybullet_examples|setuptools|pip|wcwidth|prompt_toolkit|imageio|pygments)/"
)
"""Compiled where it is imported: half of all lines."""
BYTECODE = ("-W", "ignore", "-m", "compileall", "-qq", "-j", "0", "-x", SELDOM_IMPORTED)
UNUSED = (
    "cmeel.prefix/include",
    "open3d/open3d_tf_ops.so",
    "open3d/open3d_torch_ops.so",
    "pybullet_data/data",
    "pybullet_data/policies",
    "pybullet_data/random_urdfs",
    "pyarrow/include",
)
"""C++ headers, operators for other versions of torch, and examples: 350 MB that nothing reads."""
EXTRAS = {
    "demo": "demo",
    "test": "all,dev",
    "test no-torch": "demo,cluster,video,realsense,ur,dev",
}
DEMO = {
    "open3d": (401, 823),
    "rerun-sdk": (171, 490),
    "example-robot-data": (131, 442),
    "pin": (80, 219),
    "pybullet": (103, 216),
    "pyarrow": (55, 159),
    "scipy": (35, 118),
}
TEST = {
    "ray": (79, 240),
    "opencv-python-headless": (61, 153),
    "atheris": (35, 110),
    "av": (36, 104),
}
TORCH = {"transformers": (13, 100)}
OTHERS = {"demo": (177, 499), "test": (120, 700), "test no-torch": (105, 625)}
TORCH_CPU, TORCH_CUDA = (192, 695), (2741, 4543)
"""Megabytes to download and installed, measured on Linux x86-64 with Python 3.11."""


def main() -> int:
    """Install the stage that is named on the command line."""
    stage = " ".join(sys.argv[1:])
    if stage not in EXTRAS:
        sys.stderr.write(f"What to install? One of: {', '.join(EXTRAS)}.\n")
        return 2
    download, installed = announce(stage)
    free = shutil.disk_usage(VENV).free / 1e6
    if free < download + installed:
        sys.stderr.write(
            f"{VENV} needs {(download + installed) / 1000:.1f} GB while it is made, and "
            f"{free / 1000:.1f} GB are free there. Make room and run make again.\n"
        )
        return 1
    TEMPORARY.mkdir(exist_ok=True)
    try:
        return install(stage, much=download > 0)
    finally:
        shutil.rmtree(TEMPORARY, ignore_errors=True)


def announce(stage: str) -> tuple[int, int]:
    """Print what is missing and its size; return megabytes to download and installed."""
    known = dict(DEMO if stage == "demo" else TEST)
    if stage == "test":
        known |= TORCH
    rows = [(name, *sizes) for name, sizes in known.items() if not is_installed(name)]
    if rows:
        rows.append(("all others and bytecode", *OTHERS[stage]))
    remarks: tuple[str, ...] = ()
    if stage == "test" and not is_installed("torch"):
        wheel = local_torch()
        rows.insert(0, (f"torch {torch_version()}", *(TORCH_CPU if wheel else TORCH_CUDA)))
        remarks = torch_remarks(wheel)
    download, installed = sum(row[1] for row in rows), sum(row[2] for row in rows)
    if not rows:
        say(f"Looking whether all packages for {stage} are in .venv")
        return 0, 0
    say(f"Packages for make {stage.split()[0]}, about, in megabytes:")
    say(f"  {'':<24}{'download':>10}{'installed':>11}")
    for row in (*rows, ("together", download, installed)):
        say(f"  {row[0]:<24}{row[1]:>10}{row[2]:>11}")
    for line in remarks:
        say(line)
    return download, installed


def torch_remarks(wheel: Path | None) -> tuple[str, ...]:
    """Which build of torch it will be, and how to have the other."""
    if wheel is not None:
        return (f"torch is taken from {wheel.name}, a file in a folder that pip was given.",)
    if not sys.platform.startswith("linux"):
        return ()
    return (
        "torch is the CUDA build of PyPI, unless pip is given a package index with CPU builds.",
        f"A CPU build has {TORCH_CPU[0]} MB: put its wheel into a folder and run",
        "  PIP_FIND_LINKS=FOLDER make test",
        "Without torch: make test TORCH=no (its tests are skipped).",
    )


def local_torch() -> Path | None:
    """Find a wheel of the wanted torch in the folders that pip looks into."""
    for folder in settings_of_pip().get("find-links", ()):
        place = Path(folder.removeprefix("file://"))
        tag = f"cp{sys.version_info.major}{sys.version_info.minor}"
        found = sorted(place.glob(f"torch-{torch_version()}*-{tag}-*.whl"))
        if found:
            return found[-1]
    return None


def torch_version() -> str:
    """Read the pinned version."""
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    return re.findall(r"^torch==(\S+)", text, re.MULTILINE)[0]


def is_installed(name: str) -> bool:
    """Whether .venv has it, in any version."""
    try:
        metadata.version(name)
    except metadata.PackageNotFoundError:
        return False
    return True


def requirements(extras: str) -> list[str]:
    """Name all that the project asks for with these extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    waiting, found = [*project["dependencies"], f"{project['name']}[{extras}]"], dict[str, None]()
    while waiting:
        wanted = waiting.pop()
        own = re.fullmatch(rf"{project['name']}\[(.*)\]", wanted)
        if own is None:
            found[wanted] = None
            continue
        for extra in own[1].split(","):
            waiting.extend(project["optional-dependencies"][extra])
    return sorted(found)


def install(stage: str, *, much: bool) -> int:
    """Run uv, several times as fast where much is missing, and pip where uv fails."""
    pip = [sys.executable, "-m", "pip", "install", "--no-compile", "--disable-pip-version-check"]
    pip += ["-c", "constraints.txt"]
    beside = [*pip, "--quiet", "--target"]
    wanted, (flags, settings) = requirements(EXTRAS[stage]), settings_for_uv()
    uv = [str(TEMPORARY / "uv" / "bin" / "uv"), *UV, *flags, *wanted]
    started = time.monotonic()
    fetched = much and run([*beside, str(TEMPORARY / "uv"), "uv"]) and run(uv, settings)
    done = fetched or run([*pip, *(() if much else ("--quiet",)), *wanted])
    if stage == "demo" and done:
        say("Compiling the extension modules, a minute or two")
        tools = [tool for tool in BUILD_TOOLS if not is_installed(tool.split(">")[0])]
        places = [str(TOOLS / "bin"), str(VENV / "bin"), os.environ["PATH"]]
        paths = {"PYTHONPATH": str(TOOLS), "PATH": os.pathsep.join(places)}
        own = [*pip, "--quiet", "--no-build-isolation", "--no-deps", "-e", "."]
        done = (not tools or run([*beside, str(TOOLS), *tools])) and run(own, paths)
    elif done:
        say("Compiling packages to bytecode, a minute or two")
        # On all cores; a few files of the packages are templates and do not compile.
        run([sys.executable, *BYTECODE, str(SITE)])
    if not done:
        sys.stderr.write("Not all could be installed; the reason stands above.\n")
        return 1
    remove_unused()
    say(f"Installed in {time.monotonic() - started:.0f} s")
    return 0


def settings_for_uv() -> tuple[list[str], dict[str, str]]:
    """Hand on what pip was told; where uv does not know a flag it fails, and pip goes on."""
    flags = ["--constraint", "constraints.txt", "--index-strategy", "unsafe-best-match"]
    environment = {}
    for name, values in settings_of_pip().items():
        if name in AS_ENVIRONMENT:
            environment[AS_ENVIRONMENT[name]] = " ".join(values)
        elif name not in WITHOUT_EFFECT:
            flags += [word for value in values for word in (f"--{name}", value)]
    return flags, environment


@cache
def settings_of_pip() -> dict[str, list[str]]:
    """Read what pip was told for an install, by files and, which is stronger, the environment."""
    told = [sys.executable, "-m", "pip", "config", "list"]
    lines = subprocess.run(told, capture_output=True, text=True, check=False).stdout.splitlines()
    found: dict[str, list[str]] = {}
    for strength in ("global", "install", ":env:"):
        for key, _, value in (line.partition("=") for line in lines):
            scope, _, name = key.rpartition(".")
            if scope == strength:
                found[name] = ast.literal_eval(value).split()
    return found


def remove_unused() -> None:
    """Delete the large parts of packages that nothing reads."""
    for name in UNUSED:
        place = SITE / name
        if place.is_dir():
            shutil.rmtree(place)
        else:
            place.unlink(missing_ok=True)


def run(command: list[str], more: Mapping[str, str] = {}) -> bool:
    """Run one step, which says itself how far it is; whether it went well."""
    environment = {**os.environ, "TMPDIR": str(TEMPORARY), **more}
    return subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode == 0


def say(line: str) -> None:
    """Print it now, also into a file."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
