"""Lets the tests of this folder cast views as those of shapes do."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "shape"))
