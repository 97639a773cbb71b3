"""The script that makes episodes of the Kinova runs, as a module."""

import importlib.util
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[1] / "datasets" / "kinova" / "make_episodes.py"
_SPEC = importlib.util.spec_from_file_location("kinova_episodes", SCRIPT)
assert _SPEC is not None
assert _SPEC.loader is not None
episodes = importlib.util.module_from_spec(_SPEC)
sys.modules[_SPEC.name] = episodes
_SPEC.loader.exec_module(episodes)
