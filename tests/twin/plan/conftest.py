"""Lets the tests of the planner use the scenes of the replay's tests."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "replay"))
