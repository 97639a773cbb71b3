"""How an RGB-D folder is turned into messages. Imports nothing heavy."""

from dataclasses import dataclass
from pathlib import Path

from bridge.episode.topics import refuse_bad_name
from bridge.errors import UsageError, refuse_outside


class FolderError(UsageError):
    """An RGB-D folder breaks its contract."""

    def __init__(self, *, path: Path, found: str, hint: str = "Restore the file.") -> None:
        """Name the file and what was found in it."""
        super().__init__(f"{path}: {found}. {hint}")


DEFAULT_RATE_HZ = 30.0


@dataclass(frozen=True, kw_only=True)
class FolderConfig:
    """How a folder is turned into messages."""

    cell: str = "kitchen"
    """Name of the cell in topics: /CELL/cam/CAMERA/color/image."""
    camera: str = "kinect"
    """Name of the camera in topics and frames."""
    rate_hz: float | None = None
    """Frames per second of a folder without times, 30 if not given; real times are kept."""
    depth_intrinsics: tuple[float, float, float, float] | None = None
    """FX FY CX CY of the depth camera [px, OpenCV]; not for scene.json, which holds its own."""
    color_intrinsics: tuple[float, float, float, float] | None = None
    """FX FY CX CY of a colour camera that is not registered to depth."""
    depth_unit_m: float | None = None
    """Metres per stored number, where the layout's own (TUM 1/5000, 7-Scenes 1/1000) is wrong."""

    def __post_init__(self) -> None:
        """Refuse names that cannot be part of a topic, and numbers that make no sense."""
        for what, name in (("cell", self.cell), ("camera", self.camera)):
            refuse_bad_name(what, name)
        refuse_outside(self, {"rate_hz": (0.001, 1000), "depth_unit_m": (1e-6, 1)})
        for option in ("depth_intrinsics", "color_intrinsics"):
            values = getattr(self, option)
            if values is not None and not min(values[:2]) > 0:
                name = option.replace("_", "-")
                raise UsageError(f"--{name} {values}: focal lengths FX and FY are above zero.")
