"""The zenoh library, or one sentence on how to get it."""

import os

from bridge.errors import MissingDependencyError

NETWORK_THREADS = "(rx: (worker_threads: 1), acc: (handover: rx))"
"""One thread both waits for the network and reads it (zenoh's ``ZENOH_RUNTIME``).

As zenoh comes, every message wakes one thread that waits and two that read. Our callbacks take
turns in Python anyway, so more readers bring nothing: one costs a tenth of a core less while
recording (``docs/decisions/0014-what-the-recorder-takes-in.md``)."""

os.environ.setdefault("ZENOH_RUNTIME", NETWORK_THREADS)  # read when the first session opens

try:
    import zenoh as zenoh
    from zenoh import shm as zenoh_shm
except ImportError as import_error:  # pragma: no cover  # needs an environment without zenoh
    raise MissingDependencyError(
        package="eclipse-zenoh", extra="record", purpose="talking to a cell"
    ) from import_error

__all__ = ["zenoh", "zenoh_shm"]
