"""Files that are written whole or not at all, by several processes at once and on a full disk."""

import multiprocessing
import os
from pathlib import Path

import numpy as np
import pytest

from bridge.media.video_writer import VideoWriter
from bridge.whole_file import part_of, write_whole

ROUNDS = 100


def write_often(path: Path, sign: bytes) -> None:
    """Write a file of one sign again and again; what fails ends the process with 1."""
    for _ in range(ROUNDS):
        write_whole(path, sign * 10_000)


@pytest.mark.slow
def test_two_processes_may_write_one_file_at_once(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    context = multiprocessing.get_context("spawn")
    writers = [context.Process(target=write_often, args=(path, sign)) for sign in (b"a", b"b")]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert [writer.exitcode for writer in writers] == [0, 0]
    assert path.read_bytes() in (b"a" * 10_000, b"b" * 10_000)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_disk_leaves_the_old_file_and_nothing_half_written(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    write_whole(path, b"old")
    part_of(path).symlink_to("/dev/full")
    with pytest.raises(OSError, match=r"No space left .*results\.json"):
        write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["results.json"]  # noqa: PTH208


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_video_on_a_full_disk_is_refused_and_removed(tmp_path: Path) -> None:
    pytest.importorskip("av")
    path = tmp_path / "trial.mp4"
    path.symlink_to("/dev/full")
    video = VideoWriter(path, fps=10, width=32, height=24, crf=18)

    def write(frame: np.ndarray) -> None:
        for index in range(60):
            video.write(frame, first=index == 0)

    with pytest.raises(OSError, match="No space left"):
        write(np.zeros((24, 32, 3), dtype=np.uint8))
    video.close()  # libav crashed here
    assert not path.is_symlink()
