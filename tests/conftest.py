"""Settings for all tests."""

import os

from hypothesis import settings

# Time limits of single examples say more about the machine's other work than about the code.
settings.register_profile("robot-gst", deadline=None)
settings.load_profile("robot-gst")

# Workers side by side share the cores; nested threads would only get in each other's way.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
