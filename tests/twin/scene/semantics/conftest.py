"""Lets the tests of this folder import ``table_scene``, and make its scenes once."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import table_scene


@pytest.fixture(scope="session")
def tabletop() -> table_scene.World:
    """A cube, an open box, a ball and a toy on a table, seen from ten places and fused."""
    return table_scene.make_world(table_scene.tabletop_pieces(), num_train=10, num_held_out=3)
