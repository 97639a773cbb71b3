"""``find`` asked 60 questions about four scenes, a third of them about what is not there.

Questions and boxes are ``semantics/questions.json``, drawn by eye and committed before the command
existed; what counts as right is said there. The shelf, the kitchen and the study room are rebuilt
for a number of images and without a task; the demo is a run that ``robot-gst demo`` made, named by
``--demo``. With ``--keep FOLDER`` the rebuilt runs stay there and are used again.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from measure import ROOT, Target, report_targets

sys.path.insert(0, str(ROOT / "benchmarks" / "semantics"))

import shelf
from seen_objects import MIN_IOU, SeenObject, read_list
from splat.scans import QUIET, shelf_scan

from bridge.episode.run_folder import RunFolder
from bridge.sources.folder.messages import read_index
from twin.naming.phrases import Asker, Found
from twin.scene.foundation.find import View, look_at, viewed
from twin.scene.rebuild.run import rebuild
from twin.scene.semantics.lift import Viewpoint
from twin.scene.settings import FitConfig, FrameConfig, RebuildConfig

SEMANTICS = ROOT / "benchmarks" / "semantics"
IMAGES = 100
FOLDERS = {
    "kitchen": "rgbd_7scenes_redkitchen_a",
    "shelf": "rgbd_apc_shelf_wristcam",
    "study": "rgbd_sun3d_studyroom_a",
}
FRAMES = {
    "kitchen": FrameConfig(train_every=5, holdout_every=5, holdout_offset=2, max_holdout_frames=4)
}
MIN_RIGHT = 0.65


def scene_of(name: str, keep: Path, demo: Path | None) -> RunFolder | None:
    """The rebuilt run, or None where its recording is not here."""
    if name == "demo":
        return None if demo is None else RunFolder.open(demo)
    source, folder = shelf.DATA / FOLDERS[name], keep / name
    if not source.is_dir():
        return None
    run = RunFolder.open(folder) if folder.is_dir() else shelf_scan(source, folder)
    frames = FRAMES.get(name, FrameConfig())
    rebuild(run, RebuildConfig(frames=frames, fit=FitConfig(iterations=IMAGES, threads=1)), QUIET)
    return run


def marked_views(name: str, run: RunFolder, frames: set[str]) -> dict[str, View]:
    """The frames in which somebody drew boxes, with what ``find`` draws into them."""
    if name == "demo":
        return {view.name: view for view in look_at(run, holdout=True).views if view.name in frames}
    index, places = read_index(shelf.DATA / FOLDERS[name]), {}
    for frame in index.frames:
        key = str(int(frame.color_path.name.split(".")[0].split("-")[1]))
        if key in frames:
            T = frame.T_world_depth @ index.T_depth_color
            camera = index.color_camera or index.depth_camera
            places[key] = Viewpoint(camera=camera, T_base_camera=T)
    empty = dict.fromkeys(places, np.zeros((1, 1, 3), dtype=np.uint8))
    return {view.name: view for view in viewed(run, places, empty).views}


def is_right(
    found: Sequence[Found], wanted: Sequence[SeenObject], views: Mapping[str, View]
) -> tuple[bool, list[float]]:
    """Whether answers and wanted things pair up, and how well each wanted thing is met at best."""
    scores = np.zeros((len(wanted), len(found)))
    for column, item in enumerate(found):
        drawn = {key: view.mask(item) for key, view in views.items()}
        scores[:, column] = [each.agreement(drawn) for each in wanted]
    best = scores.max(axis=1, initial=0.0).tolist()
    fits = scores >= MIN_IOU
    paired = len(found) == len(wanted) and bool(fits.any(axis=1).all() and fits.any(axis=0).all())
    return paired, best


def asked(name: str, about: Mapping[str, Any], run: RunFolder) -> list[dict[str, Any]]:
    """One row for each question."""
    things = {
        key: SeenObject(name=key, group="asked", boxes={k: tuple(box) for k, box in boxes.items()})
        for key, boxes in about["things"].items()
    }
    for item in read_list(SEMANTICS / about["list"]) if "list" in about else ():
        boxes = {str(frame): box for frame, box in item.boxes.items()}
        things[item.name] = SeenObject(name=item.name, group="asked", boxes=boxes)
    looked = look_at(run)
    asker = Asker(scene=looked.scene, T_base_camera=looked.best.T_base_camera)
    views = marked_views(name, run, {k for each in things.values() for k in each.boxes})
    rows = []
    for question in about["questions"]:
        answer = asker.find(question["ask"])
        right, best = is_right(answer.found, [things[key] for key in question["is"]], views)
        told = "; ".join(f"{item.part} {item.item.name}" for item in answer.found) or answer.why
        print(f"  {'right' if right else 'WRONG'} {question['ask']!r}: {told} {best}")
        rows.append({"present": bool(question["is"]), "yes": bool(answer.found), "right": right})
    return rows


def main() -> None:
    """All scenes whose recordings are here."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--demo", type=Path, help="a run that robot-gst demo made")
    parser.add_argument("--keep", type=Path, help="where the rebuilt runs stay")
    given = parser.parse_args()
    scenes, rows = json.loads((SEMANTICS / "questions.json").read_text())["scenes"], []
    counts = []
    with tempfile.TemporaryDirectory() as scratch:
        for name, about in scenes.items():
            run = scene_of(name, given.keep or Path(scratch), given.demo)
            if run is None:
                print(f"splat_find: no {name} here (GST_SHARED_DATA, --demo); left out")
                continue
            print(name)
            own = asked(name, about, run)
            present = [row["right"] for row in own if row["present"]]
            counts.append(f"{name} {sum(present)} of {len(present)}")
            rows += own
    present = [row["right"] for row in rows if row["present"]]
    absent = [row["yes"] for row in rows if not row["present"]]
    report_targets(
        "splat_find",
        [
            Target(
                what="questions about what is there, answered right",
                measured=sum(present) / max(len(present), 1),
                limit=MIN_RIGHT,
                at_most=False,
                reference=f"{sum(present)} of {len(present)}: {', '.join(counts)}",
            ),
            Target(
                what="questions about what is not there, answered with something",
                measured=float(sum(absent)),
                limit=0.0,
                reference=f"of {len(absent)}",
            ),
        ],
        note="60 questions written before, no weights",
    )


if __name__ == "__main__":
    main()
