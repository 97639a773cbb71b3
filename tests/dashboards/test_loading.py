"""What requests load late, they load one thread at a time."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import dashboards

COMMANDS = {"cli.py", "config.py", "demo.py", "opening.py", "trials.py"}
COMMANDS |= {"standin_cli.py", "standin_settings.py"}
"""They run before or without a server, in one thread."""
ANSWERING = [
    path
    for path in sorted(Path(dashboards.__file__).parent.glob("*.py"))
    if path.name not in COMMANDS
]


def late_imports(node: ast.AST, *, inside: bool = False, held: bool = False) -> Iterator[int]:
    """Lines of imports within functions for which nobody holds the lock."""
    if isinstance(node, ast.Import | ast.ImportFrom) and inside and not held:
        yield node.lineno
    if isinstance(node, ast.With):
        held = held or any(ast.unparse(item.context_expr) == "LOADING" for item in node.items)
    inside = inside or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    for child in ast.iter_child_nodes(node):
        yield from late_imports(child, inside=inside, held=held)


@pytest.mark.parametrize("path", ANSWERING, ids=lambda path: path.name)
def test_whatever_a_request_loads_it_loads_under_the_lock(path: Path) -> None:
    assert list(late_imports(ast.parse(path.read_text()))) == []


def test_an_import_without_the_lock_would_be_found() -> None:
    free = "def page():\n    from a import b\n"
    held = "def page():\n    with LOADING:\n        from a import b\n"
    assert list(late_imports(ast.parse(free))) == [2]
    assert list(late_imports(ast.parse(held))) == []
