"""Causes of a verdict's no have one home: a literal elsewhere fails; the documents name each."""

import ast
from collections.abc import Iterator

import pytest
from own_process import ROOT
from tracked_files import tracked

from bridge.task.causes import Cause

PACKAGES = ("bridge", "twin", "evaluator", "dashboards")
HOME = "bridge/task/causes.py"
ALSO_OTHERS = {Cause.COLLISION, Cause.SHAPE, Cause.PROBABILITY, Cause.UNREACHABLE}
"""Words of other things too: tags of a URDF, predicates, files, why the planner finds no path."""


def literals(text: str) -> Iterator[str]:
    """Strings that are a cause and nothing else, and those that a factor gets as one."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and node.value in set(Cause) - ALSO_OTHERS:
            yield f"{node.lineno}: {node.value}"
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("Factor", "Failure"):
            for keyword in node.keywords:
                if keyword.arg == "cause" and isinstance(keyword.value, ast.Constant):
                    yield f"{node.lineno}: {keyword.value.value}"


def test_a_planted_literal_is_found() -> None:
    assert list(literals('x = "too_close"')) == ["1: too_close"]
    assert list(literals('Failure(cause="collision")')) == ["1: collision"]
    assert list(literals('tag = "collision"')) == []


def test_no_cause_is_written_out_beside_their_home() -> None:
    files = [
        path
        for path in tracked()
        if path.endswith(".py") and path.startswith(PACKAGES) and path != HOME
    ]
    assert len(files) > 100
    found = [f"{path}:{each}" for path in files for each in literals((ROOT / path).read_text())]
    assert found == [], "take it from bridge.task.causes.Cause"


@pytest.mark.parametrize("cause", Cause)
def test_the_documents_name_every_cause(cause: Cause) -> None:
    pages = (ROOT / "docs" / name for name in ("gate.md", "replay.md"))
    assert any(
        f"`{cause}`" in text or f"{cause}" in text for text in (p.read_text() for p in pages)
    )
