"""Recorded beside twin around the moment of a trial: one picture, a short clip, or a strip."""

import hashlib
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import UInt8

from bridge.clock import NS_PER_S
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.media.color import encode_jpeg
from bridge.whole_file import write_whole
from dashboards.errors import NotHereError
from dashboards.frames import RENDERED, camera_tracks, main_camera, read_span
from dashboards.library import derived_paths, episode_path
from dashboards.loading import LOADING
from dashboards.moments import moment_of, recorded_ns
from evaluator.review_index import stamp_of
from evaluator.trial_row import TrialRow

Image = UInt8[np.ndarray, "height width 3"]
PICTURES, CLIPS = "pairs", "clips"
"""Folders in the run's ``results/``."""
GAP_PX = 4
"""Between recorded and twin."""
APART_S = 0.15
"""A picture of the twin stands for no instant farther away than this."""
NOTHING_U8 = 40
"""Grey where the twin has no picture."""
KEYFRAME_EVERY = 30
SUBSAMPLING = "420"
"""Of small pictures: colour half as fine as brightness, as in the videos."""
_DRAWING = threading.Lock()


@dataclass(frozen=True, kw_only=True)
class ClipConfig:
    """What a clip shows, and how well."""

    before_s: float = 1.2
    """From so long before the moment."""
    after_s: float = 0.8
    """To so long after it."""
    height_px: int = 216
    rate_hz: int = 10
    """Frames each second, at most as many as were recorded."""
    crf: int = 26
    """Of the video; lower is better and larger."""
    quality: int = 80
    """Of a JPEG."""


CONFIG = ClipConfig()


@dataclass(frozen=True, kw_only=True)
class Footage:
    """Frames of one trial, each recorded beside twin where the twin was drawn."""

    frames: tuple[Image, ...]
    times_s: tuple[float, ...]
    """From the moment."""
    has_twin: bool

    @property
    def key(self) -> int:
        """Index of the frame nearest to the moment."""
        return min(range(len(self.times_s)), key=lambda index: abs(self.times_s[index]))


def can_film() -> bool:
    """Whether PyAV is installed, so that clips can be made."""
    return find_spec("av") is not None


def footage(run: RunFolder, row: TrialRow, config: ClipConfig = CONFIG) -> Footage:
    """Read the frames around the moment of a trial.

    Raises:
        NotHereError: When the recording has no picture.
        GstError: When it cannot be read.
    """
    path, at_ns = _instant(run, row)
    camera = main_camera(path)
    span = (at_ns - round(config.before_s * NS_PER_S), at_ns + round(config.after_s * NS_PER_S))
    recorded = _small(read_span(path, camera.camera_id, *span), config)
    if not recorded:  # the moment lies outside of what the camera saw
        stamp_ns = camera.stamps_ns[camera.nearest(at_ns)]
        recorded = _small(read_span(path, camera.camera_id, stamp_ns, stamp_ns), config)
    if not recorded:
        message = f"no camera images in {path.name} around its moment."
        raise NotHereError(message)
    drawn = _twin_pictures(run, row, camera.camera_id, span, config)
    frames = [
        _beside([image, _nearest(drawn, stamp_ns, image)] if drawn else [image])
        for stamp_ns, image in recorded
    ]
    return Footage(
        frames=tuple(frames),
        times_s=tuple((stamp_ns - at_ns) / NS_PER_S for stamp_ns, _ in recorded),
        has_twin=bool(drawn),
    )


def _instant(run: RunFolder, row: TrialRow) -> tuple[Path, int]:
    """The recording, and when on its clock; without a moment its last picture."""
    path = episode_path(run, row.file.removesuffix(".mcap") or row.episode)
    moment = moment_of(run, row)
    if moment is not None:
        at_ns = recorded_ns(path, moment)
        if at_ns is not None:
            return path, at_ns
    return path, main_camera(path).stamps_ns[-1]


def _twin_pictures(
    run: RunFolder,
    row: TrialRow,
    camera_id: str,
    span_ns: tuple[int, int],
    config: ClipConfig,
) -> list[tuple[int, Image]]:
    """What a replay drew through the same camera: the plan's pictures before the execution's."""
    name = RENDERED + camera_id
    found = []
    for path in derived_paths(run, row.file.removesuffix(".mcap"), "replay"):
        try:
            if name in camera_tracks(path):
                made = Episode.open(path).derived
                is_planned = made is not None and made.trajectory == "planned"
                if made is not None and made.plan_id in (None, row.plan_id):
                    found.append((is_planned, path.stat().st_mtime_ns, path))
        except GstError:  # the trial's own page says what is wrong with it
            continue
    for *_, path in sorted(found, reverse=True):
        margin_ns = round(APART_S * NS_PER_S)
        found_here = read_span(path, name, span_ns[0] - margin_ns, span_ns[1] + margin_ns)
        pictures = _small(found_here, config)
        if pictures:
            return pictures
    return []


def _small(found: Iterable[tuple[int, Image]], config: ClipConfig) -> list[tuple[int, Image]]:
    """Scale pictures down, and leave out those that come faster than the rate."""
    kept: list[tuple[int, Image]] = []
    least_ns = 0.9 * NS_PER_S / config.rate_hz  # a camera's own rate is never exact
    for stamp_ns, image in found:
        if not kept or stamp_ns - kept[-1][0] >= least_ns:
            kept.append((stamp_ns, _scaled(image, config.height_px)))
    return kept


def _nearest(drawn: Sequence[tuple[int, Image]], stamp_ns: int, beside: Image) -> Image:
    stamp, image = min(drawn, key=lambda each: abs(each[0] - stamp_ns))
    is_apart = abs(stamp - stamp_ns) > APART_S * NS_PER_S
    return np.full_like(beside, NOTHING_U8) if is_apart else image


def _scaled(image: Image, height_px: int) -> Image:
    with LOADING:
        from PIL import Image as pillow  # noqa: PLC0415  # only when a picture is made

    height, width = image.shape[:2]
    size = (max(2, round(width * height_px / height) // 2 * 2), height_px)
    return np.asarray(pillow.fromarray(image).resize(size, pillow.Resampling.BILINEAR))


def _beside(sides: Sequence[Image]) -> Image:
    if len(sides) == 1:
        return sides[0]
    gap = np.full((sides[0].shape[0], GAP_PX, 3), 255, dtype=np.uint8)
    return np.concatenate([sides[0], gap, sides[1]], axis=1)


def as_video(found: Footage, config: ClipConfig) -> bytes:
    """Make an MP4 file (H.264) of the frames.

    Raises:
        MissingDependencyError: Without PyAV.
    """
    with LOADING:
        from bridge.media.video_writer import VideoWriter  # noqa: PLC0415  # the extra [video]

    height, width = found.frames[0].shape[:2]
    with TemporaryDirectory(prefix="robot-gst-") as folder:
        path = Path(folder) / "clip.mp4"
        video = VideoWriter(
            path,
            fps=_rate_hz(found.times_s, config.rate_hz),
            width=width,
            height=height,
            crf=config.crf,
            keyframe_every=KEYFRAME_EVERY,
        )
        for index, frame in enumerate(found.frames):
            video.write(frame, first=index == 0)
        video.close()
        return path.read_bytes()


def _rate_hz(times_s: Sequence[float], most_hz: int) -> int:
    """The rate at which the frames came, so that the clip takes as long as what it shows."""
    if len(times_s) < 2:
        return 1
    return min(most_hz, max(1, round((len(times_s) - 1) / (times_s[-1] - times_s[0]))))


def picture(run: RunFolder, row: TrialRow) -> bytes:
    """Return a trial at its moment, recorded beside twin, as JPEG; drawn once."""

    def draw() -> bytes:
        found = footage(run, row, ClipConfig(before_s=0.1, after_s=0.1))
        return encode_jpeg(found.frames[found.key], CONFIG.quality, subsampling=SUBSAMPLING)

    return drawn_once(run.results_dir / PICTURES, row.episode, _what(run, row), draw)


def clip(run: RunFolder, row: TrialRow) -> bytes:
    """Return a trial around its moment, recorded beside twin, as MP4; made once."""
    return drawn_once(
        run.results_dir / CLIPS,
        row.episode,
        _what(run, row),
        lambda: as_video(footage(run, row), CONFIG),
        "mp4",
    )


def _what(run: RunFolder, row: TrialRow) -> tuple[object, ...]:
    """Everything that a picture of a trial depends on."""
    path = episode_path(run, row.file.removesuffix(".mcap") or row.episode)
    replays = derived_paths(run, path.stem, "replay")
    return stamp_of(path), moment_of(run, row), *map(stamp_of, replays), CONFIG


def drawn_once(
    folder: Path, episode: str, what: object, draw: Callable[[], bytes], ending: str = "jpg"
) -> bytes:
    """Return a picture of a trial that is drawn once and kept; one of something else goes.

    Args:
        what: Everything that it depends on; equal text stands for an equal picture.
    """
    name = hashlib.sha256(episode.encode("utf-8", "surrogatepass")).hexdigest()[:16]
    key = hashlib.sha256(repr(what).encode("utf-8", "surrogatepass")).hexdigest()[:16]
    kept = folder / f"{name}-{key}.{ending}"
    with _DRAWING:
        if kept.is_file():
            return kept.read_bytes()
        data = draw()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for old in folder.glob(f"{name}-*.{ending}"):
                old.unlink()
            write_whole(kept, data)
        except OSError:  # a run that only can be read is drawn anew each time
            pass
    return data
