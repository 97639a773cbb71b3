"""Open an adapter by what was written on the command line: ``sam3:FOLDER``, ``dinov3:FOLDER``."""

from pathlib import Path

from bridge.errors import UsageError
from twin.scene.foundation.clip import ClipEmbedder
from twin.scene.foundation.dinov3 import DinoFeatures
from twin.scene.foundation.loading import Placement
from twin.scene.foundation.sam3 import Sam3Config, Sam3Segmenter

SEGMENTERS = ("sam3",)
FEATURES = ("dinov3",)


def split_spec(spec: str, option: str, known: tuple[str, ...]) -> tuple[str, Path]:
    """Split ``name:folder``.

    Raises:
        UsageError: When the name is none of those known, or the folder is missing.
    """
    name, colon, folder = spec.partition(":")
    if name not in known or not colon or not folder:
        forms = ", ".join(f"{each}:FOLDER" for each in known)
        message = f"{option} {spec!r} is not understood; write {forms}."
        raise UsageError(message)
    return name, Path(folder).expanduser()


def open_segmenter(
    spec: str, placement: Placement | None = None, config: Sam3Config | None = None
) -> Sam3Segmenter:
    """Open the 2D segmenter of ``--segmenter``.

    Raises:
        UsageError: When the specification or the folder cannot be used.
        MissingDependencyError: When the extra ``foundation`` is not installed.
    """
    _, folder = split_spec(spec, "--segmenter", SEGMENTERS)
    return Sam3Segmenter.load(folder, placement, config)


def open_features(spec: str, placement: Placement | None = None) -> DinoFeatures:
    """Open the source of feature maps of ``--features``.

    Raises:
        UsageError: When the specification or the folder cannot be used.
        MissingDependencyError: When the extra ``foundation`` is not installed.
    """
    _, folder = split_spec(spec, "--features", FEATURES)
    return DinoFeatures.load(folder, placement)


def open_clip(folder: Path, placement: Placement | None = None) -> ClipEmbedder:
    """Open the embeddings of ``--clip``.

    Raises:
        UsageError: When the folder cannot be used.
        MissingDependencyError: When the extra ``foundation`` is not installed.
    """
    return ClipEmbedder.load(folder.expanduser(), placement)
