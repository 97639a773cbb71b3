"""No request from the network names a file outside the run folder."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from loopback import recording

from bridge.episode.run_folder import RunFolder
from bridge.errors import BridgeError
from bridge.record.control import RecorderClient
from bridge.wire.config import WireConfig
from bridge.wire.errors import RemoteError
from bridge.wire.session import open_session

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
