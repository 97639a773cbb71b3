"""A rebuilt scene that says which robot recorded it."""

import json
from typing import Any

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.robots.robot import Robot
from twin.scene.store.folder import NEEDED, SCENE_FILE, SCENE_VERSION


def write_scan(run: RunFolder, episode_id: str, urdf: str) -> None:
    """Record nothing but a robot's description."""
    with EpisodeWriter(run.episodes_dir / f"{episode_id}.mcap") as writer:
        writer.describe(EpisodeInfo(id=episode_id, kind="scan"))
        writer.attach("robot.urdf", urdf.encode(), media_type="application/xml", log_time_ns=1)


def write_scene_of(run: RunFolder, robot: Robot) -> None:
    """Leave a scan by a robot, and a scene that was made of it."""
    write_scan(run, "scan", robot.description())
    run.scene_dir.mkdir()
    record: dict[str, Any] = {**dict.fromkeys(NEEDED, ""), "schema_version": SCENE_VERSION}
    record |= {"scene_hash": "abc", "sources": [{"id": "scan"}]}
    (run.scene_dir / SCENE_FILE).write_text(json.dumps(record))
