"""How large the house is: lines of each package, code, words, flags and commands.

The rows stand in ``pyproject.toml`` (``[tool.robot-gst.budget]``) and only fall. A file counts in
the first row whose pattern it fits, so a row of leaves stands before the package that it is cut
from. Lines are counted as ``wc -l`` does, of every file that git knows, whatever its suffix: code
that moves into another folder or language still counts somewhere.
"""

import ast
import fnmatch
import inspect
import tomllib
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

from cyclopts import App
from own_process import ROOT
from tracked_files import tracked

EVERYWHERE = {"--json", "--verbose", "--quiet", "--config", "--help", "--version"}
"""Flags that many commands share; they are not counted."""


@cache
def budget() -> dict[str, Any]:
    """The table of ``pyproject.toml``."""
    table: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
    return dict(table["robot-gst"]["budget"])


def row_of(name: str, rows: Mapping[str, Mapping[str, Any]]) -> str | None:
    """The first row that a file fits; None where none counts it."""
    for row, entry in rows.items():
        if any(fnmatch.fnmatchcase(name, pattern) for pattern in entry["files"]):
            return row
    return None


@cache
def lines_of(name: str) -> int:
    """Lines of a file, as ``wc -l`` counts them."""
    return (ROOT / name).read_bytes().count(b"\n")


def words_of(name: str) -> int:
    """Words of a file, as ``wc -w`` counts them."""
    return len((ROOT / name).read_text().split())


def code_lines(source: str) -> int:
    """Lines of Python that are no docstring, no comment and not blank.

    Strings below fields count as docstrings. Lines inside other strings count as code.
    """
    told: set[int] = set()
    inside: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant | ast.JoinedStr) and node.end_lineno:
            inside |= set(range(node.lineno, node.end_lineno + 1))
        match node:
            case ast.Expr(value=ast.Constant(value=str())):
                told |= set(range(node.lineno, (node.end_lineno or 0) + 1))
    counted = 0
    for number, line in enumerate(source.splitlines(), start=1):
        text = line.strip()
        if number in told or (number not in inside and (not text or text.startswith("#"))):
            continue
        counted += 1
    return counted


def sizes() -> dict[str, int]:
    """Lines of every row of the budget, and what they add up to."""
    rows = budget()["lines"]
    found = dict.fromkeys(rows, 0)
    for name in tracked():
        row = row_of(name, rows)
        if row is not None:
            found[row] += lines_of(name)
    return found


def uncounted() -> list[str]:
    """Files that no row counts, though they may hold code."""
    rows, prose = budget()["lines"], budget()["not_counted"]
    names = [name for name in tracked() if row_of(name, rows) is None]
    return [n for n in names if not any(fnmatch.fnmatchcase(n, pattern) for pattern in prose)]


def product_files() -> list[str]:
    """Python of the four packages and of the front door."""
    patterns = budget()["product"]
    return [n for n in tracked() if any(fnmatch.fnmatchcase(n, pattern) for pattern in patterns)]


def sums() -> dict[str, int]:
    """Lines and code lines of the product, words, flags and commands."""
    product = product_files()
    documents = [n for n in tracked() if n == "README.md" or fnmatch.fnmatchcase(n, "docs/*.md")]
    flags = [flag for _, _, shown in options() for flag in shown]
    keys = [key for _, keys, _ in options() for key in keys]
    return {
        "all": sum(map(lines_of, product)),
        "code": sum(code_lines((ROOT / name).read_text()) for name in product),
        "words of docs and README": sum(map(words_of, documents)),
        "words of CHANGELOG": words_of("CHANGELOG.md"),
        "flags shown": len(flags),
        "flags and TOML keys": len(keys),
        "commands": len(options()),
    }


@cache
def options() -> list[tuple[str, list[str], list[str]]]:
    """Every command that is shown, its options, and those that its help shows."""
    import robot_gst

    return list(_options(robot_gst.build_app(), ()))


def _options(app: App, path: tuple[str, ...]) -> Iterator[tuple[str, list[str], list[str]]]:
    members = [name for name in app if not name.startswith("-") and app[name].show]
    for name in members:
        yield from _options(app[name], (*path, name))
    if members or not path:
        return
    keys, shown = [], []
    for argument in app.assemble_argument_collection(parse_docstring=False):
        names = [name for name in argument.names if name.startswith("--")]
        only_by_place = argument.field_info.kind in (
            inspect.Parameter.POSITIONAL_ONLY,
            inspect.Parameter.VAR_POSITIONAL,
        )
        is_set_elsewhere = argument.parameter.parse is False
        if not names or names[0] in EVERYWHERE or only_by_place or is_set_elsewhere:
            continue
        if argument.children:
            continue
        keys.append(names[0])
        if argument.show:
            shown.append(names[0])
    yield " ".join(path), keys, shown


def table(found: Mapping[str, int], allowed: Mapping[str, int], goal: Mapping[str, int]) -> str:
    """The rows as a person reads them."""
    lines = [f"{'':58}{'now':>9}{'budget':>9}{'after R':>9}"]
    for row, number in found.items():
        wanted = f"{goal[row]:,}" if row in goal else ""
        lines.append(f"{row:58}{number:9,}{allowed[row]:9,}{wanted:>9}")
    return "\n".join(lines)
