"""Recorder, control keys and sources joined by real sessions; no request leaves the run folder."""

import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from loopback import free_endpoint, recording

import robot_gst
from bridge.data_files import datasets_folder
from bridge.episode import schema
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import BridgeError
from bridge.record.config import RecorderConfig
from bridge.record.control import RecorderClient
from bridge.record.process import run_recorder
from bridge.record.status import describe_status
from bridge.terminal import Output
from bridge.wire.config import WireConfig
from bridge.wire.errors import RemoteError
from bridge.wire.session import WireSession, open_session


class Joined(NamedTuple):
    run: RunFolder
    client: WireSession
    endpoint: str


@pytest.fixture
def joined(run: RunFolder) -> Iterator[Joined]:
    with recording(run) as endpoint, open_session(WireConfig(connect=(endpoint,))) as client:
        yield Joined(run, client, endpoint)


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


@pytest.mark.parametrize(("host", "is_told"), [("127.0.0.1", False), ("0.0.0.0", True)])
def test_a_recorder_says_where_it_listens_and_when_others_may_reach_it(
    run: RunFolder, capsys: pytest.CaptureFixture[str], host: str, is_told: bool
) -> None:
    listen = free_endpoint().replace("127.0.0.1", host)
    answer = run_recorder(
        run.path,
        wire=WireConfig(mode="router", connect=(), listen=(listen,)),
        config=RecorderConfig(),
        stop=threading.Event(),
        output=Output(),
        episode=EpisodeInfo(id="t1", kind="trial", cell="lab"),
        duration_s=0.2,
    )
    told = capsys.readouterr().err
    assert f"recorder 'main' listens on {listen}, writes to {run.path}" in told
    assert ("can be reached from other machines" in told) == is_told
    assert answer is not None
    assert (answer["messages"], answer["lost"]) == (0, 0)
    assert Episode.open(run.episodes_dir / "t1.mcap").info.cell == "lab"


@pytest.mark.parametrize(
    ("verb", "request_", "match"),
    [
        ("start", {"id": "../../evil"}, "not usable as a file name"),
        ("start", {"id": "a", "info": {"kind": "trial", "x": 1}}, "info does not know x"),
        ("start", {"id": 7}, "needs an episode id"),
        ("stop", {"discord": True}, "stop does not know discord. It knows: discard, outcome"),
        ("start", {"id": "a", "info": [1]}, "info must be a JSON object"),
        ("start", {"id": "a", "task_file": 'name = "x"'}, '"objects" is a required property'),
        ("start", {"id": "a", "info": {"schema_version": 9}}, "schema_version 9 is not the 1"),
        ("stop", {"outcome": {"result": "success", "k": -1}}, "outcome is invalid at k"),
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


def test_ctl_sends_the_task_file_that_a_person_names(
    joined: Joined, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (datasets_folder() / "tasks" / "cube_into_box.toml").read_text()
    path = tmp_path / "mine.toml"
    path.write_text(text.replace("cube_into_box", "mine"))
    start = ["ctl", "start", "--id", "t1", "--connect", joined.endpoint, "--task", str(path)]
    assert robot_gst.run(start) == 0
    assert robot_gst.run(["ctl", "stop", "--connect", joined.endpoint]) == 0
    episode = Episode.open(joined.run.episodes_dir / "t1.mcap")
    assert episode.attachment("task.toml") == path.read_bytes()
    assert episode.info.task == "mine"
    path.write_text(text.replace("[objects.cube]", "[objects.cub]"))
    start[3] = "t2"
    assert robot_gst.run(start) == 2
    assert "Did you mean 'cub'?" in capsys.readouterr().err
    assert [each.name for each in joined.run.episodes_dir.glob("t2*")] == []


HOSTILE = (
    "../evil",
    "../../evil",
    "a/../../evil",
    "/tmp/evil",
    "..",
    ".",
    "",
    "~/evil",
    "evil\0.mcap",
    "evil\n",
    "..\\\\evil",
    "C:\\\\evil",
    "file://evil",
    "e" * 5_000,
    ".hidden",
    "-option",
    "\u202eevil",
)


class Remote(NamedTuple):
    client: RecorderClient
    run: RunFolder
    around: Path


@pytest.fixture
def remote(tmp_path: Path) -> Iterator[Remote]:
    around = tmp_path / "around"
    run = RunFolder.create(around / "inner" / "run")
    with recording(run) as endpoint, open_session(WireConfig(connect=(endpoint,))) as client:
        yield Remote(RecorderClient(client, timeout_s=10.0), run, around)


def outside(remote: Remote) -> list[Path]:
    return [p for p in remote.around.rglob("*") if remote.run.path not in (p, *p.parents)]


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("verb", ["start", "label", "info.cell", "recorder"])
def test_a_name_that_leads_elsewhere_is_refused(remote: Remote, verb: str, name: str) -> None:
    before = sorted(remote.around.rglob("*"))
    outcome = {"result": "success"}
    if verb == "info.cell" and name == "":
        pytest.skip("an empty cell means: not said")
    requests: dict[str, tuple[str, dict[str, object]]] = {
        "start": ("start", {"id": name}),
        "label": ("label", {"episode": name, "outcome": outcome}),
        "info.cell": ("start", {"id": "good", "info": {"cell": name}}),
        "recorder": ("start", {"id": "good", "path": name}),
    }
    with pytest.raises(RemoteError) as caught:
        remote.client.ask(*requests[verb])
    assert "Traceback" not in str(caught.value)
    assert len(str(caught.value)) < 1_000
    assert "internal error" not in str(caught.value)
    assert sorted(remote.around.rglob("*")) == before
    assert outside(remote) == [remote.around / "inner"]


def test_text_and_tags_are_only_text(remote: Remote) -> None:
    info = {"task": "../../evil", "operator": "/etc/passwd", "tags": ["../x", "\0"]}
    remote.client.start("t1", info)
    remote.client.ask("mark", {"text": "../../evil"})
    remote.client.stop({"result": "success", "detail": "../../evil"})
    assert [path.name for path in remote.around.rglob("*.mcap")] == ["t1.mcap"]
    assert outside(remote) == [remote.around / "inner"]


def test_a_link_in_the_run_folder_leads_nowhere(remote: Remote, tmp_path: Path) -> None:
    """Nobody can make one from the network; a file that is there is at least never written over."""
    target = tmp_path / "target"
    target.write_text("untouched")
    (remote.run.episodes_dir / "t1.mcap").symlink_to(target)
    (remote.run.episodes_dir / "t2.mcap.part").symlink_to(target)
    for name in ("t1", "t2"):
        with pytest.raises(BridgeError):
            remote.client.start(name)
    assert target.read_text() == "untouched"
