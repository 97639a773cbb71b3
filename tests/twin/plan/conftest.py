"""Lets the tests of the planner use their own scenes, and those of the replay's tests."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path += [str(HERE), str(HERE / "ground"), str(HERE / "constrain"), str(HERE.parent / "replay")]
