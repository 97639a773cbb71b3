"""Depth of LeRobot datasets: codes by the published formula, kept without loss, read back."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.episode import schema
from bridge.episode.cdr.messages import DepthImage
from bridge.episode.reader import Episode
from bridge.exchange.lerobot.depth import DepthCoding

av = pytest.importorskip("av")
pytest.importorskip("pyarrow")

CODING = DepthCoding()
KEY = "observation.images.side_depth"


def code_of(depth_mm: float) -> int:
    """The formula of lerobot 0.6 with its defaults, in millimetres, one number at a time."""
    low, high = math.log(10 + 3500), math.log(10_000 + 3500)
    code = round((math.log(depth_mm + 3500) - low) / (high - low) * 4095)
    return min(max(code, 0), 4095)


def test_codes_are_those_of_the_published_formula() -> None:
    depth_mm = np.arange(1, 65536, dtype=np.uint16)
    expected = [code_of(int(each)) for each in depth_mm]
    assert CODING.encode(depth_mm[None])[0].tolist() == expected
    assert CODING.encode(np.zeros((1, 1), np.uint16)) == 0


def test_what_was_measured_comes_back_within_two_millimetres() -> None:
    depth_mm = np.arange(65536, dtype=np.uint16)[None]
    back = CODING.decode(CODING.encode(depth_mm))[0].astype(int)
    assert np.abs(back - depth_mm[0])[11:10_001].max() <= 2
    assert back[0] == 0  # no measurement
    assert (back[10_001:] == 10_000).all()


@settings(max_examples=60, deadline=None)
@given(
    st.floats(0, 2),
    st.floats(0.1, 60),
    st.floats(0, 5),
    st.booleans(),
    st.integers(0, 4095),
)
def test_law_every_code_comes_back(
    min_m: float, span_m: float, shift_m: float, use_log: bool, code: int
) -> None:
    """Law: decoding and encoding again changes a code by as little as whole millimetres allow."""
    if use_log and min_m + shift_m < 0.05:
        return
    coding = DepthCoding(min_m=min_m, max_m=min_m + span_m, shift_m=shift_m, use_log=use_log)
    depth_mm = coding.decode(np.array([[code]], dtype=np.uint16))
    if depth_mm[0, 0] <= min_m * 1000 + 1:
        return  # the nearest is code 0, no measurement
    again = coding.decode(coding.encode(depth_mm))
    assert abs(int(again[0, 0]) - int(depth_mm[0, 0])) <= max(1, round(span_m * 1000 / 4095))


@pytest.mark.parametrize(
    "info",
    [
        {"video.depth_min": 1.0, "video.depth_max": 0.5},
        {"video.depth_min": 0.0, "video.depth_max": 1.0, "video.shift": 0.0},
        {"video.depth_min": float("nan"), "video.depth_max": 1.0},
        {"video.depth_min": "x", "video.depth_max": 1.0},
        {},
    ],
)
def test_scales_that_make_no_sense_are_refused(info: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"."):
        DepthCoding.from_info({"is_depth_map": True, **info})
    assert DepthCoding.from_info({**info, "video.is_depth_map": False}) is None


def test_depth_is_exported_as_upstream_stores_it_and_imported_again(
    make_trial: Callable[..., Path], made_trial: Any, tmp_path: Path
) -> None:
    make_trial(cameras=("side",), far_mm=12_000)
    assert run("export", "lerobot", tmp_path / "run", tmp_path / "ds", "--depth") == 0
    info = json.loads((tmp_path / "ds/meta/info.json").read_text())
    feature = info["features"][KEY]
    assert feature["shape"] == [*info["features"]["observation.images.side"]["shape"][:2], 1]
    assert feature["info"].items() >= {
        ("is_depth_map", True),
        ("video.codec", "hevc"),
        ("video.pix_fmt", "gray12le"),
        ("video.depth_min", 0.01),
        ("video.depth_max", 10.0),
        ("video.shift", 3.5),
        ("video.use_log", True),
        ("video.channels", 1),
        ("depth_unit", "mm"),
    }
    with av.open(str(tmp_path / f"ds/videos/{KEY}/chunk-000/file-000.mp4")) as file:
        stream = file.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("hevc", "gray12le")
        codes = [frame.to_ndarray(format="gray12le") for frame in file.decode(stream)]
    sent = [made_trial(far_mm=12_000).depth(number) for number in range(len(codes))]
    for code, depth_mm in zip(codes, sent, strict=True):  # without any further loss
        np.testing.assert_array_equal(code, CODING.encode(depth_mm))
    stats = json.loads((tmp_path / "ds/meta/stats.json").read_text())[KEY]
    seen = np.concatenate([depth[::4, ::4].ravel() for depth in sent])
    assert stats["max"] == [[[float(seen.max())]]]
    assert stats["min"] == [[[float(seen[seen > 0].min())]]]

    assert run("import", "lerobot", tmp_path / "ds", tmp_path / "back") == 0
    (path,) = (tmp_path / "back/episodes").iterdir()
    episode = Episode.open(path)
    messages = list(episode.messages(["/lerobot/cam/side/depth/image"]))
    assert len(messages) == episode.topics()["/lerobot/cam/side/color/image"].count == len(sent)
    for message, depth_mm in zip(messages, sent, strict=True):
        read = DepthImage.from_message(schema.IMAGE, message.data).depth_mm
        np.testing.assert_array_equal(read, CODING.decode(CODING.encode(depth_mm)))
    assert "code 0: no measurement" in str(episode.metadata_records["source"]["depth"])


def test_without_the_option_depth_is_left_out(
    make_trial: Callable[..., Path], tmp_path: Path
) -> None:
    make_trial(cameras=("side",))
    assert run("export", "lerobot", tmp_path / "run", tmp_path / "ds") == 0
    info = json.loads((tmp_path / "ds/meta/info.json").read_text())
    assert KEY not in info["features"]
    assert "Left out: depth" in (tmp_path / "ds/README.md").read_text()


def test_a_depth_video_of_an_unknown_scale_is_refused(
    make_trial: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_trial(cameras=("side",))
    assert run("export", "lerobot", tmp_path / "run", tmp_path / "ds", "--depth") == 0
    path = tmp_path / "ds/meta/info.json"
    info = json.loads(path.read_text())
    del info["features"][KEY]["info"]["video.depth_min"]
    path.write_text(json.dumps(info))
    assert run("import", "lerobot", tmp_path / "ds", tmp_path / "back") == 1
    assert "depth video without video.depth_min" in capsys.readouterr().err
