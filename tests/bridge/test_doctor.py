"""What ``robot-gst doctor`` finds."""

import importlib.util
import re
import tomllib
from pathlib import Path

import pytest
from own_process import printed

from bridge import doctor
from bridge.episode.run_folder import RunFolder

PYPROJECT = Path(__file__).parents[2] / "pyproject.toml"


def test_packages_and_what_is_optional_are_those_of_the_project_file() -> None:
    project = tomllib.loads(PYPROJECT.read_text())["project"]
    extras = project["optional-dependencies"]
    (demo,) = extras["demo"]
    needed = {"base", *demo.removeprefix("robot-gst[").removesuffix("]").split(",")}
    wanted = {"base": project["dependencies"]} | {
        name: packages
        for name, packages in extras.items()
        if name not in ("demo", "all", "bench", "dev")
    }
    assert set(doctor.NEEDED) == needed
    assert {extra: set(doctor.packages_of(extra)) for extra in doctor.EXTRAS} == {
        name: {re.split(r"[^\w.-]", package)[0] for package in packages} - {"robot-gst"}
        for name, packages in wanted.items()
    }


def test_each_native_extension_is_built_or_what_goes_without_it_is_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    find_spec = importlib.util.find_spec
    for what, module, without in doctor.NATIVE:
        is_built = find_spec(module) is not None
        (found,) = [finding for finding in doctor.examine() if finding.what == what]
        assert found.ok == is_built
        with monkeypatch.context() as patch:
            patch.setattr(doctor, "find_spec", lambda name: None)
            (found,) = [finding for finding in doctor.examine() if finding.what == what]
        assert (found.ok, found.found) == (False, f"not built: {without}")
        assert "make" in found.advice


def test_extras_that_nothing_depends_on_are_named_but_not_held_against_a_machine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def nothing_installed(name: str) -> str:
        raise doctor.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(doctor.metadata, "version", nothing_installed)
    found = {item.what: item for item in doctor.examine()}
    for what in ("transformers [foundation]", "av [video]", "torch [twin]", "gsplat [gpu]"):
        assert (found[what].ok, found[what].found) == (True, "missing (optional)")
        assert "pip install" in found[what].advice
    assert not found["open3d [replay]"].ok
    assert found["open3d [replay]"].purpose == "rebuild, render, replay, gate, calibrate"


WITHOUT = """
import sys

class Finder:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == sys.argv[1]:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Finder())
import robot_gst

sys.stderr = sys.stdout
print(robot_gst.run(sys.argv[2:]))
"""


@pytest.mark.parametrize(
    ("module", "command", "package", "extra"),
    [
        ("zenoh", "record new", "eclipse-zenoh", "record"),
        ("scipy", "replay run", "scipy", "replay"),
        ("jinja2", "evaluate run", "jinja2", "report"),
        ("starlette", "dashboard run", "starlette", "dashboard"),
        ("pyrealsense2", "publish realsense", "pyrealsense2", "realsense"),
        ("pinocchio", "robot check panda", "pin", "replay"),
    ],
)
def test_a_command_without_a_package_names_the_extra_that_brings_it(
    tmp_path: Path, module: str, command: str, package: str, extra: str
) -> None:
    RunFolder.create(tmp_path / "run")
    words = [str(tmp_path / word) if word in ("run", "new") else word for word in command.split()]
    told = printed(WITHOUT, module, *words)
    assert f"{package} is not installed" in told
    assert f"pip install 'robot-gst[{extra}]'" in told
    assert told.endswith("1")


def test_a_missing_module_that_no_extra_brings_is_a_defect_and_stays_one() -> None:
    with pytest.raises(ModuleNotFoundError, match="lost"):
        doctor.how_to_get(ModuleNotFoundError("No module named 'bridge.lost'", name="bridge.lost"))
