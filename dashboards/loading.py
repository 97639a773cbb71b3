"""One thread at a time loads what only some pages need.

A thread that imports a package waits for its modules; one that imports a module first waits for
the package. Python ends such a wait by letting one of them go on with half a module.
"""

import threading

LOADING = threading.RLock()
"""Held around each import that a request, or the thread that asks ahead, may be first to make."""
