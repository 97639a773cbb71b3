"""Lets the tests of this folder import ``cast_views``, and casts its training views once."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import cast_views

from twin.scene.frames.rgbd import TrainingView


@pytest.fixture(scope="session")
def views() -> list[TrainingView]:
    """Cube and box on a table, seen from 24 places."""
    return cast_views.training_views()
