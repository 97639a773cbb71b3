"""Take a fitted scene apart into background and objects, and put it together again."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bridge.episode.run import RunFolder, check_episode_id
from bridge.errors import BridgeError, UsageError
from bridge.geometry import se3
from bridge.task.task_file import Task, load_task
from twin.scene.frames import Sources
from twin.scene.gaussians import GaussianCloud, concatenate
from twin.scene.localise import LocalisedObject
from twin.scene.localise_episode import localise_episode
from twin.scene.objects import (
    ObjectSplats,
    SceneParts,
    moved_cloud,
    split_objects,
    write_objects,
)
from twin.scene.ply import read_ply


@dataclass(frozen=True, kw_only=True)
class TakenApart:
    """A scene in parts, or whole with the reason why."""

    background: GaussianCloud
    """What ``background.ply`` holds: the table under the objects is filled in."""
    remark: str
    parts: SceneParts | None = None
    localised: Mapping[str, LocalisedObject] | None = None
    task: Task | None = None

    def write(self, run: RunFolder) -> dict[str, Any]:
        """Write ``objects/`` and return what ``scene.json`` says about it."""
        if self.parts is None or self.localised is None or self.task is None:
            return {"objects": {}, "objects_remark": self.remark}
        objects = write_objects(run.scene_dir, self.parts, self.localised, self.task)
        return {
            "objects": objects,
            "objects_remark": self.remark,
            "filled_splats": len(self.parts.filling),
        }


def take_apart(sources: Sources, cloud: GaussianCloud) -> TakenApart:
    """Cut the task's objects out of the scene where the first scan shows them."""
    named = [episode for episode in sources.episodes if episode.info.task]
    if not named:
        return TakenApart(background=cloud, remark="no episode names a task: objects not known")
    episode = named[0]
    try:
        task = load_task(episode.info.task)
        localised = localise_episode(episode, task)
    except (BridgeError, UsageError) as error:
        return TakenApart(background=cloud, remark=f"objects not taken out: {error}")
    parts = split_objects(cloud, localised, task)
    missing = {key: item.reason for key, item in localised.items() if not item.found}
    remark = "; ".join(f"{key} not found: {reason}" for key, reason in missing.items())
    return TakenApart(
        background=concatenate([parts.background, parts.filling]),
        remark=remark,
        parts=parts,
        localised=localised,
        task=task,
    )


def read_objects(run: RunFolder, record: Mapping[str, Any]) -> dict[str, ObjectSplats]:
    """Load the objects that ``scene.json`` lists, each in its own frame."""
    objects = {}
    for key in record.get("objects", {}):
        folder = run.scene_dir / "objects" / check_episode_id(key)
        about = json.loads((folder / "object.json").read_text())
        pose = about["T_base_object"]
        T = se3.transform_from(np.array(pose["q_wxyz"]), np.array(pose["p_m"]))
        objects[key] = ObjectSplats(cloud=read_ply(folder / "gaussians.ply"), T_base_object=T)
    return objects


def put_together(
    background: GaussianCloud,
    objects: Mapping[str, ObjectSplats],
    Ts_base_object: Mapping[str, np.ndarray] | None = None,
) -> GaussianCloud:
    """Place every object in the background: where it was scanned, or where the mapping says."""
    places = {} if Ts_base_object is None else Ts_base_object
    placed = [
        moved_cloud(item.cloud, places.get(key, item.T_base_object))
        for key, item in objects.items()
    ]
    return concatenate([background, *placed])
