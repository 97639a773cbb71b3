"""Settings for all tests."""

import os

import pytest
from hypothesis import settings

# Time limits of single examples say more about the machine's other work than about the code.
settings.register_profile("robot-gst", deadline=None)
settings.load_profile("robot-gst")

# Workers side by side share the cores; nested threads would only get in each other's way.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

LONG_FILES = (
    "test_writer_killed.py",
    "test_demo.py",
    "test_endurance.py",
    "test_real_input.py",
    "test_standin_session.py",
)
"""Files of a minute or more. Workers take whole files in this order: one that came last would leave
the other worker idle."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files."""
    items.sort(key=lambda item: item.path.name not in LONG_FILES)
