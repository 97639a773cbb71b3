"""The example that learns: what it takes from a trial, and that it goes where it sees something."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from joint_samples import at_positions

from bridge.episode import schema
from bridge.episode.cdr.messages import CompressedColor
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.writer import EpisodeWriter
from bridge.media.color import encode_png
from bridge.robots.default import ARM_JOINTS

sys.path.insert(0, str(Path(__file__).parents[3] / "examples" / "policies"))

import clone

OPEN_M, HELD_M = 0.08, 0.04


def recorded(path: Path) -> Episode:
    """Rest, go fast, close, carry slowly, open; the picture says how many tenths have passed."""
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id=path.stem, kind="trial"))
        for tick in range(600):
            t = tick * 0.01
            first = np.interp(t, [1, 1.5, 3, 5], [0, 1.5, 1.5, 1.0])
            width = np.interp(t, [2, 2.4, 5.2, 5.5], [OPEN_M, HELD_M, HELD_M, OPEN_M])
            stamp = 10_000_000 * tick
            joints = np.array([first, 0.5 * first, 0, 0, 0, 0])
            for topic, names, values in (
                ("joint_states", ARM_JOINTS, joints),
                ("gripper/state", ("gripper_width",), np.array([width])),
            ):
                data = at_positions(stamp, names, values).to_cdr()
                writer.write(
                    f"/c/{topic}", data, type_name=schema.JOINT_STATE,
                    log_time_ns=stamp, publish_time_ns=stamp,
                )  # fmt: skip
            if tick % 20 == 0:
                shade = encode_png(np.full((24, 32, 3), tick // 10, dtype=np.uint8))
                image = CompressedColor(stamp_ns=stamp, frame_id="c", format="png", data=shade)
                writer.write(
                    "/c/cam/side/color/image", image.to_cdr(), type_name=schema.COMPRESSED_IMAGE,
                    log_time_ns=stamp, publish_time_ns=stamp,
                )  # fmt: skip
    return Episode.open(path)


def test_the_way_is_kept_and_the_pace_is_not(tmp_path: Path) -> None:
    demo = clone.read(recorded(tmp_path / "trial.mcap"))
    times = np.arange(0, demo.track_s[-1], clone.STEP_S)
    track = np.array([np.interp(times, demo.track_s, x) for x in demo.track.T]).T
    speed = np.abs(np.diff(track[:, :6], axis=0)).max(1) / clone.STEP_S
    assert speed.max() <= clone.SPEED_RAD_S + 1e-6
    ways = 1.5 + 0.5 + clone.RAD_PER_M * 2 * (OPEN_M - HELD_M)
    assert demo.track_s[-1] == pytest.approx(ways / clone.SPEED_RAD_S, rel=0.02)
    assert track[-1, :7] == pytest.approx([1.0, 0.5, 0, 0, 0, 0, OPEN_M], abs=0.03)
    there = np.isclose(track[:, 0], 1.5, atol=0.01) & (track[:, 6] < OPEN_M - 0.005)
    assert there.any()
    assert track[there, 7].min() == 1.0
    carried = (track[:, 0] < 1.45) & (track[:, 6] < HELD_M + 0.001)
    assert set(track[:, 7][carried & (track[:, 0] > 1.05)]) == {1.0}
    assert demo.track[0, 7] == demo.track[-1, 7] == 0.0
    shades = demo.pictures[0, :, 0, 0, 0]  # tenths of seconds
    assert demo.pictures.shape == (1, 30, 3, clone.SIZE[1], clone.SIZE[0])
    joint = np.interp(demo.pictures_s, demo.track_s, demo.track[:, 0])
    assert joint == pytest.approx(
        np.interp(0.1 * shades, [1, 1.5, 3, 5], [0, 1.5, 1.5, 1]), abs=0.04
    )


def test_it_goes_where_it_sees_something(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bright patch says where the first joint is to go."""
    rng = np.random.default_rng(0)

    def goal(column: int) -> float:
        return 0.4 * (column - 43) / 43

    def demo(column: int) -> clone.Demo:
        pictures = rng.integers(0, 60, (2, 4, 3, clone.SIZE[1], clone.SIZE[0])).astype(np.uint8)
        row = int(rng.integers(60))
        pictures[0, :, 0, row : row + 10, column : column + 10] = 255
        track = np.zeros((3, 8))
        track[:, 0], track[:, 6] = goal(column) * np.array([0, 1, 1]), OPEN_M
        return clone.Demo(pictures, np.zeros(4), track, np.array([0.0, 0.8, 9.0]))

    monkeypatch.setattr(clone, "STEPS", 200)
    monkeypatch.setattr(clone, "RATE", 3e-3)
    net = clone.train([demo(int(column)) for column in rng.integers(0, 86, 60)])
    torch.save(net.state_dict(), tmp_path / "clone.pt")
    monkeypatch.setenv("CLONE", str(tmp_path / "clone.pt"))
    policy = clone.Clone()
    way = clone.FOLLOWED * clone.STEP_S / 0.8  # of the way to the goal, when the answer ends
    for column in (10, 40, 75):
        pixels = dict(zip("ab", demo(column).pictures[:, 0].transpose(0, 2, 3, 1), strict=True))
        told = {"pixels": pixels, "agent_pos": np.array([0, 0, 0, 0, 0, 0, OPEN_M], dtype="f4")}
        rows = policy.infer(told)
        assert rows.shape == (clone.FOLLOWED, 7)
        assert rows[-1, 0] == pytest.approx(way * goal(column), abs=0.06)
        assert rows[:, 6] == pytest.approx(OPEN_M)
    assert len(policy.metadata["checkpoint"]) == 12
