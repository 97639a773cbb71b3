"""Every source of live data can be run in the same way."""

import os
import signal
import threading
from typing import Any

import pytest
from loopback import free_endpoint

from bridge.sources.source import Source, run_source
from bridge.sources.standin.session import StandinSource
from bridge.sources.standin.settings import SessionConfig
from bridge.terminal import Output
from bridge.wire.config import WireConfig
from bridge.wire.session import open_session


class Waiting:
    """A source that has nothing to say and waits to be stopped."""

    ends_itself = False

    def run(self, session: Any, stop: threading.Event, output: Output) -> dict[str, Any]:
        if self.ends_itself:
            os.kill(os.getpid(), signal.SIGTERM)
        return {"stopped": stop.wait(30)}


@pytest.mark.parametrize(("ends_itself", "duration_s"), [(True, None), (False, 0.05)])
def test_a_source_ends_by_a_signal_or_when_its_time_is_over(
    ends_itself: bool, duration_s: float | None
) -> None:
    wire = WireConfig(mode="router", listen=(free_endpoint(),), connect=())
    source = Waiting()
    source.ends_itself = ends_itself
    assert isinstance(source, Source)
    result = run_source(source, wire, Output(quiet=True), duration_s=duration_s)
    assert result == {"stopped": True}


def test_the_stand_in_says_that_it_is_alive() -> None:
    endpoint = free_endpoint()
    idle = SessionConfig(cell="lab", task="cube_into_box", scan=False, trials=0)
    router = WireConfig(mode="router", listen=(endpoint,), connect=())
    with (
        open_session(router) as recorder,
        open_session(WireConfig(connect=(endpoint,))) as client,
    ):
        StandinSource(idle).run(client, threading.Event(), Output(quiet=True))
        assert recorder.query_alive("**") == ["lab/alive"]
