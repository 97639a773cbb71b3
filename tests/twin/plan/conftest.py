"""Lets the tests of the planner use their own start, and the scenes of the replay's tests."""

import sys
from pathlib import Path

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1] / "replay")]
