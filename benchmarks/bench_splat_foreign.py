"""Objects found in scenes that no task describes, against what a person sees there.

The real shelf with its supplied masks, and the real kitchen with the list
``semantics/kitchen_objects.json``, which was made by eye and committed before the search was run on
it; what counts as found or false is in ``semantics/seen_objects.py``. And 60 questions for ``find``
about these, a study room and a run of ``robot-gst demo`` (``--demo RUN``), a third about what is
not there: ``semantics/questions.json``, committed before the command existed; and 22 asked later.
Scenes are rebuilt by the command's own code, for a number of images. A scene's name as an argument
measures that one only and stores nothing; with ``--keep FOLDER`` rebuilt runs are used again.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from measure import ROOT, Target, print_targets, report_targets

sys.path.insert(0, str(ROOT / "benchmarks" / "semantics"))

import shelf
from seen_objects import MIN_IOU, Judged, SeenObject, judge, read_list
from splat.kitchen import kitchen_folder
from splat.scans import QUIET, shelf_folder, shelf_scan

from bridge.episode.run_folder import RunFolder
from bridge.sources.folder.messages import read_index
from twin.naming.phrases import Asker, Found
from twin.naming.scene_file import BACKGROUND_KEY, read_semantics
from twin.naming.things import SemanticScene
from twin.scene.foundation.find import View, look_at, viewed
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.rebuild.run import rebuild
from twin.scene.semantics.lift import Viewpoint, render_labels
from twin.scene.settings import FitConfig, RebuildConfig
from twin.scene.store.folder import read_scene

IMAGES = 100
MIN_FOUND, MAX_FALSE, MIN_RIGHT = 0.7, 0.3, 0.65
FOLDERS = {
    "kitchen": "rgbd_7scenes_redkitchen_a",
    "shelf": "rgbd_apc_shelf_wristcam",
    "study": "rgbd_sun3d_studyroom_a",
}
NO_IMAGE = np.zeros((1, 1, 3), dtype=np.uint8)
LIST = ROOT / "benchmarks" / "semantics" / "kitchen_objects.json"
QUESTIONS = LIST.with_name("questions.json")


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What a person marked in a scene, and the frames it was marked in."""

    objects: list[SeenObject]
    views: Mapping[int, Viewpoint]


def kitchen_truth(folder: Path) -> Truth:
    """The list, and the colour cameras of its frames."""
    objects = read_list(LIST)
    return Truth(objects=objects, views=marked_views(folder, {f for o in objects for f in o.boxes}))


def marked_views(folder: Path, frames: set[int]) -> dict[int, Viewpoint]:
    """Where the colour camera of a recording stood in frames of these numbers."""
    index, views = read_index(folder), {}
    for frame in index.frames:
        number = int(frame.color_path.name.split(".")[0].split("-")[1])
        if number in frames:
            T = frame.T_world_depth @ index.T_depth_color
            camera = index.color_camera or index.depth_camera
            views[number] = Viewpoint(camera=camera, T_base_camera=T)
    return views


def shelf_truth(_folder: Path) -> Truth:
    """The supplied masks of all frames."""
    shots = shelf.load_shots()
    numbers = sorted({int(n) for shot in shots for n in np.unique(shot.ids)} - {0})
    return Truth(
        objects=[
            SeenObject(
                name=f"object {number}",
                group="asked",
                masks={key: shot.ids == number for key, shot in enumerate(shots)},
            )
            for number in numbers
        ],
        views={key: shot.viewpoint for key, shot in enumerate(shots)},
    )


TRUTHS = {"kitchen": kitchen_truth, "shelf": shelf_truth}


def rebuilt(source: Path, folder: Path) -> tuple[RunFolder, SemanticScene, float]:
    """Import and rebuild; the things found, and the CPU seconds of all of it."""
    began = time.process_time()
    run = RunFolder.open(folder) if folder.is_dir() else shelf_scan(source, folder)
    record = rebuild(run, RebuildConfig(fit=FitConfig(iterations=IMAGES, threads=1)), QUIET)
    rows = {BACKGROUND_KEY: record["background"]["num_splats"]}
    return run, read_semantics(run.scene_dir, rows), time.process_time() - began


def is_right(
    found: Sequence[Found], wanted: Sequence[SeenObject], views: Mapping[Any, View]
) -> bool:
    """Whether answers and wanted things pair up one to one."""
    scores = np.zeros((len(wanted), len(found)))
    for column, item in enumerate(found):
        drawn = {key: view.mask(item) for key, view in views.items()}
        scores[:, column] = [each.agreement(drawn) for each in wanted]
    fits = scores >= MIN_IOU
    return len(found) == len(wanted) and bool(fits.any(axis=1).all() and fits.any(axis=0).all())


def asked(about: Mapping[str, Any], run: RunFolder, source: Path | None) -> list[tuple[bool, bool]]:
    """For each question whether it is about what is there, and whether the answer is right."""
    things = {
        key: SeenObject(name=key, group="asked", boxes=boxes)
        for key, boxes in about["things"].items()
    }
    for item in read_list(LIST) if "list" in about else ():
        boxes = {str(key): box for key, box in item.boxes.items()}
        things[item.name] = replace(item, boxes=boxes)
    if source is None:
        views = {view.name: view for view in look_at(run, holdout=True).views}
    else:
        numbers = {int(key) for item in things.values() for key in item.boxes}
        marked = {str(key): place for key, place in marked_views(source, numbers).items()}
        views = {v.name: v for v in viewed(run, marked, dict.fromkeys(marked, NO_IMAGE)).views}
    looked, rows = look_at(run), []
    asker = Asker(scene=looked.scene, T_base_camera=looked.best.T_base_camera)
    for question in (*about["questions"], *about.get("later", ())):
        answer = asker.find(question["ask"])
        right = is_right(answer.found, [things[key] for key in question["is"]], views)
        told = "; ".join(f"{each.part} {each.item.name}" for each in answer.found) or answer.why
        print(f"  {'right' if right else 'WRONG'} {question['ask']!r}: {told}")
        rows.append((bool(question["is"]), right))
    return rows


def right_of(rows: Sequence[tuple[bool, bool]]) -> str:
    """How many questions about what is there are answered right."""
    present = [right for is_there, right in rows if is_there]
    return f"{sum(present)} of {len(present)}"


def question_rows(keep: Path, demo: Path | None) -> list[Target]:
    """Two rows over all questions whose scenes are here."""
    answers, later, told = [], [], []
    for name, about in json.loads(QUESTIONS.read_text())["scenes"].items():
        source = None if name == "demo" else shelf.DATA / FOLDERS[name]
        if (demo if source is None else source.is_dir() or None) is None:
            print(f"splat_foreign: no {name} here (GST_SHARED_DATA, --demo); not asked about")
            continue
        run = RunFolder.open(demo) if source is None else rebuilt(source, keep / name)[0]
        rows, num = asked(about, run, source), len(about["questions"])
        told.append(f"{name} {right_of(rows[:num])}")
        answers, later = answers + rows[:num], later + rows[num:]
    present = [right for is_there, right in answers if is_there]
    absent = [right for is_there, right in answers + later if not is_there]
    rate, yes = sum(present) / max(len(present), 1), float(len(absent) - sum(absent))
    what = "find: questions about what is there, answered right"
    of = f"{', '.join(told)}; asked later: {right_of(later)}"
    of_none = "find: questions about what is not there, answered with something"
    return [
        Target(what=what, measured=rate, limit=MIN_RIGHT, at_most=False, reference=of),
        Target(what=of_none, measured=yes, limit=0.0, reference=f"of {len(absent)}"),
    ]


def judged(run: RunFolder, scene: SemanticScene, truth: Truth) -> Judged:
    """Draw the things into the frames that a person marked, and compare."""
    cloud, rasteriser = read_scene(run).background, Rasteriser(RasterConfig(threads=1))
    labels = {
        key: render_labels(rasteriser, cloud, scene.labels, view).astype(np.int64)
        for key, view in truth.views.items()
    }
    return judge(truth.objects, labels, [item.id for item in scene.instances])


def rows_of(name: str, source: Path, folder: Path) -> list[Target]:
    """Found and false per object, and one printed line for each object and each false thing."""
    run, scene, seconds = rebuilt(source, folder)
    truth = TRUTHS[name](source)
    result = judged(run, scene, truth)
    names = {item.id: item.name for item in scene.instances}
    print(f"{name}: {scene.remark or f'{len(names)} things'}; {seconds:.1f} CPU seconds")
    for item in truth.objects:
        as_what = names[result.found[item.name][0]] if item.name in result.found else "-"
        print(f"  {item.group:<8} {item.name:<32} {result.best[item.name]:.2f}  {as_what}")
    for number in result.false:
        print(f"  false    {names[number]}")
    asked = [item.name for item in truth.objects if item.group == "asked"]
    found = [key for key in asked if key in result.found]
    missed = ", ".join(key for key in asked if key not in result.found) or "none"
    others = [item.name for item in truth.objects if item.group == "beyond"]
    beyond = sum(key in result.found for key in others)
    rows = [
        Target(
            what=f"{name}: objects found",
            measured=len(found) / len(asked),
            limit=MIN_FOUND,
            at_most=False,
            reference=f"{len(found)} of {len(asked)}, missed: {missed}",
        ),
        Target(
            what=f"{name}: false things for each object",
            measured=len(result.false) / len(asked),
            limit=MAX_FALSE,
            reference=f"{len(result.false)}: {'; '.join(names[k] for k in result.false) or 'none'}",
        ),
    ]
    row = Target(
        what=f"{name}: objects found, those beyond 2 m included",
        measured=(len(found) + beyond) / (len(asked) + len(others)),
        limit=MIN_FOUND,
        at_most=False,
        reference=f"{beyond} of the {len(others)} beyond",
    )
    return [*rows, row] if others else rows


def main() -> None:
    """Both scenes, or the one that is named."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", choices=[*TRUTHS], help="default: both")
    parser.add_argument("--keep", type=Path, help="where the rebuilt runs stay")
    parser.add_argument("--demo", type=Path, help="a run that robot-gst demo made")
    given = parser.parse_args()
    rows: list[Target] = []
    with tempfile.TemporaryDirectory() as scratch:
        for name, source in (("shelf", shelf_folder()), ("kitchen", kitchen_folder())):
            if given.scene and name != given.scene:
                continue
            if source is None:
                print(f"splat_foreign: no {name} here (GST_SHARED_DATA); its rows are left out")
                continue
            rows += rows_of(name, source, (given.keep or Path(scratch)) / name)
        if not given.scene:
            rows += question_rows(given.keep or Path(scratch), given.demo)
    if given.scene:
        print_targets(rows)
    else:
        report_targets("splat_foreign", rows, note=f"{IMAGES} training images, no task")


if __name__ == "__main__":
    main()
