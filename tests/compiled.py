"""Compile what a fresh clone has not compiled yet: each worker of a test run its share."""

import functools
import sys
from pathlib import Path
from unittest.mock import patch

import pytest
from _pytest.assertion import rewrite
from jaxtyping import _import_hook

ROOT = Path(__file__).resolve().parents[1]


def compile_share(config: pytest.Config, number: int, count: int) -> None:
    """Compile every so manieth file that needs it, for all workers."""
    tests = [*(ROOT / "tests").rglob("test_*.py"), *(ROOT / "tests").rglob("conftest.py")]
    for path in sorted(tests)[number::count]:
        _compile_test(config, path)
    for finder in _finders():
        modules = [path for name in finder.modules for path in (ROOT / name).rglob("*.py")]
        for path in sorted(modules)[number::count]:
            _compile_module(finder, path)


def _compile_test(config: pytest.Config, path: Path) -> None:
    kept = rewrite.get_cache_dir(path) / (path.stem + rewrite.PYC_TAIL)
    if _is_newer(kept, path):
        return
    if rewrite.try_makedirs(kept.parent):
        source_hash, code = rewrite._rewrite_test(path, config)
        rewrite._write_pyc(config.stash[rewrite.assertstate_key], code, source_hash, kept)


def _finders() -> list[_import_hook._JaxtypingFinder]:
    return [each for each in sys.meta_path if isinstance(each, _import_hook._JaxtypingFinder)]


def _compile_module(finder: _import_hook._JaxtypingFinder, path: Path) -> None:
    """Do what importing the module does before it runs."""
    place = functools.partial(
        _import_hook._optimized_cache_from_source, finder._typechecker.get_hash()
    )
    if _is_newer(Path(place(path)), path):
        return
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    loader = _import_hook._JaxtypingLoader(name, str(path), typechecker=finder._typechecker)
    with patch("importlib._bootstrap_external.cache_from_source", place):
        loader.get_code(name)


def _is_newer(kept: Path, source: Path) -> bool:
    return kept.exists() and kept.stat().st_mtime >= source.stat().st_mtime
