"""``import lerobot``: all arrives, our exports come back, and what is broken is one sentence."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from commands import run
from lerobot_dataset import CAMERA, LENGTHS, Dataset, png, shade, state

from bridge.episode.cdr.messages import CompressedColor, JointSample
from bridge.episode.reader import Episode
from bridge.media.color import decode_color


def joints(path: Path, topic: str) -> list[JointSample]:
    return [JointSample.from_cdr(m.data) for m in Episode.open(path).messages([topic])]


def colors(path: Path, topic: str) -> list[CompressedColor]:
    return [CompressedColor.from_cdr(m.data) for m in Episode.open(path).messages([topic])]


def test_every_episode_becomes_a_file_with_its_rows(dataset: Dataset, tmp_path: Path) -> None:
    assert run("import", "lerobot", dataset.write(), tmp_path / "run") == 0
    paths = sorted((tmp_path / "run" / "episodes").iterdir())
    assert [path.name for path in paths] == [f"ep_00000{n}.mcap" for n in range(3)]
    first = 0
    for path, length in zip(paths, LENGTHS, strict=True):
        samples = joints(path, "/lerobot/joint_states")
        assert [sample.position.tolist() for sample in samples] == [
            state(first + frame) for frame in range(length)
        ]
        assert samples[0].names == ("pan", "lift", "grip")
        assert [sample.stamp_ns for sample in samples] == [k * 10**8 for k in range(length)]
        actions = joints(path, "/lerobot/action")
        assert actions[-1].position.tolist() == pytest.approx(
            [value + 1 for value in state(first + length - 1)], abs=1e-6
        )
        assert actions[0].names == ("action_0", "action_1", "action_2")
        reward = joints(path, "/lerobot/next/reward")
        assert [sample.position[0] for sample in reward] == [0.0] * (length - 1) + [1.0]
        first += length


def test_each_row_has_the_video_frame_of_its_time(dataset: Dataset, tmp_path: Path) -> None:
    assert run("import", "lerobot", dataset.write(), tmp_path / "run") == 0
    index = 0
    for number, length in enumerate(LENGTHS):
        path = tmp_path / "run" / "episodes" / f"ep_{number:06d}.mcap"
        found = colors(path, "/lerobot/cam/front/color/image")
        assert [item.stamp_ns for item in found] == [k * 10**8 for k in range(length)]
        for item in found:
            mean = decode_color(item.data).astype(float).mean(axis=(0, 1))
            np.testing.assert_allclose(mean, shade(index), atol=4)
            index += 1
        stills = colors(path, "/lerobot/cam/still/color/image")
        assert bytes(stills[-1].data) == png(index - 1)  # bytes of the table pass through
        assert stills[-1].format == "png"
        assert run("check", path) == 0


def test_version_2_brings_the_same_episodes(tmp_path: Path) -> None:
    for name in ("write", "write_v2"):
        folder = getattr(Dataset(tmp_path / name), name)()
        assert run("import", "lerobot", folder, tmp_path / f"{name}_run") == 0
    topics = ("/lerobot/joint_states", "/lerobot/action", "/lerobot/next/reward")
    for number, length in enumerate(LENGTHS):
        pair = [tmp_path / f"{n}_run/episodes/ep_{number:06d}.mcap" for n in ("write", "write_v2")]
        old, new = ([m.data for m in Episode.open(p).messages(topics)] for p in pair)
        assert old == new
        pictures = [colors(path, "/lerobot/cam/front/color/image") for path in pair]
        assert [len(each) for each in pictures] == [length, length]
        for one, other in zip(*pictures, strict=True):
            assert one.stamp_ns == other.stamp_ns
            means = [decode_color(c.data).astype(float).mean(axis=(0, 1)) for c in (one, other)]
            np.testing.assert_allclose(*means, atol=4)
        assert Episode.open(pair[0]).outcome == Episode.open(pair[1]).outcome


@pytest.mark.parametrize("line", ["", "{", "[]", '{"episode_index": 0}', '{"episode_index": "x"}'])
def test_a_broken_list_of_version_2_is_named(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str], line: str
) -> None:
    (dataset.write_v2() / "meta/episodes.jsonl").write_text(f"{line}\n")
    assert run("import", "lerobot", dataset.folder, tmp_path / "run") == 1
    assert "episodes.jsonl" in capsys.readouterr().err


def test_the_episode_says_what_it_is_made_of(dataset: Dataset, tmp_path: Path) -> None:
    assert run("import", "lerobot", dataset.write(), tmp_path / "run", "--cell", "lab") == 0
    episodes = [Episode.open(p) for p in sorted((tmp_path / "run" / "episodes").iterdir())]
    assert [e.info.instruction for e in episodes] == ["pick the cube"] * 2 + ["fold the towel"]
    assert {(e.info.kind, e.info.cell, e.info.robot) for e in episodes} == {
        ("trial", "lab", "so100")
    }
    assert [e.info.task for e in episodes] == ["pick_the_cube"] * 2 + ["fold_the_towel"]
    assert [e.outcome.result for e in episodes if e.outcome] == ["success", "failure", "success"]
    source = episodes[2].metadata_records["source"]
    assert source["episode_index"] == 2
    assert "re-encoded as JPEG" in source["images"]
    assert "nominal" in source["times"]
    assert source["left_out"] == ["observation.env (float32 [2, 2])"]


@pytest.mark.parametrize("flag", ["is_depth_map", "video.is_depth_map"])
def test_depth_is_left_out_and_never_taken_for_colour(
    dataset: Dataset, tmp_path: Path, flag: str
) -> None:
    dataset.info["features"][CAMERA]["info"] = {flag: True}
    assert run("import", "lerobot", dataset.write(), tmp_path / "run") == 0
    episode = Episode.open(min((tmp_path / "run" / "episodes").iterdir()))
    assert f"{CAMERA} (depth)" in episode.metadata_records["source"]["left_out"]
    assert not [topic for topic in episode.topics() if "/front/" in topic]


def test_a_selection_imports_only_those_and_a_second_run_only_the_rest(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = dataset.write()
    assert run("import", "lerobot", folder, tmp_path / "run", "--episodes", "1-2") == 0
    names = [p.name for p in sorted((tmp_path / "run" / "episodes").iterdir())]
    assert names == ["ep_000001.mcap", "ep_000002.mcap"]
    capsys.readouterr()
    assert run("import", "lerobot", folder, tmp_path / "run", "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["already_there"] == 2
    assert [Path(name).name for name in report["files"]] == ["ep_000000.mcap"]
    assert run("import", "lerobot", folder, tmp_path / "run", "--episodes", "1,x") == 2
    assert "'1,x' is no list of numbers" in capsys.readouterr().err
    assert run("import", "lerobot", folder, tmp_path / "run", "--episodes", "7") == 2
    dataset.info["robot_type"] = "other"
    dataset.write()
    assert run("import", "lerobot", folder, tmp_path / "run") == 2
    assert "comes from another dataset" in capsys.readouterr().err


def test_what_we_export_we_import(make_trial: Callable[..., Path], tmp_path: Path) -> None:
    path = make_trial(cameras=("wrist",))
    assert run("export", "lerobot", tmp_path / "run", tmp_path / "out") == 0
    assert run("import", "lerobot", tmp_path / "out", tmp_path / "back") == 0
    (back,) = (tmp_path / "back" / "episodes").iterdir()
    samples = joints(back, "/lerobot/joint_states")
    assert samples[0].names == ("a", "b", "c", "gripper_width")
    before = colors(path, "/lab/cam/wrist/color/image")
    after = colors(back, "/lerobot/cam/wrist/color/image")
    assert len(before) == len(after) == len(samples) == 12
    for old, new in zip(before, after, strict=True):
        difference = decode_color(old.data)[6:, 6:].astype(float) - decode_color(new.data)[6:, 6:]
        assert np.abs(difference).mean() < 8


def test_a_missing_package_is_named(
    dataset: Dataset,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import sys

    folder = dataset.write()
    monkeypatch.setitem(sys.modules, "av", None)
    assert run("import", "lerobot", folder, tmp_path / "run") == 1
    assert "av is not installed" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert run("import", "lerobot", folder, tmp_path / "run2") == 1
    assert "robot-gst[report]" in capsys.readouterr().err


def put(*where: str | int, to: object) -> Callable[[Dataset], None]:
    """Damage a dataset: one value of it becomes another one."""
    name, *keys, last = where

    def damage(dataset: Dataset) -> None:
        at = getattr(dataset, str(name))
        for key in keys:
            at = at[key]
        at[last] = to

    return damage


def lose_lengths(dataset: Dataset) -> None:
    for row in dataset.episodes:
        del row["length"]


NO_IMAGE = {"bytes": None, "path": "images/8.png"}


@pytest.mark.parametrize(
    ("damage", "match"),
    [
        (
            put("info", "codebase_version", to="v1.6"),
            "info.json: version v1.6, and only v2 and v3 are read",
        ),
        (
            put("info", "data_path", to="../../{chunk_index}/{file_index}"),
            "leads out of the dataset",
        ),
        (
            put("info", "data_path", to="data/{episode_chunk:03d}.parquet"),
            "with the field 'episode_chunk'",
        ),
        (put("info", "fps", to=0), "info.json: cannot be read (ValueError: fps is 0.0)"),
        (lose_lengths, "meta/episodes/chunk-000/file-000.parquet: row 1: KeyError 'length'"),
        (
            put("episodes", 1, "length", to=6),
            "file-000.parquet: row 8: episode 1 has 5 rows, meta/episodes says 6",
        ),
        (
            put("rows", 3, "frame_index", to=5),
            "file-000.parquet: row 4: frame_index does not count from 0",
        ),
        (
            put("info", "features", "action", "shape", to=[4]),
            "row 1: 'action' has 3 numbers, meta/info.json says 4",
        ),
        (
            put("rows", 8, "observation.images.still", to=NO_IMAGE),
            "row 9: 'observation.images.still' holds no image",
        ),
        (put("episodes", 1, "data/file_index", to=1), "file-001.parquet: no rows of episode 1"),
        (
            put("episodes", 2, f"videos/{CAMERA}/from_timestamp", to=0.5),
            "file-001.mp4: no frame 4 of the episode at 0.9000 s",
        ),
        (put("rows", 1, "timestamp", to=0.0), "row 1: the timestamps of episode 0 do not rise"),
    ],
)
def test_a_broken_dataset_is_one_sentence_with_its_place(
    dataset: Dataset,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    damage: Callable[[Dataset], None],
    match: str,
) -> None:
    damage(dataset)
    assert run("import", "lerobot", dataset.write(), tmp_path / "run") == 1
    assert match in capsys.readouterr().err.replace("\n", " ")
    left = list((tmp_path / "run").rglob("*.part"))
    assert left == []


@pytest.mark.parametrize(
    ("name", "match"),
    [
        ("data/chunk-000/file-001.parquet", "file-001.parquet: cannot be read"),
        (f"videos/{CAMERA}/chunk-000/file-001.mp4", "file-001.mp4: cannot be decoded"),
        ("meta/episodes/chunk-000/file-000.parquet", "file-000.parquet: cannot be read"),
        ("meta/info.json", "info.json: cannot be read"),
    ],
)
@pytest.mark.parametrize("how", ["cut", "gone"])
def test_a_damaged_or_missing_file_is_named_and_whole_episodes_stay(
    dataset: Dataset,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    name: str,
    match: str,
    how: str,
) -> None:
    folder = dataset.write()
    if how == "gone":
        (folder / name).unlink()
    else:
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(whole[: len(whole) // 3])
    assert run("import", "lerobot", folder, tmp_path / "run") != 0
    error = capsys.readouterr().err
    assert Path(name).name in error or "meta/episodes" in error
    if how == "cut":
        assert match in error
    for path in (tmp_path / "run").rglob("*.mcap*"):
        assert run("check", path) == 0
