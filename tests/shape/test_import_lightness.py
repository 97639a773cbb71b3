"""What a static import check cannot see: what importing a light room really loads.

``lint-imports`` does not look into a parent package's ``__init__`` (style page, trap 3).
"""

from pathlib import Path

from own_process import ROOT, printed

HEAVY = ("pyrealsense2", "zenoh", "torch", "open3d", "mujoco", "pybullet", "rerun", "pandas")
LIGHT_ROOMS = (
    "bridge",
    "bridge.geometry.se3",
    "bridge.task.plan",
    "bridge.task.predicate",
    "bridge.episode.reader",
    "bridge.episode.writer",
    "bridge.episode.streams",
    "bridge.cli.episodes",
    "bridge.cli.recording",
    "bridge.cli.exchange",
    "twin.cli",
    "twin.plan.cli",
    "evaluator.cli",
    "dashboards.cli",
    "dashboards.standin_cli",
    "dashboards.standin_settings",
    "dashboards.scene_file",
    "evaluator.result",
    "robot_gst",
)


def test_light_rooms_load_nothing_heavy() -> None:
    code = f"""
import importlib, sys
guilty = {{}}
for room in {LIGHT_ROOMS!r}:
    importlib.import_module(room)
    guilty |= {{name: room for name in {HEAVY!r} if name in sys.modules and name not in guilty}}
print(guilty)
"""
    assert printed(code) == "{}"


def test_the_front_door_loads_in_an_instant_for_ctrl_c_to_be_heard() -> None:
    code = "import robot_gst, sys; print({'cyclopts', 'rich', 'numpy'} & {*sys.modules})"
    assert printed(code) == "set()"


def test_hugging_face_datasets_would_not_be_hidden() -> None:
    assert not list((ROOT / "datasets").rglob("__init__.py"))
    assert not list((ROOT / "tests").rglob("__init__.py"))


def test_tests_and_datasets_are_not_importable_from_elsewhere(tmp_path: Path) -> None:
    code = (
        "import importlib.util as u; "
        "print([n for n in ('datasets.tasks', 'tests.shape') if n.split('.')[0] in "
        "('datasets', 'tests') and u.find_spec(n.split('.')[0])])"
    )
    assert printed(code, folder=tmp_path) == "[]"


def test_only_the_wire_imports_zenoh() -> None:
    offenders = [
        str(path.relative_to(ROOT))
        for room in ("bridge", "twin", "evaluator", "dashboards")
        for path in (ROOT / room).rglob("*.py")
        if "import zenoh" in path.read_text() and "bridge/wire" not in str(path)
    ]
    assert offenders == []
