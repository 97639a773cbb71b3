"""What ``evaluate`` is told about images: methods to compare, masks, and backbones of LPIPS."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from bridge.errors import UsageError
from evaluator.metrics.stamp import UNSTATED

NetName = Literal["vgg", "alex"]


@dataclass(frozen=True, kw_only=True)
class ImageOptions:
    """Images to score, and what is needed for it."""

    renders: tuple[str, ...] = ()
    """METHOD=FOLDER of renders named as the reference; once for each method to compare."""
    reference: Path | None = None
    """Folder of recorded images; the recorded side of the run's held-out views without it."""
    masks: Path | None = None
    """Folder of masks named as the reference, white inside; all is scored under them too."""
    split: str = UNSTATED
    """Which images were held out, for the stamp: "every 8th frame". A run says so itself."""
    lpips_vgg: Path | None = None
    """State dict of torchvision's VGG16 (safetensors or torch); makes LPIPS with VGG."""
    lpips_alex: Path | None = None
    """State dict of torchvision's AlexNet (safetensors or torch); makes LPIPS with AlexNet."""

    @property
    def backbones(self) -> dict[NetName, Path]:
        """The backbones that were given."""
        found: dict[NetName, Path | None] = {"vgg": self.lpips_vgg, "alex": self.lpips_alex}
        return {net: path for net, path in found.items() if path is not None}

    def refuse_unused(self) -> None:
        """Refuse settings that nothing would be compared with.

        Raises:
            UsageError: When there is a reference, a mask or a split without any renders.
        """
        if not self.renders and (self.reference or self.masks or self.split != UNSTATED):
            message = "--reference, --masks and --split belong to --renders METHOD=FOLDER."
            raise UsageError(message)

    def methods(self) -> dict[str, Path]:
        """Return the folders of renders by method; a folder alone is named after itself.

        Raises:
            UsageError: For a name twice, or none.
        """
        found: dict[str, Path] = {}
        for text in self.renders:
            name, equals, folder = text.partition("=")
            name, folder = (name.strip(), folder) if equals else (Path(text).name, text)
            if not name or not folder.strip():
                message = f"--renders {text!r} names no method or no folder; write METHOD=FOLDER."
                raise UsageError(message)
            if name in found:
                message = f"--renders has two methods called {name}; give each its own name."
                raise UsageError(message)
            found[name] = Path(folder)
        return found
