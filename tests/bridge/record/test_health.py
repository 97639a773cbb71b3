"""Faults of content: named alike by the recorder, ``check``, ``info`` and ``ls``."""

import itertools
import json
import re
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import robot_gst
from bridge.clock import NS_PER_S, AnchoredClock
from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.images import depth_to_compact, image_header
from bridge.episode.check import check_episode
from bridge.episode.health import ContentWatch
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.media.color import encode_jpeg
from bridge.record.clocks import StampJumps
from bridge.record.recorder import Recorder
from bridge.wire.session import WireSample

COLOR, DEPTH, JOINTS = "/c/cam/a/color/image", "/c/cam/a/depth/image", "/c/joint_states"
RNG = np.random.default_rng(0)
Make = Callable[[int], bytes]


def header(number: int) -> dict[str, object]:
    return {"stamp": {"sec": 9, "nanosec": number}, "frame_id": "eye"}


def image(number: int, pixels: np.ndarray, encoding: str, **fields: object) -> bytes:
    height, width = pixels.shape[:2]
    about = {"height": height, "width": width, "step": pixels[0].nbytes, "encoding": encoding}
    message = {"header": header(number), **about, "data": pixels.tobytes(), **fields}
    return codec.encode(schema.IMAGE, message)


def noise(channels: int = 3, kind: type = np.uint8) -> np.ndarray:
    return RNG.integers(1, 255, (48, 64, channels)).astype(kind)


def late(number: int, empty: np.ndarray) -> np.ndarray:
    return empty if number < 30 else noise(1, np.uint16).astype(empty.dtype)


def rvl(number: int, depth: np.ndarray) -> bytes:
    return depth_to_compact(image_header(image(number, depth, "16UC1"))) or b""


def joints(number: int, position: float = 0.5, **fields: object) -> bytes:
    message = {"header": header(number), "name": ["a", "b"], "position": [0.1 * number, position]}
    return codec.encode(schema.JOINT_STATE, {**message, **fields})


def jpeg(number: int, data: bytes, form: str = "jpeg") -> bytes:
    about = {"header": header(number), "format": form, "data": data}
    return codec.encode(schema.COMPRESSED_IMAGE, about)


SKEW = {"k": [50.0, 1, 32, 0, 50, 24, 0, 0, 1]}
ODD = (SKEW, {"binning_x": 2}, {"width": 0}, *({"distortion_model": m} for m in ("mei", "ocam")))


def lens(number: int) -> bytes:
    """A camera without coefficients that is no pinhole all the same, in one way after another."""
    about = {"height": 48, "width": 64, "k": [50.0, 0, 32, 0, 50, 24, 0, 0, 1], "d": [0.0] * 4}
    return codec.encode(schema.CAMERA_INFO, about | ODD[number % len(ODD)])


STILL, FLAT = noise(), noise(1, np.uint16)
STILL_JPEG = encode_jpeg(STILL)
EMPTY = np.zeros((48, 64), np.uint16)
HOLES = np.full((48, 64), np.nan, np.float32)
GOOD: dict[str, tuple[str, Make]] = {
    COLOR: (schema.IMAGE, lambda n: image(n, noise(), "rgb8")),
    DEPTH: (schema.IMAGE, lambda n: image(n, noise(1, np.uint16)[..., 0], "16UC1")),
    JOINTS: (schema.JOINT_STATE, joints),
}
UNSET = {"header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "eye"}}
STUCK = {"header": header(7)}
FAULTS: dict[str, tuple[str, str, str, Make]] = {
    "frozen raw": ("frozen_image", COLOR, schema.IMAGE, lambda n: image(n, STILL, "rgb8")),
    "frozen jpeg": ("frozen_image", COLOR, schema.COMPRESSED_IMAGE, lambda n: jpeg(n, STILL_JPEG)),
    "frozen depth": ("frozen_image", DEPTH, schema.IMAGE, lambda n: image(n, FLAT, "16UC1")),
    "empty": ("empty_depth", DEPTH, schema.IMAGE, lambda n: image(n, late(n, EMPTY), "16UC1")),
    "holes": ("empty_depth", DEPTH, schema.IMAGE, lambda n: image(n, late(n, HOLES), "32FC1")),
    "empty rvl": ("empty_depth", DEPTH, schema.COMPRESSED_IMAGE, lambda n: rvl(n, late(n, EMPTY))),
    "nan": ("nan_joints", JOINTS, schema.JOINT_STATE, lambda n: joints(n, np.nan)),
    "infinity": ("nan_joints", JOINTS, schema.JOINT_STATE, lambda n: joints(n, -np.inf)),
    "no stamps": ("stamp_zero", JOINTS, schema.JOINT_STATE, lambda n: joints(n, **UNSET)),
    "one stamp": ("stamp_stuck", JOINTS, schema.JOINT_STATE, lambda n: joints(n, **STUCK)),
    "one stamp of images": (
        "stamp_stuck",
        COLOR,
        schema.IMAGE,
        lambda n: image(n, noise(), "rgb8", **STUCK),
    ),
    "nv24": ("unreadable", COLOR, schema.IMAGE, lambda n: image(n, noise(3), "nv24")),
    "depth of 8 bits": ("unreadable", DEPTH, schema.IMAGE, lambda n: image(n, noise(1), "8UC1")),
    "nv24 elsewhere": ("unreadable", "/eye", schema.IMAGE, lambda n: image(n, noise(3), "nv24")),
    "bent lens": ("unreadable", "/c/cam/a/color/info", schema.CAMERA_INFO, lens),
    "no jpeg": ("unreadable", COLOR, schema.COMPRESSED_IMAGE, lambda n: jpeg(n, b"h264")),
    "cdr 2": ("unreadable", JOINTS, schema.JOINT_STATE, lambda n: b"\0\7\0\0" + joints(n)[4:]),
}


def sample(
    topic: str, type_name: str, data: bytes, number: int, *, received_ns: int, source_ns: int | None
) -> WireSample:
    return WireSample(
        topic=topic, type_name=type_name, message_encoding="cdr", data=data, source_ns=source_ns,
        sequence=number, source_gid=b"g" * 16, received_ns=received_ns,
    )  # fmt: skip


def recorded(
    run: RunFolder, streams: dict[str, tuple[str, Make]], rate_hz: float = 20.0, set_s: float = 0
) -> dict:
    """Record sixty messages, given at once, and return the answer to the stop.

    The clock of all publishers is set by ``set_s`` in the middle; NaN: they do not say.
    """
    clock = AnchoredClock()
    recorder = Recorder(run, now_ns=clock.now_ns)
    recorder.start(EpisodeInfo(id="t1", kind="trial", cell="c"))
    begun_ns = clock.now_ns()
    for number, (topic, (type_name, make)) in itertools.product(range(60), streams.items()):
        at_ns = begun_ns + round(number / rate_hz * NS_PER_S) - 3 * NS_PER_S
        source_ns = None if set_s != set_s else at_ns + (number >= 30) * int(set_s) * NS_PER_S
        recorder.receive(
            sample(topic, type_name, make(number), number, received_ns=at_ns, source_ns=source_ns)
        )
    answer = recorder.stop()
    recorder.close()
    return answer


def test_a_good_cell_has_no_findings(run: RunFolder) -> None:
    velocities = {"velocity": [np.nan, np.nan]}  # not known: ROS says so
    streams = {**GOOD, "/d/joint_states": (schema.JOINT_STATE, lambda n: joints(n, **velocities))}
    assert recorded(run, streams)["findings"] == []
    report = check_episode(run.episodes_dir / "t1.mcap")
    assert (report.exit_code, report.findings, report.faults) == (0, [], [])


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_has_one_name_everywhere(
    run: RunFolder, fault: str, capsys: pytest.CaptureFixture[str]
) -> None:
    name, topic, type_name, make = FAULTS[fault]
    answer = recorded(run, {**GOOD, topic: (type_name, make)})
    assert [(each["name"], each["about"]) for each in answer["findings"]] == [(name, topic)]
    path = run.episodes_dir / "t1.mcap"
    report = check_episode(path)
    assert [(each.name, each.about) for each in report.findings if each.name == name] == [
        (name, topic)
    ]
    assert report.exit_code == (1 if name == "unreadable" else 3)
    found = answer["findings"][0]
    if name == "unreadable":
        assert found["text"].startswith("60 of 60 ")
    else:
        assert found["last_ns"] - found["first_ns"] > NS_PER_S
        same = report.findings[0]
        assert (found["first_ns"], found["count"]) == (same.first_ns, same.count)
    words = f"{name.replace('_', ' ')}: {topic}"
    for command in (["info", str(path)], ["ls", str(run.path)]):
        assert robot_gst.run(command) == 0
        assert words in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(("set_s", "says"), [(3600, "attachment"), (-3600, "header")])
def test_a_clock_that_is_set_is_named_at_the_end_too(run: RunFolder, set_s: int, says: str) -> None:
    def late(number: int) -> bytes:
        at_ns = time.time_ns() + number * NS_PER_S // 10 + (number >= 30) * set_s * NS_PER_S
        stamp = {"sec": at_ns // NS_PER_S, "nanosec": at_ns % NS_PER_S}
        return joints(number, header={"stamp": stamp, "frame_id": ""})

    streams = {JOINTS: (schema.JOINT_STATE, late if says == "header" else joints)}
    (told,) = recorded(run, streams, 10.0, set_s if says != "header" else np.nan)["findings"]
    (found,) = check_episode(run.episodes_dir / "t1.mcap").findings
    assert (told["name"], told["about"]) == (found.name, found.about) == ("clock_jump", JOINTS)
    side = "ahead" if set_s > 0 else "back"
    assert told["text"] == found.text
    assert re.search(f"jumped {side} by (3600.0|3599.[89])", found.text)


def test_a_fault_of_a_moment_is_none_and_one_that_comes_back_is_one(tmp_path: Path) -> None:
    def content(number: int) -> bytes:
        is_still = number in (5, 6, 7) or 40 <= number < 70 or number >= 80
        return image(number, STILL if is_still else noise(), "rgb8")

    with EpisodeWriter(tmp_path / "a.mcap") as writer:
        for number in range(120):
            writer.write(COLOR, content(number), type_name=schema.IMAGE, log_time_ns=number * 10**8)
    (found,) = check_episode(tmp_path / "a.mcap").findings
    assert (found.name, found.count) == ("frozen_image", 29 + 39)
    assert (found.first_ns, found.last_ns) == (41 * 10**8, 119 * 10**8)


@pytest.mark.parametrize(
    ("received", "back_ms", "is_told"), [(1, 58, False), (1, 3_600_000, True), (30, 58, True)]
)
def test_a_slow_topic_is_late_by_chance_and_no_clock_was_set(
    received: int, back_ms: int, is_told: bool
) -> None:
    jumps = StampJumps()
    delays_ms = (70 + back_ms, 72 + back_ms, 14, 12)
    told = [
        jumps.look(
            [{"topic": "/tf", "second": k, "received": received, "clock_offset_ns": ms * 1_000_000}]
        )
        for k, ms in enumerate(delays_ms)
    ]
    assert any(told) == is_told


@pytest.mark.parametrize(("blind_s", "found"), [(2.5, []), (4.0, ["empty_depth"])])
def test_a_wrist_camera_close_to_what_is_held_is_not_blind(
    tmp_path: Path, blind_s: float, found: list[str]
) -> None:
    with EpisodeWriter(tmp_path / "a.mcap") as writer:
        for number in range(200):
            is_blind = 3.0 < number / 20 < 3.0 + blind_s
            pixels = EMPTY if is_blind else noise(1, np.uint16)[..., 0]
            data, at_ns = image(number, pixels, "16UC1"), number * NS_PER_S // 20
            writer.write(DEPTH, data, type_name=schema.IMAGE, log_time_ns=at_ns)
    assert [each.name for each in check_episode(tmp_path / "a.mcap").findings] == found


def test_what_nobody_can_read_is_told_within_a_second(run: RunFolder) -> None:
    clock = AnchoredClock()
    recorder = Recorder(run, now_ns=clock.now_ns)
    recorder.start(EpisodeInfo(id="t1", kind="trial", cell="c"))
    data, begun_ns = image(1, noise(3), "nv24"), clock.now_ns()
    recorder.receive(sample(COLOR, schema.IMAGE, data, 0, received_ns=begun_ns, source_ns=1))
    assert recorder.news_arrived.wait(5.0)
    assert clock.now_ns() - begun_ns < 1.5 * NS_PER_S  # a second, and what a busy machine takes
    assert f"{COLOR}: messages cannot be read" in recorder.news[0]
    assert "encoding 'nv24' cannot be read" in recorder.news[0]
    assert recorder.status()["findings"][0]["name"] == "unreadable"
    recorder.close()


def test_times_that_cannot_be_are_named(tmp_path: Path) -> None:
    for name, stamps in (("late", [5, 2**63]), ("long", [5, 100 * 31_556_952 * NS_PER_S])):
        with EpisodeWriter(tmp_path / f"{name}.mcap") as writer:
            for stamp_ns in stamps:
                data = codec.encode(schema.STRING, {"data": "x"})
                times = {"log_time_ns": min(stamp_ns, 2**62), "publish_time_ns": stamp_ns}
                writer.write("/a", data, type_name=schema.STRING, **times)
        assert [each.name for each in check_episode(tmp_path / f"{name}.mcap").findings] == [
            "odd_times"
        ]


def test_a_part_that_was_left_is_no_clean_run(
    run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    assert recorded(run, GOOD)["lost"] == 0
    assert robot_gst.run(["check", str(run.path)]) == 0
    part = run.episodes_dir / "t2.mcap.part"
    part.write_bytes((run.episodes_dir / "t1.mcap").read_bytes()[:50_000])
    capsys.readouterr()
    assert robot_gst.run(["check", str(run.path), "--json"]) == 3
    said = capsys.readouterr()
    assert json.loads(said.out)["unfinished"] == [str(part)]
    assert f"its writer was killed; robot-gst recover {part}" in said.err
    robot_gst.run(["ls", str(run.path)])
    assert f"robot-gst recover {part}" in capsys.readouterr().err


def test_joints_that_are_taken_for_known_can_be_read_and_are_the_same_joints() -> None:
    """Law: whatever is taken as known without decoding decodes to the same names and counts."""
    rng = np.random.default_rng(3)
    for counts in ((2, 2, 2), (2, 0, 0), (2, 0, 2), (2, 2, 0)):
        fields = [rng.normal(size=count).tolist() for count in counts]
        names = ("position", "velocity", "effort")
        about = {"header": header(1), "name": ["a", "b"]}
        numbers = dict(zip(names, fields, strict=True))
        first = codec.encode(schema.JOINT_STATE, {**about, **numbers})
        watch, taken = ContentWatch(JOINTS, schema.JOINT_STATE), 0
        watch.see(first, 1)
        expected = codec.decode(schema.JOINT_STATE, first)
        for _ in range(3000):
            changed = bytearray(first)
            for _ in range(rng.integers(1, 3)):
                changed[rng.integers(len(changed))] ^= 1 << int(rng.integers(8))
            if watch.knows(bytes(changed)):
                taken += 1
                found = codec.decode(schema.JOINT_STATE, bytes(changed))
                assert found["name"] == expected["name"]
                assert [len(found[name]) for name in names] == list(counts)
        assert taken > 100
