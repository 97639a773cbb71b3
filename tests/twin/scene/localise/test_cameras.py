"""Which cameras localisation looks through, from where, and how many of their images it decodes."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from written_messages import put_calibration, put_frame

from bridge.episode.cdr import messages
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import RgbdFrame, localisations
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.task.task_file import Task
from twin.scene.localise.episode import localise_episode, write_localised
from twin.scene.localise.stationary_frames import stationary_frames
from twin.scene.shape.known import pose_of
from twin.scene.store.calibration import write_calibration

S = 1_000_000_000
EYE, TARGET = (1.05, -0.1, 0.6), (0.48, 0.0, 0.0)
CUBE = pose_of(np.array([0.50, -0.15, 0.02, 0.4]))
BOX = pose_of(np.array([0.49, 0.19, 0.0, -0.1]))
SHIFT = np.array([0.03, -0.02, 0.0])


@pytest.fixture(scope="module")
def kept() -> list[RgbdFrame]:
    return []


@pytest.fixture
def frame(stage: Callable[..., Any], kept: list[RgbdFrame]) -> RgbdFrame:
    if not kept:
        scene = stage({"cube": CUBE, "box": BOX})
        kept.append(scene.frame("side", EYE, TARGET, np.random.default_rng(0)))
    return kept[0]


def put_camera(writer: EpisodeWriter, frame: RgbdFrame, root: str | None, num: int = 4) -> None:
    """A camera that stands still and sends the same image every second."""
    topic = f"/c/cam/{frame.camera_id}"
    put_calibration(writer, frame, topic, root)
    for index in range(1, num + 1):
        put_frame(writer, frame, topic, index * S)


def write(run: RunFolder, *cameras: tuple[RgbdFrame, str | None], num: int = 4) -> Episode:
    path = run.episodes_dir / "trial_1.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="trial_1", kind="trial", cell="c", stand_in=True))
        for frame, root in cameras:
            put_camera(writer, frame, root, num)
    return Episode.open(path)


def place_of(run: RunFolder, task: Task, episode: Episode) -> np.ndarray:
    (record,) = (
        item
        for item in localisations(Episode.open(write_localised(run, episode, task)))
        if item["object"] == "cube"
    )
    return np.array(record["T_base_object"]["p_m"])


def test_a_long_scan_is_not_decoded_for_a_few_of_its_frames(
    run: RunFolder, frame: RgbdFrame, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A minute of two cameras at 30 Hz would not fit into the memory of a laptop."""
    episode = write(run, (frame, "base_link"), num=20)
    decode, count = messages.CompressedColor.image_u8, []
    monkeypatch.setattr(
        messages.CompressedColor, "image_u8", lambda self: count.append(1) or decode(self)
    )
    found = stationary_frames(episode, 3, evenly=True)
    assert [item.stamp_ns for item in found] == [1 * S, 11 * S, 20 * S]
    assert len(count) == 4  # these, and one to see how large images are


def test_a_calibrated_camera_is_where_the_calibration_says(
    run: RunFolder, frame: RgbdFrame, task: Task
) -> None:
    """Start states come from the same cameras as the scene, which a rebuild poses by it."""
    episode = write(run, (frame, "base_link"))
    before = place_of(run, task, episode)
    np.testing.assert_allclose(before, CUBE[:3, 3], atol=0.004)
    T = frame.T_base_color.copy()
    T[:3, 3] += SHIFT
    q, p = se3.split(T)
    pose = {"p_m": p.tolist(), "q_wxyz": q.tolist()}
    place = {"link": "base_link", "stream": "color", "T_link_camera": pose}
    write_calibration(run, {"side": place}, {})
    np.testing.assert_allclose(place_of(run, task, episode), before + SHIFT, atol=0.003)


def test_a_camera_that_nobody_placed_does_not_spoil_the_others(
    run: RunFolder, frame: RgbdFrame, task: Task
) -> None:
    lost = replace(frame, camera_id="spare")
    elsewhere = replace(frame, camera_id="alone", T_base_color=np.eye(4), T_base_depth=np.eye(4))
    episode = write(run, (elsewhere, "camera_link"), (frame, "base_link"), (lost, None))
    found = localise_episode(episode, task, before_ns=9 * S)["cube"]
    assert found.detail["cameras"] == ["side"]
    assert found.T_base_object is not None
    np.testing.assert_allclose(found.T_base_object[:3, 3], CUBE[:3, 3], atol=0.004)
