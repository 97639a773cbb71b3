"""A pytest plugin for ``make test TORCH=no``: what needs torch is skipped, and says so.

Tests need not know of it: whoever imports torch, or a package that needs it, and finds it missing
is skipped, as a file when it is collected or as a test when it runs.
"""

from collections.abc import Generator
from importlib.util import find_spec
from typing import Any

import pytest

NEED_TORCH = ("torch", "torchmetrics", "transformers", "safetensors", "tokenizers")
REASON = "torch is not installed (make test TORCH=no)"


def pytest_configure() -> None:
    """Refuse to hide anything where torch is installed."""
    if find_spec("torch") is not None:
        message = "torch is installed: run make test without TORCH=no"
        raise pytest.UsageError(message)


def lacks_torch(error: BaseException | None) -> bool:
    """Whether an error, or what led to it, says that one of the packages is missing."""
    while error is not None:
        if isinstance(error, ModuleNotFoundError) and error.name in NEED_TORCH:
            return True
        if getattr(error, "package", None) in NEED_TORCH:  # bridge.errors.MissingDependencyError
            return True
        error = error.__cause__ or error.__context__
    return False


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Generator[None, Any, Any]:
    """Turn a file that cannot be imported for want of torch into one skip."""
    report = yield
    if report.failed and any(
        f"No module named '{name}" in str(report.longrepr) for name in NEED_TORCH
    ):
        report.outcome = "skipped"
        report.longrepr = (str(collector.path), 1, f"Skipped: {REASON}")
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(call: pytest.CallInfo[None]) -> Generator[None, Any, Any]:
    """Turn a test that met a missing torch into a skip."""
    report = yield
    if report.failed and call.excinfo is not None and lacks_torch(call.excinfo.value):
        path, line = report.location[0], (report.location[1] or 0) + 1
        report.outcome = "skipped"
        report.longrepr = (path, line, f"Skipped: {REASON}")
    return report
