"""The structure of the code: sizes, who imports whom, and one home for each concept."""

import ast
import re
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest
from own_process import ROOT
from tracked_files import tracked

PACKAGES = ("bridge", "twin", "evaluator", "dashboards", "robot_gst")
SMALL = 150
"""Below so many lines a module that one neighbour imports is part of that neighbour."""

HOMES = {
    r"/joint_states|/gripper/state|/recorder/drops|/tf_static|/robot_description": (
        "bridge/episode/topics.py"
    ),
    r"shoulder_pan_joint|gripper_left_finger": "bridge/robots/",
}
"""What only one place spells, as a pattern of strings that are not docstrings."""


@cache
def modules() -> dict[str, Path]:
    """Module names and files of the packages."""
    found = {}
    for package in PACKAGES[:-1]:
        for path in (ROOT / package).rglob("*.py"):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found | {"robot_gst": ROOT / "robot_gst.py"}


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def imported(path: Path, *, lazily: bool = True) -> set[str]:
    """Our modules that a file imports; ``lazily``: also inside functions, and named in strings."""
    known, found = modules(), set()
    tree = parsed(path)
    for node in ast.walk(tree) if lazily else tree.body:
        match node:
            case ast.Import():
                found |= {alias.name for alias in node.names}
            case ast.ImportFrom(module=str(module)):
                found |= {f"{module}.{alias.name}" for alias in node.names} | {module}
            case ast.Constant(value=str(text)) if lazily:
                found.add(text.partition(":")[0] if "." in text else "")
    direct = {name for name in found if name in known}
    packages = {name for name in direct if any(other.startswith(f"{name}.") for other in direct)}
    return direct - packages


def functions() -> list[tuple[str, int]]:
    return [
        (f"{path.relative_to(ROOT)}:{node.lineno}", (node.end_lineno or 0) - node.lineno + 1)
        for path in modules().values()
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]


def test_a_file_has_at_most_a_thousand_lines() -> None:
    long = {str(path): len(path.read_text().splitlines()) for path in modules().values()}
    assert {name: lines for name, lines in long.items() if lines > 1000} == {}


def test_functions_fit_a_screen() -> None:
    lengths = sorted(length for _, length in functions())
    assert lengths[int(0.95 * len(lengths))] <= 60


def _is_offered(name: str) -> bool:
    package = modules().get(name.rpartition(".")[0])
    return package is not None and package.name == "__init__.py" and name in imported(package)


def test_a_small_module_that_one_neighbour_imports_is_part_of_it() -> None:
    importers = defaultdict(set)
    for name, path in modules().items():
        for other in imported(path):
            importers[other].add(name)
        # what a package offers by its own name is public
        importers[name] |= {"everybody"} if _is_offered(name) else set()
    tested = set()
    for path in (ROOT / "tests").rglob("*.py"):
        tested |= imported(path)
    lonely = [
        f"{name} <- {min(importers[name])}"
        for name, path in modules().items()
        if path.name != "__init__.py"
        and len(importers[name]) == 1
        and len(path.read_text().splitlines()) < SMALL
        and name not in tested
    ]
    assert lonely == []


def test_no_modules_import_each_other_in_a_circle() -> None:
    graph = {name: imported(path) - {name} for name, path in modules().items()}
    while free := [name for name, needs in graph.items() if not needs & graph.keys()]:
        for name in free:
            del graph[name]
    # what is left are circles and what leads to them
    while ends := [n for n in graph if not any(n in needs for needs in graph.values())]:
        for name in ends:
            del graph[name]
    assert graph == {}


def _docstrings(tree: ast.Module) -> set[int]:
    found = set()
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        for child in body if isinstance(body, list) else ():
            if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
                found.add(id(child.value))
    return found


@pytest.mark.parametrize("pattern", HOMES)
def test_a_name_is_spelled_in_one_place(pattern: str) -> None:
    elsewhere = []
    for path in modules().values():
        name = str(path.relative_to(ROOT))
        if name.startswith(HOMES[pattern]):
            continue
        tree = parsed(path)
        texts = _docstrings(tree)
        elsewhere += [
            f"{name}:{node.lineno}: {node.value[:60]}"
            for node in ast.walk(tree)
            if isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in texts
            and re.search(pattern, node.value)
        ]
    assert elsewhere == []


def test_decisions_are_few() -> None:
    assert len(list((ROOT / "docs" / "decisions").glob("*.md"))) <= 20


def test_nothing_large_is_tracked() -> None:
    if not (ROOT / ".git").exists():
        return
    assert [name for name in tracked() if (ROOT / name).stat().st_size > 1_000_000] == []
