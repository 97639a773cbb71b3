"""What Python files define, say and import, found in one pass over each."""

import ast
from dataclasses import dataclass
from functools import cache
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class SourceFacts:
    """Of one file. Its tree is not kept: the trees of all files together are large."""

    defined: tuple[tuple[int, str], ...]
    """Identifiers of functions, classes, arguments and variables, each with its line."""
    texts: tuple[tuple[int, str], ...]
    """Strings, each with its line."""
    plain_texts: tuple[tuple[int, str], ...]
    """Those that are not docstrings."""
    functions: tuple[tuple[int, int], ...]
    """Lines where functions begin, and how many lines each has."""
    imports: frozenset[str]
    """Modules, and names in modules, that are imported anywhere in the file."""


@cache
def source_facts(path: Path) -> SourceFacts:
    """Read a file and look at each node of its tree."""
    defined: list[tuple[int, str]] = []
    strings: list[ast.Constant] = []
    functions: list[tuple[int, int]] = []
    imports: set[str] = set()
    docstrings = set()
    for node in ast.walk(ast.parse(path.read_text())):
        match node:
            case ast.Name():
                if isinstance(node.ctx, ast.Store):
                    defined.append((node.lineno, node.id))
            case ast.Constant():
                if isinstance(node.value, str):
                    strings.append(node)
            case ast.arg():
                defined.append((node.lineno, node.arg))
            case ast.FunctionDef() | ast.AsyncFunctionDef():
                defined.append((node.lineno, node.name))
                functions.append((node.lineno, (node.end_lineno or 0) - node.lineno + 1))
            case ast.ClassDef():
                defined.append((node.lineno, node.name))
            case ast.Expr(value=ast.Constant()):
                docstrings.add(id(node.value))
            case ast.Import():
                imports |= {alias.name for alias in node.names}
            case ast.ImportFrom(module=str(module)):
                imports |= {f"{module}.{alias.name}" for alias in node.names} | {module}
    texts = [(node.lineno, str(node.value), id(node) in docstrings) for node in strings]
    return SourceFacts(
        defined=tuple(defined),
        texts=tuple((line, text) for line, text, _ in texts),
        plain_texts=tuple((line, text) for line, text, is_docstring in texts if not is_docstring),
        functions=tuple(functions),
        imports=frozenset(imports),
    )
