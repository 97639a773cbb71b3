"""Write what cameras recorded of a trial beside what they would have seen of its replays.

Example: .venv/bin/python docs/images/replayed.py runs/toys docs/images/replayed.jpg --camera side
Needs robot-gst replay RUN --render. Columns: recorded, planned in the twin, executed in the twin.
Of a plan that was never executed there is one column, and no recording beside it. The picture of
the README (twin.jpg): --episode trial_0002 --trajectory executed --at 0.35 0.65 --headings, after
robot-gst replay RUN --episode trial_0002 --render of the demo. The tasks of the laboratory
(laboratory.jpg): --tasks --at 0 0.45 0.7 1, of robot-gst trials RUN --policies nominal --arms
without --trials 1 --seed 1000001 --task push_cube_to_mark stack_two_cubes slippery_block_into_box
heavy_block_into_box sloth_over_rim; each row is the first trial of a task, as recorded.
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from side_by_side import GAP_PX, write_rows

from bridge.episode.catalogue import outcome_of
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.media.color import decode_color
from evaluator.compare.images.scores import RECORDED, RENDERED, read_images

FIRST, LAST = 0.12, 0.98
"""Where in the replayed time the first and the last row are, as fractions."""


def columns(
    run: RunFolder, episode_id: str, camera_id: str, trajectories: list[str]
) -> list[dict[int, bytes]]:
    """Images by stamp: as recorded, then of each dynamic replay that was rendered."""
    source = Episode.open(run.episodes_dir / f"{episode_id}.mcap")
    found = [read_images(source).color[RECORDED]]
    for trajectory in trajectories:
        paths = run.derived(f"{episode_id}.replay.{trajectory}.dynamic.*")
        paths.sort(key=lambda path: path.stat().st_mtime_ns)
        newest = {path.name.split(".")[-4]: path for path in paths}  # by plan
        for path in newest.values():
            found.append(read_images(Episode.open(path)).color[RENDERED])
    mine = [
        {stamp: data for (name, stamp), data in of.items() if name == camera_id} for of in found
    ]
    return [of for of in mine if of]


def rows(images: list[dict[int, bytes]], fractions: list[float]) -> list[np.ndarray]:
    """One picture per instant (fraction of the replayed time); a replay that shares none is alone.

    Plans that were never executed share none with the recording and are left out beside others.
    """
    beside = [images[0], *(of for of in images[1:] if of.keys() & images[0].keys())]
    images = beside if len(beside) > 1 else images[-1:]
    common = sorted(set.intersection(*map(set, images)))
    places = np.array(fractions) * (len(common) - 1)
    pictures = []
    for stamp in (common[place] for place in places.round().astype(int).tolist()):
        shown = [decode_color(of[stamp]) for of in images]
        gap = np.full((shown[0].shape[0], GAP_PX, 3), 255, dtype=np.uint8)
        pictures.append(np.hstack([part for image in shown for part in (image, gap)][:-1]))
    return pictures


def headings(texts: list[str], width: int) -> np.ndarray:
    """A white row with one text above each column."""
    image = Image.new("RGB", (width, 26), "white")
    draw = ImageDraw.Draw(image)
    for column, text in enumerate(texts):
        middle = (column + 0.5) * width / len(texts)
        draw.text((middle, 13), text, fill="black", anchor="mm", font=ImageFont.load_default(15))
    return np.asarray(image)


def of_tasks(run: RunFolder, camera_id: str, fractions: list[float]) -> list[np.ndarray]:
    """What was recorded of the first trial of each task, and above it how the trial ended."""
    found: dict[str, np.ndarray] = {}
    for path in run.episodes():
        episode = Episode.open(path)
        if episode.info.kind != "trial" or episode.info.task in found:
            continue
        row = np.hstack(rows(columns(run, path.stem, camera_id, []), fractions))
        outcome = outcome_of(run, episode)
        text = f"{episode.info.task}: {outcome.result if outcome else 'not labelled'}"
        found[episode.info.task] = np.vstack([headings([text], row.shape[1]), row])
    return list(found.values())


def main() -> None:
    """Read the run, write one JPEG."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="run folder with rendered replays")
    parser.add_argument("out", type=Path, help="JPEG to write")
    parser.add_argument("--episode", default="trial_0001")
    parser.add_argument("--camera", default="side")
    parser.add_argument("--rows", type=int, default=3, help="how many instants")
    parser.add_argument("--at", type=float, nargs="+", help="instants, 0 to 1, instead of --rows")
    parser.add_argument("--trajectory", nargs="+", default=["planned", "executed"])
    parser.add_argument("--headings", action="store_true", help="name the columns")
    parser.add_argument("--tasks", action="store_true", help="a row of instants for each task")
    given = parser.parse_args()
    run = RunFolder.open(given.run)
    fractions = given.at or np.linspace(FIRST, LAST, given.rows).tolist()
    if given.tasks:
        write_rows(of_tasks(run, given.camera, fractions), given.out)
        return
    images = columns(run, given.episode, given.camera, given.trajectory)
    if not images:
        parser.error(f"{given.episode} has no images of a camera {given.camera!r}")
    pictures = rows(images, fractions)
    if given.headings:
        is_stand_in = Episode.open(run.episodes_dir / f"{given.episode}.mcap").info.stand_in
        texts = ["recorded" + (", stand-in cell" if is_stand_in else "")]
        texts += [f"twin, {trajectory}" for trajectory in given.trajectory]
        pictures = [headings(texts, pictures[0].shape[1]), *pictures]
    write_rows(pictures, given.out)


if __name__ == "__main__":
    main()
