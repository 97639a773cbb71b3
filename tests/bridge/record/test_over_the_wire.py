"""Recorder, control keys and the folder source joined by real sessions, in one process."""

import io
import json
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from PIL import Image

from bridge.episode import schema
from bridge.episode.reader import Episode
from bridge.episode.run import RunFolder
from bridge.record.control import serve_control
from bridge.record.process import describe_status
from bridge.record.recorder import Recorder
from bridge.sources.folder_config import FolderConfig
from bridge.sources.folder_index import read_index
from bridge.sources.folder_publish import publish_folder_frames
from bridge.wire.config import WireConfig
from bridge.wire.errors import RemoteError
from bridge.wire.recorder_client import RecorderClient
from bridge.wire.session import WireSession, open_session


class Joined(NamedTuple):
    run: RunFolder
    client: WireSession


@pytest.fixture
def joined(run: RunFolder) -> Iterator[Joined]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with open_session(WireConfig(mode="router", connect=(), listen=(endpoint,))) as session:
        recorder = Recorder(run, now_ns=session.now_ns)
        session.subscribe("**", recorder.receive)
        serve_control(session, recorder)
        with open_session(WireConfig(connect=(endpoint,))) as client:
            yield Joined(run, client)
        recorder.close()


def test_a_stop_comes_after_everything_sent_before_it(joined: Joined) -> None:
    client = RecorderClient(joined.client, timeout_s=10.0)
    assert client.start("t1", {"cell": "lab", "tags": ["x"]}) == {"ok": True, "episode": "t1"}
    publisher = joined.client.publisher("/lab/event", schema.EVENT)
    record = {"schema_version": 1, "stamp_ns": 1, "type": "note", "text": ""}
    sent = [json.dumps({**record, "text": "x" * number}).encode() for number in range(300)]
    for number, data in enumerate(sent):
        publisher.put(data, source_ns=number)
    assert "recording t1" in describe_status(client.status())
    answer = client.stop({"result": "success"})
    assert (answer["messages"], answer["lost"]) == (300, 0)
    episode = Episode.open(joined.run.episodes_dir / "t1.mcap")
    messages = list(episode.messages(["/lab/event"]))
    assert [message.data for message in messages] == sent
    assert [message.publish_time_ns for message in messages] == list(range(300))
    assert episode.outcome is not None
    assert episode.outcome.result == "success"
    assert episode.info.tags == ("x",)
    assert client.status()["state"] == "idle"


@pytest.mark.parametrize(
    ("verb", "request_", "match"),
    [
        ("start", {"id": "../../evil"}, "not usable as a file name"),
        ("start", {"id": "a", "info": {"kind": "trial", "x": 1}}, "info does not know x"),
        ("start", {}, "needs an episode id"),
        ("stop", {"discord": True}, "stop does not know discord. It knows: discard, outcome"),
        ("stop", {}, "nothing is being recorded"),
        ("mark", {"text": 7}, "text must be a string"),
    ],
)
def test_bad_requests_get_their_reason(
    joined: Joined, verb: str, request_: dict[str, object], match: str
) -> None:
    with pytest.raises(RemoteError, match=match):
        RecorderClient(joined.client, timeout_s=10.0).ask(verb, request_)
    assert list(joined.run.path.rglob("*.mcap*")) == []


@pytest.mark.parametrize("payload", [b"{", b"[1]", b"\xff\xfe", b"[" * 100_000])
def test_requests_that_are_no_objects_are_refused(joined: Joined, payload: bytes) -> None:
    with pytest.raises(RemoteError, match="JSON"):
        joined.client.query("rec/main/ctl/mark", payload, timeout_s=10.0)
    assert RecorderClient(joined.client).status()["ok"]


def test_a_folder_is_recorded_as_a_camera(joined: Joined, tmp_path: Path) -> None:
    stream = io.BytesIO()
    Image.fromarray(np.zeros((6, 8, 3), np.uint8)).save(stream, "JPEG")
    (tmp_path / "c.jpg").write_bytes(stream.getvalue())
    Image.fromarray(np.full((6, 8), 700, np.uint16)).save(tmp_path / "d.png")
    frame = {"color": "c.jpg", "depth": "d.png", "T_world_cam": np.eye(4).tolist()}
    camera = {"fx": 9.0, "fy": 9.0, "cx": 4.0, "cy": 3.0, "width": 8, "height": 6}
    record = {"depth_unit_m": 0.001, "depth_intrinsics": camera, "frames": [frame] * 5}
    (tmp_path / "scene.json").write_text(json.dumps(record))
    client = RecorderClient(joined.client, timeout_s=10.0)
    client.start("scan", {"kind": "scan"})
    progress: list[int] = []
    sent = publish_folder_frames(
        joined.client,
        read_index(tmp_path),
        FolderConfig(cell="lab", camera="eye", rate_hz=100.0),
        fast=False,
        should_stop=lambda: len(progress) >= 4,
        advance=lambda done, note: progress.append(done),
    )
    answer = client.stop()
    assert (sent["frames"], sent["of"], progress) == (4, 5, [1, 2, 3, 4])
    assert answer["messages"] == sent["messages"] == 4 * 3 + 3
    topics = Episode.open(joined.run.episodes_dir / "scan.mcap").topics()
    counts = {topic: item.count for topic, item in topics.items() if topic != schema.DROPS_TOPIC}
    assert counts == sent["topics"]
