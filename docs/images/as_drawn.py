"""Write what `robot-gst render` draws of a run, small enough for the documents.

Examples, of the demo's run and of a scene of `robot-gst rebuild RUN --iterations 100`:
.venv/bin/python docs/images/as_drawn.py trial runs/demo docs/images/trial_twin.jpg
.venv/bin/python docs/images/as_drawn.py video runs/demo docs/images/trial.webp
.venv/bin/python docs/images/as_drawn.py seen runs/shelf docs/images/shelf_seen.jpg
"trial" puts recorded image, twin and difference of five instants below each other, the side camera
left, the wrist camera right. "video" shows all of the trial through the first camera: recorded,
twin, difference. "seen" puts the first view of a scan beside the mask of what was measured.
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image
from side_by_side import write_rows

from bridge.episode.run_folder import RunFolder
from twin.scene.render import describe_drawn, render
from twin.scene.settings import RenderConfig

INSTANTS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Shares of the time that both cameras recorded."""
HEIGHT_PX = 120
REST_MS = 1500
"""The last frame stays so long."""


def trial_frames(run: RunFolder, episode: str, camera: str) -> dict[int, np.ndarray]:
    """Recorded, twin and difference beside each other, by milliseconds since the first frame."""
    with TemporaryDirectory() as scratch:
        config = RenderConfig(episode=episode, camera=camera, compare=True, out=Path(scratch) / "x")
        print(describe_drawn(render(run, config)))
        paths = sorted((Path(scratch) / "x").glob("*.png"))
        return {int(path.stem): np.asarray(Image.open(path)) for path in paths}


def trial_rows(run: RunFolder, episode: str, cameras: list[str]) -> list[np.ndarray]:
    """One row an instant: recorded, twin, difference of each camera."""
    found = [trial_frames(run, episode, camera) for camera in cameras]
    last = min(max(frames) for frames in found)
    rows = []
    for share in INSTANTS:
        beside = [frames[min(frames, key=lambda ms: abs(ms - share * last))] for frames in found]
        rows.append(np.hstack([_scaled(image) for image in beside]))
    return rows


def write_video(frames: dict[int, np.ndarray], out: Path) -> None:
    """All frames, in the time they took, as an animated WebP."""
    times_ms = sorted(frames)
    pictures = [Image.fromarray(_scaled(frames[ms])) for ms in times_ms]
    lasts_ms = [*np.diff(times_ms).tolist(), REST_MS]
    pictures[0].save(
        out,
        save_all=True,
        append_images=pictures[1:],
        duration=lasts_ms,
        loop=0,
        quality=60,
        method=6,
    )
    print(f"{out}: {out.stat().st_size} bytes, {len(pictures)} frames")


def _scaled(image: np.ndarray) -> np.ndarray:
    size = (round(image.shape[1] * HEIGHT_PX / image.shape[0]), HEIGHT_PX)
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.LANCZOS))


def seen_row(run: RunFolder) -> np.ndarray:
    """The first view of a scan as drawn, and what of it was measured."""
    with TemporaryDirectory() as scratch:
        drawn = render(run, RenderConfig(depth=True, out=Path(scratch) / "view.png"))
        print(drawn)
        images = {path.stem: np.asarray(Image.open(path)) for path in Path(scratch).iterdir()}
    view = images.pop("view")
    mask = next(image for name, image in images.items() if name.endswith("seen"))
    return np.hstack([view, np.repeat(mask[..., None], 3, axis=2)])


def main() -> None:
    """Read the run, write one picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["trial", "video", "seen"])
    parser.add_argument("run", type=Path, help="rebuilt run folder")
    parser.add_argument("out", type=Path, help="JPEG, or WebP, to write")
    parser.add_argument("--episode", default="trial_0005", help="of a trial")
    parser.add_argument("--cameras", nargs="+", default=["side", "wrist"])
    given = parser.parse_args()
    run = RunFolder.open(given.run)
    if given.what == "video":
        write_video(trial_frames(run, given.episode, given.cameras[0]), given.out)
        return
    is_trial = given.what == "trial"
    rows = trial_rows(run, given.episode, given.cameras) if is_trial else [seen_row(run)]
    write_rows(rows, given.out)


if __name__ == "__main__":
    main()
