"""The structure of the code: sizes, who imports whom, and one home for each concept."""

import re
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest
from own_process import ROOT
from source_facts import source_facts
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
def imported(path: Path) -> frozenset[str]:
    """Our modules that a file imports: also inside functions, and named in strings.

    What the registry of leaves names is imported by nobody: the core works without it.
    """
    known, facts = modules(), source_facts(path)
    named = {text.partition(":")[0] for _, text in facts.texts if "." in text}
    named -= named if path == ROOT / "bridge" / "leaves.py" else set()
    direct = {name for name in facts.imports | named if name in known}
    packages = {parent for name in direct for parent in parents(name)}
    return frozenset(direct - packages)


def parents(name: str) -> list[str]:
    parts = name.split(".")
    return [".".join(parts[:end]) for end in range(1, len(parts))]


def functions() -> list[tuple[str, int]]:
    return [
        (f"{path.relative_to(ROOT)}:{line}", length)
        for path in modules().values()
        for line, length in source_facts(path).functions
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
    lonely = [
        name
        for name, path in modules().items()
        if path.name != "__init__.py"
        and len(importers[name]) == 1
        and len(path.read_text().splitlines()) < SMALL
    ]
    texts = {path: path.read_text() for path in (ROOT / "tests").rglob("*.py")}
    untested = [
        f"{name} <- {min(importers[name])}"
        for name in lonely
        if not any(
            name.rpartition(".")[2] in text and name in imported(path)
            for path, text in texts.items()
        )
    ]
    assert untested == []


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


@pytest.mark.parametrize("pattern", HOMES)
def test_a_name_is_spelled_in_one_place(pattern: str) -> None:
    elsewhere = []
    for path in modules().values():
        name = str(path.relative_to(ROOT))
        if name.startswith(HOMES[pattern]):
            continue
        elsewhere += [
            f"{name}:{line}: {text[:60]}"
            for line, text in source_facts(path).plain_texts
            if re.search(pattern, text)
        ]
    assert elsewhere == []


def test_decisions_are_few() -> None:
    assert len(list((ROOT / "docs" / "decisions").glob("*.md"))) <= 15


def test_nothing_large_is_tracked() -> None:
    if not (ROOT / ".git").exists():
        return
    assert [name for name in tracked() if (ROOT / name).stat().st_size > 1_000_000] == []
