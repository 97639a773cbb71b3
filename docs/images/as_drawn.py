"""Write what `robot-gst render` draws of a run, small enough for the documents.

Examples, of the demo's run and of a scene of `robot-gst rebuild RUN --iterations 100`:
.venv/bin/python docs/images/as_drawn.py trial runs/demo docs/images/trial_twin.jpg
.venv/bin/python docs/images/as_drawn.py seen runs/shelf docs/images/shelf_seen.jpg
"trial" puts recorded image, twin and difference of five instants below each other, the side camera
left, the wrist camera right. "seen" puts the first view of a scan beside the mask of what was
measured.
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image
from side_by_side import write_rows

from bridge.episode.run_folder import RunFolder
from twin.replay.rebuilt_scene import correction_of
from twin.scene.render import render
from twin.scene.sequence import describe_sequence, render_sequence
from twin.scene.settings import RenderConfig
from twin.scene.store.calibration import read_calibration

INSTANTS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Shares of the time that both cameras recorded."""
HEIGHT_PX = 120


def trial_rows(run: RunFolder, episode: str, cameras: list[str]) -> list[np.ndarray]:
    """One row an instant: recorded, twin, difference of each camera."""
    correct = correction_of(read_calibration(run)).as_seen
    found: list[dict[int, np.ndarray]] = []
    with TemporaryDirectory() as scratch:
        for camera in cameras:
            folder = Path(scratch) / camera
            config = RenderConfig(episode=episode, camera=camera, compare=True, out=folder)
            print(describe_sequence(render_sequence(run, config, correct)))
            paths = sorted(folder.glob("*.png"))
            found.append({int(path.stem): np.asarray(Image.open(path)) for path in paths})
    last = min(max(frames) for frames in found)
    rows = []
    for share in INSTANTS:
        beside = [frames[min(frames, key=lambda ms: abs(ms - share * last))] for frames in found]
        rows.append(np.hstack([_scaled(image) for image in beside]))
    return rows


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
    """Read the run, write one JPEG."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["trial", "seen"])
    parser.add_argument("run", type=Path, help="rebuilt run folder")
    parser.add_argument("out", type=Path, help="JPEG to write")
    parser.add_argument("--episode", default="trial_0005", help="of a trial")
    parser.add_argument("--cameras", nargs="+", default=["side", "wrist"])
    given = parser.parse_args()
    run = RunFolder.open(given.run)
    is_trial = given.what == "trial"
    rows = trial_rows(run, given.episode, given.cameras) if is_trial else [seen_row(run)]
    write_rows(rows, given.out)


if __name__ == "__main__":
    main()
