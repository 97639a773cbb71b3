"""Which images are compared, as ``evaluate`` is asked."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from bridge.errors import UsageError
from bridge.terminal import RARE

UNSTATED = "not stated"
"""Said of a protocol where its source does not say it."""


@dataclass(frozen=True, kw_only=True)
class ImageOptions:
    """Images to score, and what is needed for it."""

    renders: tuple[str, ...] = ()
    """METHOD=FOLDER of renders named as the reference; once for each method to compare."""
    reference: Path | None = None
    """Folder of recorded images; the recorded side of the run's held-out views without it."""
    split: Annotated[str, RARE] = UNSTATED
    """Which images were held out: "every 8th frame". A run says so itself."""
    lpips_vgg: Annotated[Path | None, RARE] = None
    """State dict of torchvision's VGG16 (safetensors or torch); makes LPIPS."""

    def origin(self) -> dict[str, Any]:
        """Say where the images are, for a page that shows them; nothing without renders."""
        if not self.renders:
            return {}
        reference = None if self.reference is None else str(self.reference.resolve())
        methods = {name: str(folder.resolve()) for name, folder in self.methods().items()}
        return {"reference": reference, "methods": methods}

    def refuse_unused(self) -> None:
        """Refuse a reference or a split without any renders: nothing would be compared with it."""
        if not self.renders and (self.reference or self.split != UNSTATED):
            raise UsageError("--reference and --split belong to --renders METHOD=FOLDER.")

    def methods(self) -> dict[str, Path]:
        """Return the folders of renders by method; a folder alone is named after itself."""
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
