"""A folder of posed colour images, by the commands."""

import json
from pathlib import Path

import numpy as np
import pytest

import robot_gst
from bridge.episode.reader import Episode
from bridge.media.color import encode_jpeg


def test_images_that_show_nothing_are_refused_before_the_fit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = []
    for number in range(9):
        image = np.full((48, 64, 3), 120, np.uint8)
        (tmp_path / f"{number}.jpg").write_bytes(encode_jpeg(image))
        T = np.eye(4)
        T[0, 3] = 0.1 * number
        frames.append({"file_path": f"{number}.jpg", "transform_matrix": T.tolist()})
    about = {"w": 64, "h": 48, "fl_x": 60.0, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(about))
    run = tmp_path / "run"
    assert robot_gst.run(["import", "rgbd", str(tmp_path), str(run), "--quiet"]) == 0
    topics = Episode.open(run / "episodes" / "scan.mcap").topics()
    assert not any(topic.endswith("depth/image") for topic in topics)
    assert robot_gst.run(["rebuild", str(run), "--quiet"]) == 1
    assert "do not agree on one" in capsys.readouterr().err
