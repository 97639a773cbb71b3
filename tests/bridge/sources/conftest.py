"""Lets the tests of this folder import the peers that lie beside them; a real recorder."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from loopback import recording
from rtde_server import RtdeServer, counting_state

from bridge.episode.run_folder import RunFolder
from bridge.record.control import RecorderClient
from bridge.wire.config import WireConfig
from bridge.wire.session import WireSession, open_session


class Joined(NamedTuple):
    """A real recorder behind a real zenoh router, and a client session beside it."""

    run: RunFolder
    client: WireSession
    control: RecorderClient
    endpoint: str

    def episode_path(self, name: str) -> Path:
        return self.run.episodes_dir / f"{name}.mcap"


@pytest.fixture
def server() -> Iterator[RtdeServer]:
    with RtdeServer(counting_state) as made:
        yield made


@pytest.fixture
def joined(tmp_path: Path) -> Iterator[Joined]:
    run = RunFolder.create(tmp_path / "run")
    with recording(run) as endpoint, open_session(WireConfig(connect=(endpoint,))) as client:
        yield Joined(run, client, RecorderClient(client, timeout_s=10.0), endpoint)
