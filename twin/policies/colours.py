"""The light of the trials, where it is another than when the scene was scanned.

One gain for each camera and colour brings the twin's pictures to it. The gains come from other
trials than the one that is rolled out, so no picture that is judged against is copied. Noise, blur,
an affine map of the colours, and the recorded background brought a policy's actions hardly nearer
to those on recorded pictures than gains alone do (docs/policies.md).
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from twin.policies.gap import recorded_states
from twin.policies.starts import trial_episodes
from twin.policies.views import Gains

TRIALS, INSTANTS = 4, 2
"""So many trials teach it, the nearest in time, by so many pictures of each camera."""
BLOCK_PX = 8
DARK, BRIGHT = 25, 250
"""Darker blocks say little of a gain, and brighter pixels are cut off."""
LEAST = 100
"""Fewer blocks say nothing."""
SAME = 0.03
"""A light that differs by less is the same."""


def gains_of(run: RunFolder, episode: Episode, cameras: Sequence[str]) -> Gains:
    """How much brighter the trials are than the twin, by camera; empty where the light is the same.

    Args:
        episode: It teaches nothing.
    """
    others = [each for each in _trials(run.path) if each.info.id != episode.info.id]
    others.sort(key=lambda each: abs(each.start_ns - episode.start_ns))
    taught = [_ratios(run.path, each.path, tuple(cameras)) for each in others[:TRIALS]]
    nothing = np.zeros((0, 3))
    found: dict[str, tuple[float, float, float]] = {}
    for name in cameras:
        rows = np.concatenate([ratios[name] for ratios in taught if name in ratios] or [nothing])
        if len(rows) >= LEAST:
            red, green, blue = np.median(rows, axis=0).round(3).tolist()
            found[name] = (red, green, blue)
    return found if any(abs(x - 1) > SAME for gain in found.values() for x in gain) else {}


@cache
def _trials(run_path: Path) -> Sequence[Episode]:
    """One of each start."""
    return trial_episodes(RunFolder.open(run_path), "")


@cache
def _ratios(
    run_path: Path, episode_path: Path, cameras: tuple[str, ...]
) -> Mapping[str, Float[np.ndarray, "num_blocks 3"]]:
    """Recorded over drawn colours of a trial; empty where it cannot be drawn."""
    found: dict[str, list[np.ndarray]] = {}
    with suppress(GstError):
        run, episode = RunFolder.open(run_path), Episode.open(episode_path)
        for state in recorded_states(run, episode, cameras, INSTANTS):
            for name in cameras:
                recorded, drawn = _blocks(state.recorded[name]), _blocks(state.rendered[name])
                clear = (recorded.max((1, 3)) < BRIGHT) & (drawn.mean((1, 3)) > DARK)
                ratio = recorded.mean((1, 3)) / np.maximum(drawn.mean((1, 3)), 1.0)
                found.setdefault(name, []).append(ratio[clear.all(axis=-1)])
    return {name: np.concatenate(rows) for name, rows in found.items()}


def _blocks(image_u8: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "..."]:
    """Pixels by block: rows of blocks, rows, blocks in a row, columns, colours."""
    rows, columns = image_u8.shape[0] // BLOCK_PX, image_u8.shape[1] // BLOCK_PX
    whole = image_u8[: rows * BLOCK_PX, : columns * BLOCK_PX].astype(np.float64)
    return whole.reshape(rows, BLOCK_PX, columns, BLOCK_PX, 3)
