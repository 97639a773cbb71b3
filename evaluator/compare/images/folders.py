"""Folders of images, read strictly: what cannot be compared is refused with what to do about it.

A view is named by its path inside the folder without the ending: ``wrist/0001``. What a decoder
would quietly change (16 bits to 8, transparency, grey to colour) is looked for in the file itself.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from bridge.errors import BridgeError, PathNotFoundError
from bridge.media.color import JPEG_MAGIC, open_image
from evaluator.errors import EvaluatorError

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
READ = (".png", ".jpg", ".jpeg")
WANTED = "Wanted: 8-bit RGB as PNG or JPEG"
_REFUSED = {
    "L": "is grey, without colours",
    "LA": "is grey, without colours",
    "CMYK": "holds printing colours (CMYK)",
}
"""Modes of Pillow that are not looked at further."""


class ImageRefusedError(EvaluatorError):
    """An image cannot be compared as it is stored."""

    def __init__(self, *, name: str, found: str) -> None:
        """Remember what was found."""
        self.found = found
        super().__init__(f"{name} {found}. {WANTED}.")


@dataclass(frozen=True, kw_only=True)
class ImageSet:
    """Images by the names of their views, not loaded yet."""

    name: str
    """Of the method, or of the reference."""
    where: str
    """Folder or episode, for messages."""
    load: Mapping[str, Callable[[], np.ndarray]]
    """Gives (height, width, 3) of uint8, or raises a ``GstError``."""
    stored: str
    """For the protocol."""


def folder_set(name: str, folder: Path) -> ImageSet:
    """List the images of a folder and its subfolders.

    Raises:
        EvaluatorError: When it holds no image, or two of one name.
    """
    if not folder.is_dir():
        raise PathNotFoundError(path=folder, what="folder of images", hint="Name a folder.")
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        relative = path.relative_to(folder)
        hidden = any(part.startswith(".") for part in relative.parts)
        if not hidden and path.suffix.lower() in READ and path.is_file():
            view = relative.with_suffix("").as_posix()
            if view in found:
                message = f"{folder} has {found[view].name} and {path.name}; keep one of them."
                raise EvaluatorError(message)
            found[view] = path
    if not found:
        message = f"{folder} holds no image. {WANTED}."
        raise EvaluatorError(message)
    endings = sorted({path.suffix.lower().lstrip(".") for path in found.values()})
    return ImageSet(
        name=name,
        where=str(folder),
        load={view: partial(read_image, path) for view, path in found.items()},
        stored=f"stored as {', '.join(endings)}",
    )


def read_image(path: Path) -> np.ndarray:
    """Read one image of shape (height, width, 3) and 8 bits.

    Raises:
        ImageRefusedError: When it is not what can be compared; the message says what it is.
    """
    refused = partial(ImageRefusedError, name=path.name)
    try:
        data = path.read_bytes()
        if not data.startswith((PNG_MAGIC, JPEG_MAGIC)):
            raise refused(found="is neither PNG nor JPEG inside")
        # Pillow reads 16-bit colour as 8 bits without a word; the header says which it is.
        if data.startswith(PNG_MAGIC) and data[24:25] == b"\x10":
            raise refused(found="has 16 bits for each channel")
        with open_image(data) as image:
            if image.mode in _REFUSED:
                raise refused(found=_REFUSED[image.mode])
            if image.mode not in ("RGBA", "PA") and "transparency" not in image.info:
                return np.asarray(image.convert("RGB"))
            pixels = np.asarray(image.convert("RGBA"))
    except BridgeError as error:
        raise refused(found=f"cannot be read ({error})") from error
    except OSError as error:
        raise refused(found=f"cannot be read ({error.strerror or error})") from error
    if (pixels[..., 3] < 255).any():
        raise refused(found="has transparency; draw it over the background that the reference has")
    return np.ascontiguousarray(pixels[..., :3])
