"""Which frames of a scan are learnt from."""

from pathlib import Path

import numpy as np
import pytest
import textured_room
from hypothesis import given
from hypothesis import strategies as st

from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from twin.scene.frames import selection
from twin.scene.settings import FrameConfig


def test_a_camera_that_pauses_gives_no_more_frames_there() -> None:
    stamps = np.arange(100)
    path = np.concatenate(
        [np.linspace(0, 1, 10), 1 + 1e-6 * np.arange(80), np.linspace(1.1, 2, 10)]
    )
    picked = selection.pick(stamps, path, 10)
    assert len(picked) <= 10
    assert ((picked >= 10) & (picked < 90)).sum() <= 2


@given(st.integers(1, 60), st.integers(1, 30), st.integers(0, 1000))
def test_never_more_frames_than_wanted_always_in_order_always_the_same(
    num_frames: int, count: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    stamps = np.arange(num_frames) * 7
    path = (
        np.cumsum(rng.exponential(size=num_frames) * rng.integers(0, 2, num_frames)) + 1e-6 * stamps
    )
    picked = selection.pick(stamps, path, count)
    again = selection.pick(stamps, path, count)
    assert 1 <= len(picked) <= count
    assert picked.tolist() == sorted(set(picked.tolist())) == again.tolist()
    assert set(picked.tolist()) <= set(stamps.tolist())


def test_a_fixed_protocol_learns_from_every_fifth_and_holds_out_the_one_two_after(
    tmp_path: Path,
) -> None:
    run = RunFolder.create(tmp_path)
    textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=20)
    (choice,) = selection.choose_frames(
        selection.find_sources(run), FrameConfig(train_every=5, holdout_every=5)
    ).choices
    index = {1_000_000_000 + 100_000_000 * k: k for k in range(20)}
    assert sorted(index[s] for s in choice.train_ns) == [0, 5, 10, 15]
    assert sorted(index[s] for s in choice.holdout_ns) == [2, 7, 12, 17]


@pytest.mark.parametrize(
    ("settings", "found"),
    [
        ({"train_every": -1}, "at least 0"),
    ],
)
def test_protocols_that_make_no_sense_are_refused(settings: dict[str, int], found: str) -> None:
    with pytest.raises(UsageError, match=found):
        FrameConfig(**settings)  # type: ignore[arg-type]


def test_turning_counts_as_path_and_standing_still_hardly_does() -> None:
    turned = np.stack([textured_room.camera_pose(k, 5) for k in range(5)])
    turned[:, :3, 3] = 0.0
    path = selection.path_length_m(turned)
    assert path[-1] > 0.3
    assert (np.diff(path) > 0).all()
    still = selection.path_length_m(np.stack([np.eye(4)] * 3))
    assert 0 < still[-1] < 1e-4
