"""The zenoh library, or one sentence on how to get it."""

from bridge.errors import MissingDependencyError

try:
    import zenoh as zenoh
    from zenoh import shm as zenoh_shm
except ImportError as import_error:  # pragma: no cover  # needs an environment without zenoh
    raise MissingDependencyError(
        package="eclipse-zenoh", extra="record", purpose="talking to a cell"
    ) from import_error

__all__ = ["zenoh", "zenoh_shm"]
