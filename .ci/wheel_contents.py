"""Look into an sdist and a wheel: all that is needed is there, and nothing that is not."""

import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("bridge", "twin", "evaluator", "dashboards")
NOT_PACKAGED = (".cpp", ".hpp", ".md")
LICENCES = ("LICENSE", "THIRD_PARTY_NOTICES.md")


def tracked() -> list[str]:
    """List the files git knows."""
    listing = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return [name for name in listing.stdout.splitlines() if (ROOT / name).is_file()]


def wanted_in_wheel() -> set[str]:
    """Name what the wheel must hold, extension modules aside."""
    files = {
        name
        for name in tracked()
        if name.split("/")[0] in PACKAGES and not name.endswith(NOT_PACKAGED)
    }
    datasets = {f"bridge/_{name}" for name in tracked() if name.startswith("datasets/")}
    return files | datasets | {"robot_gst.py"}


def native_modules() -> list[str]:
    """Read from CMakeLists.txt which extension modules go where."""
    text = (ROOT / "CMakeLists.txt").read_text(encoding="utf-8")
    found = re.findall(r"TARGETS (\w+) LIBRARY DESTINATION (\w[\w/]+) COMPONENT", text)
    return [f"{folder}/{name}" for name, folder in found]


def problems_of_wheel(path: Path) -> list[str]:
    """Say what is missing in the wheel, and what lies there and should not."""
    names = {name for name in zipfile.ZipFile(path).namelist() if not name.endswith("/")}
    problems = [f"missing: {name}" for name in sorted(wanted_in_wheel() - names)]
    modules = native_modules()
    for module in modules:
        if not any(re.fullmatch(rf"{module}\.[\w.-]+\.so", name) for name in names):
            problems.append(f"missing: extension module {module}")
    allowed = wanted_in_wheel()
    for name in sorted(names - allowed):
        in_metadata = re.match(r"robot_gst-[^/]+\.dist-info/", name)
        if not in_metadata and not name.startswith(tuple(f"{module}." for module in modules)):
            problems.append(f"unwanted: {name}")
    for licence in LICENCES:
        if not any(name.endswith(f".dist-info/licenses/{licence}") for name in names):
            problems.append(f"missing: {licence}")
    return problems


def problems_of_sdist(path: Path) -> list[str]:
    """Say what is missing in the sdist, and what lies there and git does not know."""
    with tarfile.open(path) as archive:
        names = {item.name.partition("/")[2] for item in archive.getmembers() if item.isfile()}
    known = set(tracked())
    wanted = {name for name in known if not name.startswith(".")}
    problems = [f"missing: {name}" for name in sorted(wanted - names)]
    return problems + [f"unwanted: {name}" for name in sorted(names - known - {"PKG-INFO"})]


def main() -> int:
    """Look at the two files named on the command line."""
    sdist, wheel = (Path(name) for name in sys.argv[1:3])
    problems = [f"{sdist.name}: {problem}" for problem in problems_of_sdist(sdist)]
    problems += [f"{wheel.name}: {problem}" for problem in problems_of_wheel(wheel)]
    sys.stdout.writelines(f"{problem}\n" for problem in problems)
    if not problems:
        sys.stdout.write(
            f"wheel: {len(wanted_in_wheel())} files and {len(native_modules())} extension modules "
            "inside, licences too, nothing else\n"
        )
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
