"""Install one stage into .venv, after saying what will be downloaded and how large it is.

.. code-block:: shell

    .venv/bin/python .ci/install.py demo           # what the demo needs
    .venv/bin/python .ci/install.py test           # the rest: tests, checks, benchmarks
    .venv/bin/python .ci/install.py test no-torch  # the rest without torch and what needs it
"""

import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from threading import Event, Thread
from typing import TextIO

ROOT = Path(__file__).resolve().parents[1]
VENV = Path(sys.prefix)
SITE = next(Path(path) for path in sys.path if path.endswith("site-packages"))
LOG = VENV / "install.log"
TEMPORARY = VENV / "tmp"
"""Wheels wait here until all are there; a /tmp in memory is too small for them."""

TOOLS = TEMPORARY / "tools"
"""What compiles the extension modules and is not in .venv, removed afterwards: always the same
place, so that a second build goes on where the first ended."""

BUILD_TOOLS = ("scikit-build-core>=1.0", "nanobind>=2.4", "cmake", "ninja")
SELDOM_IMPORTED = "/tests/|/transformers/models/"
BYTECODE = ("-W", "ignore", "-m", "compileall", "-qq", "-j", "0", "-x", SELDOM_IMPORTED)
"""Compiles all packages but what is compiled when it is imported, a quarter of all lines."""
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
    "numba": (62, 208),
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
        return install(stage, download)
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
    config = subprocess.run(
        [sys.executable, "-m", "pip", "config", "list"], capture_output=True, text=True, check=False
    ).stdout
    folders = " ".join(re.findall(r"find-links='([^']*)'", config)).replace("\\n", " ").split()
    for folder in folders:
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


def install(stage: str, megabytes: int) -> int:
    """Run pip and show how far it is."""
    pip = [sys.executable, "-m", "pip", "install", "--no-compile", "--progress-bar", "off"]
    pip += ["--disable-pip-version-check", "-c", "constraints.txt"]
    steps = [[*pip, *requirements(EXTRAS[stage])]]
    if stage == "demo":
        if tools := [tool for tool in BUILD_TOOLS if not is_installed(tool.split(">")[0])]:
            steps.append([*pip, "--target", str(TOOLS), *tools])
        steps.append([*pip, "--no-build-isolation", "--no-deps", "-e", "."])
    progress = Progress(megabytes)
    started = time.monotonic()
    with LOG.open("w", encoding="utf-8") as log, progress.shown():
        failed = any(run(step, progress, log) for step in steps)
        if stage != "demo" and not failed:
            progress.enter("compiling to bytecode")
            # On all cores; a few files of the packages are templates and do not compile.
            run([sys.executable, *BYTECODE, str(SITE)], progress, log)
    if failed:
        tail = LOG.read_text(encoding="utf-8").splitlines()[-25:]
        sys.stderr.write("\n".join([*tail, f"pip failed; all it said is in {LOG}.", ""]))
        return 1
    remove_unused()
    say(f"Installed in {time.monotonic() - started:.0f} s; what pip said is in {LOG}")
    return 0


def remove_unused() -> None:
    """Delete the large parts of packages that nothing reads."""
    for name in UNUSED:
        place = SITE / name
        if place.is_dir():
            shutil.rmtree(place)
        else:
            place.unlink(missing_ok=True)


def run(command: list[str], progress: "Progress", log: TextIO) -> int:
    """Run one step, keep all it says, and learn from it what it is doing."""
    environment = {**os.environ, "TMPDIR": str(TEMPORARY), "PYTHONUNBUFFERED": "1"}
    if "--no-build-isolation" in command:
        environment["PYTHONPATH"] = str(TOOLS)
        places = [str(TOOLS / "bin"), str(VENV / "bin"), os.environ["PATH"]]
        environment["PATH"] = os.pathsep.join(places)
    with subprocess.Popen(
        command,
        cwd=ROOT,
        env=environment,
        text=True,
        errors="replace",
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    ) as pip:
        for line in pip.stdout or ():
            log.write(line)
            progress.read(line)
    return pip.returncode


class Progress:
    """One line that says what pip does: rewritten on a terminal, printed now and then elsewhere."""

    def __init__(self, megabytes: int) -> None:
        """Begin at nothing, of about so many megabytes."""
        self.megabytes = megabytes
        self.enter("asking for packages")
        self._wanted = self._before = 0
        self._on_terminal = sys.stdout.isatty()

    def enter(self, phase: str) -> None:
        """Go on to the next thing to do."""
        self.phase, self._since = phase, time.monotonic()

    def read(self, line: str) -> None:
        """Take one line of pip."""
        words = line.split()
        if line.startswith("Collecting "):
            self.enter(f"fetching {re.split('[<>=!~;@ ([]', words[1])[0]}")
        elif words[:1] == ["Downloading"]:
            self.enter(f"fetching {Path(words[1]).name.split('-')[0]} {' '.join(words[2:])}")
        elif words[:1] in (["Building"], ["Preparing"]) and words[-1] == "started":
            self.enter(f"{words[0].lower()} {line.split(' for ')[-1].split()[0]}")
        elif line.startswith("Installing collected packages:"):
            self._wanted, self._before = line.count(",") + 1, finished()
            self.enter("installing")

    def line(self) -> str:
        """What is going on now."""
        if self.phase.startswith("fetching"):
            return f"{self.phase}; {size(TEMPORARY) / 1e6:.0f} of about {self.megabytes} MB"
        if self.phase == "installing":
            return f"installing {finished() - self._before} of {self._wanted} packages"
        return f"{self.phase}, {time.monotonic() - self._since:.0f} s"

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Show it until the block ends."""
        over = Event()
        thread = Thread(target=self._show, args=(over,), daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()

    def _show(self, over: Event) -> None:
        last = ""
        while not over.wait(0.5 if self._on_terminal else 10.0):
            line = self.line()
            if self._on_terminal:
                width = shutil.get_terminal_size().columns - 1
                sys.stdout.write("\r" + line[:width].ljust(width))
                sys.stdout.flush()
            elif line != last:
                say(f"  {line}")
            last = line
        if self._on_terminal:
            sys.stdout.write("\r" + " " * (shutil.get_terminal_size().columns - 1) + "\r")


def finished() -> int:
    """How many packages lie in .venv as a whole: their record is written last."""
    return sum(1 for _ in SITE.glob("*.dist-info/RECORD"))


def size(folder: Path) -> int:
    """Bytes below a folder that others are writing in."""
    total = 0
    for place, _, names in os.walk(folder):
        for name in names:
            try:
                total += (Path(place) / name).lstat().st_size
            except OSError:
                continue
    return total


def say(line: str) -> None:
    """Print it now, also into a file."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
