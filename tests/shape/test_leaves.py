"""The core imports no leaf, a leaf imports no other leaf, and what the registry names is there."""

import ast
from importlib import import_module

import pytest
from own_process import ROOT
from tracked_files import tracked

from bridge.leaves import LEAVES, leaf_commands

PACKAGES = ("bridge/", "twin/", "evaluator/", "dashboards/", "robot_gst.py")


def leaf_of(module: str) -> str | None:
    """The leaf that a module is part of."""
    parts = [f"{module}.".startswith(f"{own}.") for leaf in LEAVES.values() for own in leaf.modules]
    names = [name for name, leaf in LEAVES.items() for _ in leaf.modules]
    return next((name for name, is_part in zip(names, parts, strict=True) if is_part), None)


def imported(source: str) -> set[str]:
    """Modules that a file names in imports, wherever they stand."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def test_no_leaf_is_imported_from_outside() -> None:
    wrong = []
    for name in tracked():
        if not name.startswith(PACKAGES) or not name.endswith(".py"):
            continue
        own = leaf_of(name.removesuffix(".py").removesuffix("/__init__").replace("/", "."))
        for module in imported((ROOT / name).read_text()):
            leaf = leaf_of(module)
            if leaf is not None and leaf != own:
                wrong.append(f"{name} imports {module} of the leaf {leaf}")
    assert wrong == []


TARGETS = [entry for leaf in LEAVES.values() for entry in leaf.entries.values()]
TARGETS += [command.target for command in leaf_commands()]


@pytest.mark.parametrize("target", TARGETS)
def test_what_a_leaf_brings_is_there_and_lies_in_it(target: str) -> None:
    module, _, name = target.partition(":")
    assert callable(getattr(import_module(module), name))
    assert leaf_of(module) is not None
