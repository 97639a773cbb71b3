"""``import lerobot`` of what is broken: one sentence with the place, and nothing half done."""

from collections.abc import Callable
from pathlib import Path

import pytest
from commands import run
from lerobot_dataset import CAMERA, Dataset


def break_version(dataset: Dataset) -> None:
    dataset.info["codebase_version"] = "v1.6"


def break_template(dataset: Dataset) -> None:
    dataset.info["data_path"] = "../../{chunk_index}/{file_index}"


def break_field(dataset: Dataset) -> None:
    dataset.info["data_path"] = "data/{episode_chunk:03d}.parquet"


def break_fps(dataset: Dataset) -> None:
    dataset.info["fps"] = 0


def break_columns(dataset: Dataset) -> None:
    for row in dataset.episodes:
        del row["length"]


def break_length(dataset: Dataset) -> None:
    dataset.episodes[1]["length"] = 6


def break_count(dataset: Dataset) -> None:
    dataset.rows[3]["frame_index"] = 5


def break_width(dataset: Dataset) -> None:
    dataset.info["features"]["action"]["shape"] = [4]


def break_still(dataset: Dataset) -> None:
    dataset.rows[8]["observation.images.still"] = {"bytes": None, "path": "images/8.png"}


def break_place(dataset: Dataset) -> None:
    dataset.episodes[1]["data/file_index"] = 1


def break_span(dataset: Dataset) -> None:
    dataset.episodes[2][f"videos/{CAMERA}/from_timestamp"] = 0.5


def break_time(dataset: Dataset) -> None:
    dataset.rows[1]["timestamp"] = 0.0


@pytest.mark.parametrize(
    ("damage", "code", "match"),
    [
        (break_version, 1, "info.json: version v1.6, and only v2 and v3 are read"),
        (break_template, 1, "leads out of the dataset"),
        (break_field, 1, "with the field 'episode_chunk'"),
        (break_fps, 1, "info.json: cannot be read (ValueError: fps is 0.0)"),
        (break_columns, 1, "meta/episodes/chunk-000/file-000.parquet: row 1: KeyError 'length'"),
        (break_length, 1, "file-000.parquet: row 8: episode 1 has 5 rows, meta/episodes says 6"),
        (break_count, 1, "file-000.parquet: row 4: frame_index does not count from 0"),
        (break_width, 1, "row 1: 'action' has 3 numbers, meta/info.json says 4"),
        (break_still, 1, "row 9: 'observation.images.still' holds no image"),
        (break_place, 1, "file-001.parquet: no rows of episode 1"),
        (break_span, 1, "file-001.mp4: no frame 4 of the episode at 0.9000 s"),
        (break_time, 1, "row 1: the timestamps of episode 0 do not rise"),
    ],
)
def test_a_broken_dataset_is_one_sentence_with_its_place(
    dataset: Dataset,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    damage: Callable[[Dataset], None],
    code: int,
    match: str,
) -> None:
    damage(dataset)
    assert run("import", "lerobot", dataset.write(), tmp_path / "run") == code
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
