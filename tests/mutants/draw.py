"""Draws changes of one place of the code at random, each with the test files near by."""

import ast
import random
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from own_process import PACKAGES, ROOT

SWAPPED = {
    ast.Lt: "<=",
    ast.LtE: "<",
    ast.Gt: ">=",
    ast.GtE: ">",
    ast.Eq: "!=",
    ast.NotEq: "==",
    ast.In: "not in",
    ast.NotIn: "in",
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "/",
    ast.Div: "*",
    ast.And: "or",
    ast.Or: "and",
}
NAMES = {
    "all": "any",
    "any": "all",
    "min": "max",
    "max": "min",
    "mean": "median",
    "median": "mean",
    "argmin": "argmax",
    "argmax": "argmin",
    "sin": "cos",
    "cos": "sin",
    "floor": "ceil",
    "ceil": "floor",
}
MOST_TESTS = 8
"""Test files of one mutant: those whose name is nearest come first."""


@dataclass(frozen=True, kw_only=True)
class Mutant:
    """One changed place, and the test files near by that must notice."""

    path: str
    line: int
    start: int
    end: int
    """Of the changed bytes of the file."""
    old: str
    new: str

    @property
    def id(self) -> str:
        """Where it is and what changes."""
        return f"{self.path}:{self.line} {self.old!r} -> {self.new!r}"

    def applied(self, source: str) -> str:
        """The file with the change."""
        data = source.encode()
        return (data[: self.start] + self.new.encode() + data[self.end :]).decode()


class _Places(ast.NodeVisitor):
    """Finds what can be changed; texts, annotations and decorators are passed over."""

    def __init__(self, source: str) -> None:
        self.found: list[tuple[int, int, int, str]] = []
        lines = source.encode().splitlines(keepends=True)
        self._data = source.encode()
        self._starts = [0]
        for line in lines:
            self._starts.append(self._starts[-1] + len(line))

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        for statement in node.body:
            self.visit(statement)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        for statement in node.body:  # frozen=True of its decorator declares, and does nothing
            self.visit(statement)

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """What is said is not changed."""

    def visit_Raise(self, node: ast.Raise) -> None:
        """Nor what an error says."""

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_Compare(self, node: ast.Compare) -> None:
        self._between(node.left, node.comparators[0], node.ops[0])
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        self._between(node.left, node.right, node.op)
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        self._between(node.values[0], node.values[1], node.op)
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.USub | ast.Not):
            self._add(self._at(node), self._at(node.operand), node.lineno, "")
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        match node.func:
            case ast.Name(id=name) | ast.Attribute(attr=name) if name in NAMES:
                end = self._at_end(node.func)
                self._add(end - len(name), end, node.lineno, NAMES[name])
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        if isinstance(node.value, bool):
            self._add(self._at(node), self._at_end(node), node.lineno, str(not node.value))
        elif isinstance(node.value, int | float):
            new = repr(2 * node.value) if node.value else "1"
            self._add(self._at(node), self._at_end(node), node.lineno, new)

    def _between(self, left: ast.expr, right: ast.expr, operator: ast.AST) -> None:
        new = SWAPPED.get(type(operator))
        start, end = self._at_end(left), self._at(right)
        between = self._data[start:end].decode()
        operators = r"not\s+in|<=|>=|==|!=|<|>|\bin\b|\+|-|\*|/|\band\b|\bor\b"
        signs = re.search(operators, between)
        if new is not None and signs is not None and "#" not in between:
            self._add(start + signs.start(), start + signs.end(), left.lineno, new)

    def _add(self, start: int, end: int, line: int, new: str) -> None:
        self.found.append((start, end, line, new))

    def _at(self, node: ast.expr) -> int:
        return self._starts[node.lineno - 1] + node.col_offset

    def _at_end(self, node: ast.expr) -> int:
        return self._starts[(node.end_lineno or 1) - 1] + (node.end_col_offset or 0)


def places(path: str, source: str) -> list[Mutant]:
    """Every change of one place of a file."""
    visitor = _Places(source)
    visitor.visit(ast.parse(source))
    data = source.encode()
    return [
        Mutant(path=path, line=line, start=start, end=end, old=data[start:end].decode(), new=new)
        for start, end, line, new in visitor.found
    ]


def _is_python(mutant: Mutant, source: str) -> bool:
    try:
        ast.parse(mutant.applied(source))
    except SyntaxError:
        return False
    return True


def draw(seed: str, count: int) -> list[Mutant]:
    """So many changes of all packages, the same ones for the same seed and code."""
    random_ = random.Random(seed)
    paths = sorted(p for name in PACKAGES for p in (ROOT / name).rglob("*.py"))
    sizes = [path.stat().st_size for path in paths]
    found: dict[str, Mutant] = {}
    while len(found) < count:
        path = random_.choices(paths, sizes)[0]
        source = path.read_text()
        choices = places(str(path.relative_to(ROOT)), source)
        mutant = random_.choice(choices) if choices else None
        if mutant is not None and _is_python(mutant, source):
            found[mutant.id] = mutant
    return list(found.values())


@cache
def _texts(folders: tuple[str, ...], pattern: str) -> dict[Path, str]:
    paths = sorted(path for folder in folders for path in (ROOT / folder).rglob(pattern))
    return {path.relative_to(ROOT): path.read_text() for path in paths}


def _naming(path: str, folders: tuple[str, ...], pattern: str) -> list[Path]:
    """Files below folders that import a module."""
    module = ".".join(Path(path).with_suffix("").parts).removesuffix(".__init__")
    package, _, name = module.rpartition(".")
    imports = re.compile(
        rf"(from|import) {re.escape(module)}\b|from {re.escape(package)} import [^\n]*\b{name}\b"
    )
    texts = _texts(folders, pattern)
    return [file for file, text in texts.items() if imports.search(text)]


def _tests(path: str) -> list[Path]:
    """Test files that mirror a module's path or import it, those of its own name first."""
    file = Path(path)
    name, mirrored = (file.parent.name if file.stem == "__init__" else file.stem), file.parent
    found = set(_naming(path, ("tests",), "test_*.py"))
    for test in _texts(("tests",), "test_*.py"):
        if test.parent == "tests" / mirrored and name in test.stem:
            found.add(test)
    near = [test for test in found if "end_to_end" not in test.parts]
    return sorted(near, key=lambda t: (name not in t.stem, "tests" / mirrored != t.parent, str(t)))


def near_tests(path: str) -> list[str]:
    """Test files that mirror a module's path or import it.

    A module that no test imports is tested through those that import it: then theirs.
    """
    found = _tests(path)
    if not found:
        importers = _naming(path, PACKAGES, "*.py")
        found = list(dict.fromkeys(test for file in importers for test in _tests(str(file))[:2]))
    if not found:
        found = [
            t for t in _texts(("tests",), "test_*.py") if t.parent == "tests" / Path(path).parent
        ]
    return [str(test) for test in found[:MOST_TESTS]]
