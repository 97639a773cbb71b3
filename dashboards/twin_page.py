"""What the twin page shows: held-out views, recorded beside rendered."""

import shlex
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import DEPTH_IMAGE
from bridge.errors import GstError
from dashboards.comparison import Judgement
from dashboards.errors import NotHereError
from dashboards.frames import RENDERED, camera_tracks, read_frame
from dashboards.library import episode_path
from evaluator.result import Measurement

MOST_FILES = 100
"""Recordings that are looked at."""
FIRST = tuple(
    f"views.all.{name}" for name in ("psnr_db", "psnr_gain_db", "ssim", "depth_median_abs_m")
)


@dataclass(frozen=True, kw_only=True)
class HeldOutView:
    """One recorded image with its rendering; the scores are the evaluator's."""

    file: str
    camera: str
    stamp_ns: int
    after_s: float
    """Since the first of its file."""
    psnr_db: float | None
    ssim: float | None


@dataclass(frozen=True, kw_only=True)
class TwinPage:
    """Everything the twin template needs."""

    files: tuple[str, ...]
    views: tuple[HeldOutView, ...]
    rated: bool
    first: tuple[Measurement, ...]
    """The numbers to read first."""
    problems: tuple[str, ...]
    next_command: str
    """Empty where no recording has depth."""


def build_twin(run: RunFolder, judgement: Judgement) -> TwinPage:
    """Gather the held-out views of a run, worst first where the results rate them.

    Args:
        judgement: Its numbers; without them the views are sorted by time.
    """
    views: list[HeldOutView] = []
    problems = []
    rated = {(v["file"], v["camera"], v["stamp_ns"]): v for v in judgement.about["views"]}
    paths = run.derived("*.views.*")
    for file in paths:
        try:
            views += _views(file, rated)
        except GstError as error:
            problems.append(str(error))
    path = shlex.quote(str(run.path))
    views.sort(key=lambda v: (v.psnr_db is None, v.psnr_db or 0.0, v.stamp_ns))
    return TwinPage(
        files=tuple(path.name for path in paths),
        views=tuple(views),
        rated=any(view.psnr_db is not None for view in views),
        first=tuple(m for m in judgement.measurements if m.id in FIRST),
        problems=tuple(problems),
        next_command=f"robot-gst rebuild {path}" if any_recorded(run, has_depth) else "",
    )


def any_recorded(run: RunFolder, holds: Callable[[Episode], Any]) -> bool:
    """Whether something holds of any of the first recordings."""
    for path in run.episodes()[:MOST_FILES]:
        with suppress(GstError):  # its own page says what is wrong
            if holds(Episode.open(path)):
                return True
    return False


def has_depth(episode: Episode) -> bool:
    """Whether a camera recorded depth: without it a scene can be made of moving cameras only."""
    return any(topic.endswith(DEPTH_IMAGE) for topic in episode.topics())


def _views(path: Path, rated: Mapping[tuple[Any, ...], Mapping[str, Any]]) -> list[HeldOutView]:
    tracks = camera_tracks(path)
    views = []
    drawn = {name: track for name, track in tracks.items() if name.startswith(RENDERED)}
    first_ns = min((track.stamps_ns[0] for track in drawn.values()), default=0)
    for name, track in drawn.items():
        camera_id = name.removeprefix(RENDERED)
        for stamp_ns in track.stamps_ns:
            rating = rated.get((path.name, camera_id, stamp_ns), {})
            views.append(
                HeldOutView(
                    file=path.name,
                    camera=camera_id,
                    stamp_ns=stamp_ns,
                    after_s=1e-9 * (stamp_ns - first_ns),
                    psnr_db=rating.get("psnr_db"),
                    ssim=rating.get("ssim"),
                )
            )
    return views


def _source_of(run: RunFolder, path: Path) -> Path | None:
    """Return the recorded episode a views episode was made from, where it is still there."""
    derived = Episode.open(path).derived
    try:
        return None if derived is None else episode_path(run, derived.source_episode)
    except NotHereError:
        return None


def view_image(
    run: RunFolder, path: Path, side: str, camera_id: str, stamp_ns: int
) -> tuple[bytes, str]:
    """Return the recorded or the rendered image of one held-out view.

    Args:
        stamp_ns: Source time of the view [ns].
    """
    if side == "rendered":
        return read_frame(path, RENDERED + camera_id, stamp_ns)
    if side != "recorded":
        message = f"side {side!r} is neither recorded nor rendered."
        raise NotHereError(message)
    holder: Path | None = path
    if camera_id not in camera_tracks(path):
        holder = _source_of(run, path)
    if holder is None:
        message = f"the recording that {path.name} was made from is not in this run."
        raise NotHereError(message)
    return read_frame(holder, camera_id, stamp_ns)
