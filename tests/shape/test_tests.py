"""What the tests themselves must not do."""

import ast
from pathlib import Path

TESTS = Path(__file__).parents[1]
CLOCKS = {"monotonic", "perf_counter", "process_time", "thread_time", "time"}


def _reads_a_clock(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr in CLOCKS
        and isinstance(node.func.value, ast.Name)
        and node.func.value.id == "time"
    )


def test_no_test_asserts_how_long_something_took() -> None:
    """Count work, wait for an event or measure it in benchmarks/; waiting may end at a deadline."""
    found = [
        f"{path.relative_to(TESTS)}:{node.lineno}"
        for path in sorted(TESTS.rglob("*.py"))
        if any(f"time.{clock}" in path.read_text() for clock in CLOCKS)
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Assert)
        for inner in ast.walk(node.test)
        if isinstance(inner, ast.BinOp)
        and isinstance(inner.op, ast.Sub)
        and _reads_a_clock(inner.left)
    ]
    assert found == []
