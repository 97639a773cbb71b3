"""Lets the tests of these rooms import the module ``textured_room`` that lies beside them."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
