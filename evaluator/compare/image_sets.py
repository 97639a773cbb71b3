"""Folders of images, read strictly: what cannot be compared is refused with what to do about it.

A view is named by its path inside the folder without the ending: ``wrist/0001``. What a decoder
would quietly change (16 bits to 8, transparency, grey to colour) is looked for in the file itself.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from bridge.errors import BridgeError, PathNotFoundError
from bridge.media.color import JPEG_MAGIC, MAX_PIXELS, decode_color, open_image
from evaluator.errors import EvaluatorError

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
READ = (".png", ".jpg", ".jpeg", ".npy")
NOT_READ = {
    ".exr": "high dynamic range",
    ".hdr": "high dynamic range",
    ".pfm": "high dynamic range",
    ".tif": "TIFF",
    ".tiff": "TIFF",
    ".bmp": "BMP",
    ".webp": "WebP",
    ".npz": "an archive of arrays",
}
"""Images we do not read, named rather than passed over."""
WANTED = "Wanted: 8-bit RGB as PNG or JPEG, or arrays (height, width, 3) of uint8 or 0..1 floats"


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
    """Gives (height, width, 3), uint8 or float in 0..1, or raises a ``GstError``."""
    refused: Mapping[str, str] = field(default_factory=dict)
    """Views whose image is there and cannot be read at all, with the reason."""
    stored: str
    """For the stamp."""


def folder_set(name: str, folder: Path) -> ImageSet:
    """List the images of a folder and its subfolders.

    Raises:
        PathNotFoundError: When there is no such folder.
        EvaluatorError: When it holds no image.
    """
    if not folder.is_dir():
        raise PathNotFoundError(path=folder, what="folder of images", hint="Name a folder.")
    found = list_files(folder)
    refused = {
        view: str(ImageRefusedError(name=paths[0].name, found=f"is {NOT_READ[_ending(paths[0])]}"))
        for view, paths in list_files(folder, tuple(NOT_READ)).items()
        if view not in found
    }
    for view, paths in found.items():
        if len(paths) > 1:
            names = " and ".join(path.name for path in paths)
            refused[view] = f"two images of one name ({names}); keep one of them"
    load = {view: partial(read_image, paths[0]) for view, paths in found.items()}
    load = {view: call for view, call in load.items() if view not in refused}
    if not load and not refused:
        message = f"{folder} holds no image. {WANTED}."
        raise EvaluatorError(message)
    endings = sorted({_ending(paths[0]).lstrip(".") for paths in found.values()})
    return ImageSet(
        name=name,
        where=str(folder),
        load=load,
        refused={view: reason for view, reason in refused.items() if view not in load},
        stored=f"stored as {', '.join(endings)}" if endings else "stored in no known way",
    )


def list_files(folder: Path, endings: tuple[str, ...] = READ) -> dict[str, list[Path]]:
    """Return the files with certain endings by view; hidden ones are nobody's images."""
    found: dict[str, list[Path]] = {}
    for path in sorted(folder.rglob("*")):
        relative = path.relative_to(folder)
        hidden = any(part.startswith(".") for part in relative.parts)
        if not hidden and _ending(path) in endings and path.is_file():
            found.setdefault(relative.with_suffix("").as_posix(), []).append(path)
    return found


def _ending(path: Path) -> str:
    return path.suffix.lower()


def read_image(path: Path) -> np.ndarray:
    """Read one image of shape (height, width, 3), uint8 or float in 0..1.

    Raises:
        ImageRefusedError: When it is not what can be compared; the message says what it is.
    """
    try:
        if path.suffix.lower() == ".npy":
            return _read_array(path)
        data = path.read_bytes()
        if data.startswith(PNG_MAGIC):
            return _read_png(path.name, data)
        if data.startswith(JPEG_MAGIC):
            return _read_jpeg(path.name, data)
    except BridgeError as error:
        raise ImageRefusedError(name=path.name, found=f"cannot be read ({error})") from error
    except OSError as error:
        found = f"cannot be read ({error.strerror or error})"
        raise ImageRefusedError(name=path.name, found=found) from error
    raise ImageRefusedError(name=path.name, found="is neither PNG nor JPEG inside")


def read_mask(path: Path) -> Bool[np.ndarray, "height width"]:
    """Read a mask: white is inside; grey or colour, PNG or JPEG.

    Raises:
        ImageRefusedError: When it cannot be read.
    """
    try:
        return np.asarray(decode_color(path.read_bytes())[..., 0] > 127)
    except (BridgeError, OSError) as error:
        found = f"cannot be read as a mask ({error})"
        raise ImageRefusedError(name=path.name, found=found) from error


def _read_png(name: str, data: bytes) -> np.ndarray:
    # Pillow reads 16-bit colour as 8 bits without a word; the header says which it is.
    depth, kind = data[24:25], data[25:26]
    if depth == b"\x10":
        raise ImageRefusedError(name=name, found="has 16 bits for each channel")
    if kind in (b"\x00", b"\x04"):
        raise ImageRefusedError(name=name, found="is grey, without colours")
    with open_image(data) as image:
        if image.mode not in ("RGBA", "PA", "LA") and "transparency" not in image.info:
            return np.asarray(image.convert("RGB"))
        pixels = np.asarray(image.convert("RGBA"))
    if (pixels[..., 3] < 255).any():
        found = "has transparency; draw it over the background that the reference has"
        raise ImageRefusedError(name=name, found=found)
    return np.ascontiguousarray(pixels[..., :3])


def _read_jpeg(name: str, data: bytes) -> np.ndarray:
    with open_image(data) as image:
        mode = image.mode
    if mode != "RGB":
        words = {"L": "is grey, without colours", "CMYK": "holds printing colours (CMYK)"}
        raise ImageRefusedError(name=name, found=words.get(mode, f"holds {mode} and no RGB"))
    return decode_color(data)


def _read_array(path: Path) -> np.ndarray:
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise ImageRefusedError(
            name=path.name, found="is not an array of numbers in NumPy's format"
        ) from error
    if not isinstance(array, np.ndarray):
        raise ImageRefusedError(name=path.name, found="is an archive of arrays")
    found = _wrong_shape(array.shape)
    if not found and array.size > 3 * MAX_PIXELS:
        found = f"has {array.shape[0]} x {array.shape[1]} pixels, more than a camera"
    if not found and array.dtype != np.uint8 and array.dtype.kind != "f":
        bits = 8 * array.dtype.itemsize
        found = f"holds {array.dtype} values of {bits} bits, whose white nobody has said"
    if found:
        raise ImageRefusedError(name=path.name, found=found)
    if array.dtype == np.uint8:
        return np.array(array)
    values = np.array(array, dtype=np.float64)
    if not np.isfinite(values).all():
        count = int((~np.isfinite(values)).sum())
        raise ImageRefusedError(name=path.name, found=f"holds {count} values that are not finite")
    low, high = float(values.min()), float(values.max())
    if low < 0 or high > 1:
        found = (
            f"holds values from {low:.3g} to {high:.3g}, outside 0..1 (high dynamic range, or not "
            "clamped); clamp or tone-map it as the method's own evaluation does"
        )
        raise ImageRefusedError(name=path.name, found=found)
    return values


def _wrong_shape(shape: tuple[int, ...]) -> str:
    if len(shape) == 3 and shape[2] == 3 and min(shape) > 0:
        return ""
    if len(shape) == 3 and shape[2] == 4:
        return "has four channels; draw it over the background and drop the transparency"
    if len(shape) == 3 and shape[0] == 3:
        return f"has its channels first, as {shape}; transpose it to (height, width, 3)"
    return f"has shape {shape}"
