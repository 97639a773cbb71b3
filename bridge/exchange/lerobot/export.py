"""A run's trials as one LeRobotDataset v3.0."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int, UInt8

from bridge.episode.catalogue import outcome_of
from bridge.episode.reader import Episode
from bridge.episode.run import RunFolder
from bridge.errors import EpisodeError, UsageError
from bridge.exchange.lerobot import layout
from bridge.exchange.lerobot.card import card_text
from bridge.exchange.lerobot.config import LeRobotConfig
from bridge.exchange.lerobot.sampling import (
    ActionKind,
    Samples,
    choose_fps,
    row_images,
    sample,
)
from bridge.exchange.lerobot.writer import DatasetShape, DatasetWriter
from bridge.exchange.output import new_folder, safe_names, write_note
from bridge.terminal import Advance

KINDS = ("trial", "imported")
"""What is exported unless episodes are named: scans and probes are no demonstrations."""


@dataclass(frozen=True, kw_only=True)
class ExportReport:
    """What was written."""

    episodes: int
    frames: int
    fps: int
    action: ActionKind
    labelled: bool
    left_out: tuple[str, ...]
    """Episodes of other kinds."""
    max_image_offset_ns: int


def select_episodes(source: Path, config: LeRobotConfig) -> tuple[list[Path], list[str]]:
    """Return the files to export and the ids left out because they are no demonstrations.

    Raises:
        UsageError: When nothing is left, or a named episode is not there.
    """
    if not source.is_dir():
        return [source], []
    files = {path.stem: path for path in RunFolder.open(source).episodes()}
    if config.episodes:
        absent = [name for name in config.episodes if name not in files]
        if absent:
            message = (
                f"{source} has no episode {', '.join(absent)}. "
                f"There are: {', '.join(list(files)[:10]) or 'none'}."
            )
            raise UsageError(message)
        return [files[name] for name in config.episodes], []
    kinds = {name: Episode.open(path).info.kind for name, path in files.items()}
    chosen = [files[name] for name, kind in kinds.items() if kind in KINDS]
    left_out = [name for name, kind in kinds.items() if kind not in KINDS]
    if not chosen:
        message = (
            f"{source} has no trial to export ({len(left_out)} episodes of other kinds). "
            "Name episodes with --episodes ID to export them all the same."
        )
        raise UsageError(message)
    return chosen, left_out


def export_lerobot(
    source: Path, out: Path, *, config: LeRobotConfig, force: bool, advance: Advance
) -> ExportReport:
    """Write the dataset.

    Args:
        source: A run folder, or one episode file.
        out: The folder to make.
        config: Rate, actions, which episodes.
        force: Replace an earlier export.
        advance: Told how many episodes are done; each counts twice, once for looking at it.

    Raises:
        EpisodeError: When an episode lacks joints, or differs from the first in joints or cameras.
        UsageError: When there is nothing to export, or ``out`` may not be replaced.
    """
    files, left_out = select_episodes(source, config)
    run = RunFolder(source) if source.is_dir() else None
    with new_folder(out, force=force) as folder:
        layout.parquet()  # says what is missing before the long look
        first = Episode.open(files[0])
        fps = config.fps or choose_fps(first)
        success = [_success(run, Episode.open(path)) for path in files]
        kind, sizes = _look(files, fps, config, advance)
        cameras = safe_names(sizes)
        shape = DatasetShape(
            fps=fps,
            names=sample(first, fps).names,
            cameras={safe: sizes[camera] for camera, safe in cameras.items()},
            robot_type=first.info.robot or first.info.cell,
            labelled=None not in success,
            crf=config.crf,
        )
        writer = DatasetWriter(folder, shape)
        try:
            table = []
            for row in _add_all(writer, files, success, kind, cameras, shape):
                table.append(row)
                advance(len(files) + len(table), str(row["id"]))
            writer.close()
        except BaseException:
            writer.abandon()
            raise
        _write_about(folder, files, shape, kind, table)
    return ExportReport(
        episodes=len(files),
        frames=sum(row["frames"] for row in table),
        fps=fps,
        action=kind,
        labelled=shape.labelled,
        left_out=tuple(left_out),
        max_image_offset_ns=max(
            (offset for row in table for offset in row["max_image_offset_ns"].values()), default=0
        ),
    )


def _add_all(
    writer: DatasetWriter,
    files: Sequence[Path],
    success: Sequence[bool | None],
    kind: ActionKind,
    cameras: dict[str, str],
    shape: DatasetShape,
) -> Iterator[dict[str, Any]]:
    """Write one episode after another; yields what there is to say of each."""
    for number, path in enumerate(files):
        episode = Episode.open(path)
        samples = sample(episode, shape.fps)
        writer.add(
            task=_task(episode),
            state=samples.state,
            action=samples.action(kind),
            success=success[number],
            images={
                safe: _images(episode, camera, samples.images[camera], shape.cameras[safe])
                for camera, safe in cameras.items()
            },
        )
        yield _row(number, episode, samples, success[number])


def _look(
    files: Sequence[Path], fps: int, config: LeRobotConfig, advance: Advance
) -> tuple[ActionKind, dict[str, tuple[int, int]]]:
    """Check that all episodes agree before anything is written; decide what the actions are."""
    names: tuple[str, ...] = ()
    sizes: dict[str, tuple[int, int]] = {}
    without_plan: list[Path] = []
    for number, path in enumerate(files):
        episode = Episode.open(path)
        samples = sample(episode, fps)
        found = {camera: _size(episode, camera, samples) for camera in samples.images}
        if number == 0:
            names, sizes = samples.names, found
        if (samples.names, found) != (names, sizes):
            raise EpisodeError(
                path=path,
                found=f"joints {', '.join(samples.names)} and cameras {_words(found)}, but "
                f"{files[0].name} has {', '.join(names)} and {_words(sizes)}",
                hint="One dataset has one robot and one set of cameras; choose with --episodes.",
            )
        if samples.command is None:
            without_plan.append(path)
        advance(number + 1, path.stem)
    if config.action == "next-state" or (config.action == "auto" and without_plan):
        return "next_state", sizes
    if without_plan:
        raise EpisodeError(
            path=without_plan[0],
            found="no executed plan that says every joint and the gripper's width",
            hint="Leave --action plan out; the next state is the action then.",
        )
    return "plan", sizes


def _words(sizes: dict[str, tuple[int, int]]) -> str:
    return ", ".join(f"{name} {w}x{h}" for name, (h, w) in sizes.items()) or "none"


def _size(episode: Episode, camera: str, samples: Samples) -> tuple[int, int]:
    image_u8 = next(row_images(episode, camera, samples.images[camera][:1]))
    return image_u8.shape[0], image_u8.shape[1]


def _images(
    episode: Episode, camera: str, wanted: Int[np.ndarray, " num_rows"], size: tuple[int, int]
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    for row, image_u8 in enumerate(row_images(episode, camera, wanted)):
        if image_u8.shape[:2] != size:
            raise EpisodeError(
                path=episode.path,
                found=f"camera {camera}, row {row}: {image_u8.shape[1]} x {image_u8.shape[0]} "
                f"pixels, before {size[1]} x {size[0]}",
                hint="A video has one size; leave the episode out.",
            )
        yield image_u8


def _success(run: RunFolder | None, episode: Episode) -> bool | None:
    outcome = episode.outcome if run is None else outcome_of(run, episode)
    return {"success": True, "failure": False}.get(outcome.result if outcome else "")


def _task(episode: Episode) -> str:
    info = episode.info
    return info.instruction or info.task.replace("_", " ") or "not named"


def _row(number: int, episode: Episode, samples: Samples, success: bool | None) -> dict[str, Any]:
    return {
        "episode_index": number,
        "id": episode.info.id,
        "start_ns": int(samples.stamps_ns[0]),
        "frames": len(samples.stamps_ns),
        "success": success,
        "stand_in": episode.info.stand_in,
        "max_image_offset_ns": samples.max_image_offset_ns,
    }


def _write_about(
    folder: Path,
    files: list[Path],
    shape: DatasetShape,
    kind: ActionKind,
    table: list[dict[str, Any]],
) -> None:
    choices = {
        "format": f"LeRobotDataset {layout.VERSION}",
        "action": kind,
        "left_out": ["depth: the format's videos hold 8-bit colour"],
        "episodes": table,
    }
    write_note(folder, made_by="export lerobot", sources=files, choices=choices)
    (folder / "README.md").write_text(card_text(shape, kind, table), encoding="utf-8")
