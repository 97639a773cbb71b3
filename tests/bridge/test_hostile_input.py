"""Files and records made by other programs, or on purpose: one sentence, never a traceback."""

import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cyclopts
import numpy as np
import pytest
from joint_samples import at_positions
from mcap.writer import Writer

import robot_gst
from bridge.episode import schema, streams
from bridge.episode.catalogue import find_episodes
from bridge.episode.cdr.codec import MalformedMessageError
from bridge.episode.cdr.messages import FrameTransform, transforms_from_cdr, transforms_to_cdr
from bridge.episode.check import check_episode
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.transforms import TransformTree
from bridge.episode.writer import EpisodeWriter
from bridge.errors import BridgeError, EpisodeError, InvalidRecordError, UsageError
from bridge.media.color import UnreadableImageError, decode_color
from bridge.media.depth import decode_depth_png
from bridge.sources.standin.cell_file import load_cell
from bridge.task.record import parse_record
from bridge.task.task_file import load_task

ROOT = Path(__file__).resolve().parents[2]


def foreign_file(path: Path, metadata: dict[str, dict[str, str]]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for name, values in metadata.items():
            writer.add_metadata(name, values)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("episode", {"who": "me"}),
        ("episode", {"id": "7", "kind": '"trial"'}),
        ("episode", {"id": '"a"', "kind": '"trial"', "tags": "null"}),
        ("episode", {"id": '"a"', "kind": "[" * 100_000}),
        ("outcome", {"k": "1"}),
        ("derived", {"kind": '"replay"'}),
    ],
)
def test_metadata_of_another_program_is_one_sentence(
    tmp_path: Path, name: str, values: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    path = foreign_file(tmp_path / "run" / "episodes" / "x.mcap", {name: values})
    episode = Episode.open(path)
    if name == "episode" and values["kind" if "kind" in values else "who"].startswith("["):
        assert episode.info.kind.startswith("[[")  # text that is not JSON stays text
        return
    found = f"metadata record '{name}' cannot be read .(Object|Expected) "
    with pytest.raises(EpisodeError, match=found):
        getattr(episode, "info" if name == "episode" else name)
    assert check_episode(path).exit_code == 1
    assert robot_gst.run(["info", str(path)]) == 1
    assert "cannot be read" in capsys.readouterr().err
    if name != "derived":
        assert find_episodes(RunFolder.open(tmp_path / "run"))[0].error


@pytest.mark.parametrize(
    "text", [b"[" * 200_000, b'{"p": NaN}', b'{"p": -Infinity}', b'{"p": 1e999}']
)
def test_json_that_is_none_is_refused(text: bytes) -> None:
    with pytest.raises(InvalidRecordError, match="not JSON"):
        parse_record(text, name="plan")


def png(width: int, height: int, body: bytes = b"") -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        crc = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + crc

    head = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + body + chunk(b"IEND", b"")


@pytest.mark.parametrize("size", [(60_000, 60_000), (12_000, 12_000), (9_000, 9_000)])
def test_an_image_that_claims_gigabytes_is_refused(size: tuple[int, int]) -> None:
    for decode in (decode_color, decode_depth_png):
        with pytest.raises(UnreadableImageError, match="pixels"):
            decode(png(*size))


def sample(stamp_ns: int, names: tuple[str, ...], position: list[float]) -> bytes:
    return at_positions(stamp_ns, names, np.array(position)).to_cdr()


def test_joints_of_several_publishers_are_put_in_one_order(tmp_path: Path) -> None:
    path = tmp_path / "e.mcap"
    messages = [
        sample(1, ("a", "b"), [1.0, 2.0]),
        sample(2, ("finger",), [9.0]),
        sample(3, ("b", "a"), [4.0, 3.0]),
        sample(4, ("a", "b"), []),
    ]
    with EpisodeWriter(path) as writer:
        for index, data in enumerate(messages):
            writer.write("/c/joint_states", data, type_name=schema.JOINT_STATE, log_time_ns=index)
    track = streams.joint_track(Episode.open(path))
    assert track.names == ("a", "b")
    assert track.stamps_ns.tolist() == [1, 3]
    assert track.position.tolist() == [[1.0, 2.0], [3.0, 4.0]]


def test_positions_that_do_not_match_their_names_are_found_by_the_check(tmp_path: Path) -> None:
    path = tmp_path / "e.mcap"
    with EpisodeWriter(path) as writer:
        data = sample(1, ("a", "b"), [1.0])
        writer.write("/c/joint_states", data, type_name=schema.JOINT_STATE, log_time_ns=1)
    assert "1 positions of 2 joints" in check_episode(path).faults[0]


def transform(parent: str, child: str, stamp_ns: int = 0) -> FrameTransform:
    return FrameTransform(stamp_ns=stamp_ns, parent=parent, child=child, T_parent_child=np.eye(4))


def test_a_rotation_of_zeros_is_refused_when_read() -> None:
    data = bytearray(transforms_to_cdr([transform("world", "cam")]))
    data[-32:] = bytes(32)  # x y z w are the last fields
    with pytest.raises(MalformedMessageError, match="is no rotation"):
        transforms_from_cdr(bytes(data))


@pytest.mark.parametrize(
    "transforms",
    [
        [transform("a", "b"), transform("b", "a")],
        [transform("a", "c"), transform("b", "c", 1), transform("x", "b"), transform("x", "a")],
    ],
)
def test_frames_that_hang_together_in_no_single_way_are_refused(
    transforms: list[FrameTransform],
) -> None:
    tree = TransformTree([*transforms, transform("world", "fine")])
    with pytest.raises(BridgeError, match=r"frame '[abc]' hangs on"):
        tree.T_root_frame(transforms[-1].child if len(transforms) == 2 else "c", 0)
    assert np.array_equal(tree.T_root_frame("fine", 0), np.eye(4))


EMPTY = b'schema_version = 1\nname = "x"\ninstruction = "x"\nobjects = []\n'


@pytest.mark.parametrize(
    "text", [b"objects = 3\nschema_version = 1", b"\xff\xfe", b"[", b"", EMPTY]
)
def test_a_file_that_is_no_task_or_cell_is_one_sentence(tmp_path: Path, text: bytes) -> None:
    path = tmp_path / "strange.toml"
    path.write_bytes(text)
    for load in (load_task, load_cell):
        with pytest.raises(UsageError, match=r"strange\.toml"):
            load(str(path))


def test_a_disk_that_refuses_is_one_sentence(
    run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    with EpisodeWriter(run.episodes_dir / "t1.mcap") as writer:
        writer.describe(EpisodeInfo(id="t1", kind="trial"))
    run.notes_dir.write_text("in the way")
    assert robot_gst.run(["label", str(run.path), "t1", "--result", "failure"]) == 1
    said = capsys.readouterr().err
    assert said.startswith("robot-gst: cannot read or write")
    assert "notes" in said


def test_a_reader_that_has_seen_enough_is_no_traceback(tmp_path: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "robot_gst", "doctor", "--json", "--quiet"]
    done = subprocess.run(command, cwd=ROOT, stdout=write, stderr=subprocess.PIPE, check=False)
    os.close(write)
    assert done.stderr == b""


@pytest.mark.parametrize(
    "arguments",
    [
        ["publish", "standin", "--trials", "-1"],
        ["publish", "standin", "--rounds", "0"],
        ["publish", "standin", "--image-scale", "0"],
        ["publish", "standin", "--rate-hz", "-1"],
        ["import", "rgbd", "DIR", "RUN", "--rate-hz", "nan"],
        ["record", "RUN", "--camera-queue-mb", "-1"],
        ["record", "RUN", "--small-queue-mb", "0"],
    ],
)
def test_a_number_out_of_range_is_wrong_use(
    tmp_path: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    places = {"DIR": str(tmp_path / "folder"), "RUN": str(tmp_path / "run")}
    assert robot_gst.run([places.get(word, word) for word in arguments]) == 2
    assert f"{arguments[-2]} {arguments[-1]} makes no sense" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_every_parameter_of_every_command_is_explained() -> None:
    silent = []
    for name, command in _commands(robot_gst.build_app()):
        for argument in command.assemble_argument_collection(parse_docstring=True):
            if argument.show and not argument.parameter.help:
                silent.append(f"{name} {argument.name}")
    assert silent == []


def _commands(app: cyclopts.App, prefix: str = "") -> list[tuple[str, cyclopts.App]]:
    found = []
    for name in app:
        if not name.startswith("-"):
            below = _commands(app[name], f"{prefix}{name} ")
            found += below or [(prefix + name, app[name])]
    return found
