"""Places to meet on this machine alone."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bridge.episode.run_folder import RunFolder


def free_endpoint() -> str:
    """A zenoh endpoint on the loopback address at which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@contextmanager
def recording(run: "RunFolder") -> Iterator[str]:
    """A real recorder behind a real zenoh router; yields where others connect."""
    from bridge.record.control import serve_control
    from bridge.record.recorder import Recorder
    from bridge.wire.config import WireConfig
    from bridge.wire.session import open_session

    endpoint = free_endpoint()
    with open_session(WireConfig(mode="router", connect=(), listen=(endpoint,))) as session:
        recorder = Recorder(run, now_ns=session.now_ns)
        session.subscribe("**", recorder.receive)
        serve_control(session, recorder)
        yield endpoint
        recorder.close()
