"""What one image metric is called and means."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ImageMetric:
    """One named number about a pair of images."""

    id: str
    """Part of the ids in ``results.json``."""
    column: str
    """Head of its column in a table."""
    unit: str = "1"
    definition: str
    """With its source."""
    implementation: str
    """Module and version; the version rises whenever a value may change."""
    values: str = "sRGB, data range 0..1"
    """What the metric is given, for a stamp."""
    window: str = "none"
    padding: str = "none"
    higher_is_better: bool = True
    by_pixel: bool = True
    """Whether it can be restricted to the pixels of a mask."""

    def named(self, variant: str) -> str:
        """Return the id of this metric for one variant: ``psnr_gain_db`` for psnr_db and gain."""
        if variant == "raw":
            return self.id
        if self.id.endswith("_db"):
            return f"{self.id.removesuffix('_db')}_{variant}_db"
        return f"{self.id}_{variant}"
