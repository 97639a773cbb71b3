"""A split episode reads as one; what is missing is named and keeps nothing else from being read."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from joint_samples import at_positions

from bridge.episode import schema, streams
from bridge.episode.cdr.messages import string_to_cdr
from bridge.episode.check import check_all, check_episode
from bridge.episode.metadata import EpisodeInfo, Outcome, to_strings
from bridge.episode.provenance import hash_file
from bridge.episode.reader import Episode
from bridge.episode.run_folder import part_name
from bridge.episode.writer import EpisodeWriter

JOINTS = "/c/joint_states"


def joint(stamp_ns: int) -> bytes:
    return at_positions(stamp_ns, ("a",), np.array([float(stamp_ns)])).to_cdr()


def write_part(
    folder: Path,
    index: int,
    times_ns: list[int],
    *,
    last: bool | None = False,
    episode_id: str = "t1",
    recovered: bool = False,
    sequence: int = 0,
) -> Path:
    with EpisodeWriter(folder / part_name("t1", index)) as writer:
        writer.describe(EpisodeInfo(id=episode_id, kind="trial", operator=f"of part {index}"))
        writer.attach("a.txt", b"%d" % index, media_type="text/plain", log_time_ns=1)
        writer.attach(f"{index}.txt", b"", media_type="text/plain", log_time_ns=1)
        start_ns = min(times_ns, default=0)
        text = string_to_cdr("<robot/>")
        writer.write("/robot_description", text, type_name=schema.STRING, log_time_ns=start_ns)
        for number, time_ns in enumerate(times_ns, start=sequence):
            writer.write(
                JOINTS,
                joint(time_ns),
                type_name=schema.JOINT_STATE,
                log_time_ns=time_ns,
                sequence=number,
            )
        if last is not None:
            writer.add_metadata("split", {"index": str(index), "last": json.dumps(last)})
        if last:
            writer.add_metadata("outcome", to_strings(Outcome(result="failure")))
        if recovered:
            writer.add_metadata("recovered", {"reason": '"killed"', "bytes_lost": "7"})
    return folder / part_name("t1", index)


def split_in_three(folder: Path) -> Path:
    write_part(folder, 2, [20, 30], sequence=2)
    write_part(folder, 3, [40], last=True, sequence=4)
    return write_part(folder, 1, [10, 15])


def test_three_parts_read_as_one_episode(tmp_path: Path) -> None:
    path = split_in_three(tmp_path)
    episode = Episode.open(path)
    assert [m.log_time_ns for m in episode.messages([JOINTS])] == [10, 15, 20, 30, 40]
    assert episode.topics()[JOINTS].count == 5
    assert (episode.start_ns, episode.end_ns) == (10, 40)
    assert [part.name for part in episode.parts] == ["t1.mcap", "t1.2.mcap", "t1.3.mcap"]
    assert episode.missing_parts == ()
    assert episode.info.operator == "of part 1"
    assert episode.outcome == Outcome(result="failure")
    assert episode.metadata_records["split"] == {"index": 3, "last": True}
    assert episode.attachment("a.txt") == b"1"
    assert episode.attachment("3.txt") == b""
    assert episode.attachment("4.txt") is None
    assert streams.joint_track(episode).stamps_ns.tolist() == [10, 15, 20, 30, 40]
    assert [m.log_time_ns for m in episode.messages([JOINTS], start_ns=15, end_ns=40)] == [
        15,
        20,
        30,
    ]
    report = check_episode(path)
    assert (report.exit_code, report.messages, report.notes) == (0, 8, [])


def test_the_hash_of_an_episode_is_that_of_all_its_bytes(tmp_path: Path) -> None:
    episode = Episode.open(split_in_three(tmp_path))
    whole = b"".join(path.read_bytes() for path in episode.parts)
    assert episode.sha256() == hashlib.sha256(whole).hexdigest()
    alone = Episode.open(tmp_path / "t1.3.mcap")
    assert alone.sha256() == hash_file(tmp_path / "t1.3.mcap")


def test_a_missing_part_in_the_middle_is_named_and_the_others_are_read(tmp_path: Path) -> None:
    path = split_in_three(tmp_path)
    (tmp_path / "t1.2.mcap").unlink()
    episode = Episode.open(path)
    assert episode.missing_parts == (tmp_path / "t1.2.mcap",)
    assert [m.log_time_ns for m in episode.messages([JOINTS])] == [10, 15, 40]
    report = check_episode(path)
    assert report.exit_code == 1
    assert report.faults == ["part t1.2.mcap of this split episode is missing"]


def test_a_missing_last_part_is_named(tmp_path: Path) -> None:
    path = split_in_three(tmp_path)
    (tmp_path / "t1.3.mcap").rename(tmp_path / "t1.3.mcap.part")
    assert Episode.open(path).missing_parts == (tmp_path / "t1.3.mcap",)
    report = check_episode(path)
    assert report.exit_code == 1
    assert "robot-gst recover" in report.faults[0]
    assert "t1.3.mcap.part" in report.faults[0]


def test_a_part_that_cannot_be_read_does_not_hide_the_others(tmp_path: Path) -> None:
    path = split_in_three(tmp_path)
    (tmp_path / "t1.2.mcap").write_bytes(b"no mcap")
    episode = Episode.open(path)
    assert [m.log_time_ns for m in episode.messages([JOINTS])] == [10, 15, 40]
    assert "t1.2.mcap cannot be read" in check_episode(path).faults[0]


def test_parts_of_another_episode_are_left_alone(tmp_path: Path) -> None:
    path = write_part(tmp_path, 1, [10], last=None)
    write_part(tmp_path, 2, [20], last=True, episode_id="other")
    assert Episode.open(path).parts == (path,)


def test_parts_are_checked_once_in_whatever_order_they_are_named(tmp_path: Path) -> None:
    split_in_three(tmp_path)
    reports = list(check_all(sorted(tmp_path.glob("*.mcap"))))
    assert [report.path.name for report in reports] == ["t1.mcap"]
    (tmp_path / "t1.mcap").unlink()
    reports = list(check_all(sorted(tmp_path.glob("*.mcap"))))
    assert [report.path.name for report in reports] == ["t1.2.mcap"]
    assert reports[0].faults == ["part t1.mcap of this split episode is missing"]


@settings(max_examples=12)
@given(times_ns=st.lists(st.integers(0, 1000), min_size=1, max_size=12), cut=st.integers(0, 11))
def test_where_an_episode_is_split_makes_no_difference(
    tmp_path_factory: pytest.TempPathFactory, times_ns: list[int], cut: int
) -> None:
    whole, split = tmp_path_factory.mktemp("whole"), tmp_path_factory.mktemp("split")
    write_part(whole, 1, times_ns, last=True)
    write_part(split, 1, times_ns[:cut])
    write_part(split, 2, times_ns[cut:], last=True, sequence=len(times_ns[:cut]))
    one, two = Episode.open(whole / "t1.mcap"), Episode.open(split / "t1.mcap")
    assert list(one.messages([JOINTS])) == list(two.messages([JOINTS]))
    assert one.topics()[JOINTS].count == len(times_ns)
    assert sum(item.count for name, item in two.topics().items() if name == JOINTS) == len(times_ns)
