"""The one place that imports pyrealsense2."""

from bridge.errors import MissingDependencyError

try:
    import pyrealsense2 as rs
except ImportError as import_error:  # pragma: no cover  # needs an environment without it
    raise MissingDependencyError(
        package="pyrealsense2", extra="realsense", purpose="talking to a RealSense camera"
    ) from import_error

__all__ = ["rs"]
