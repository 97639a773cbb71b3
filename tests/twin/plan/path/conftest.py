"""Lets the tests here import ``path_scene``, and draws the pairs once."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from path_scene import Pairs, pairs_of_test


@pytest.fixture(scope="session")
def pairs() -> Pairs:
    return pairs_of_test(each=3)
