"""What a source of live data is: an episode, a camera, an arm, a cell; and how one is run.

Another device becomes a source by fulfilling ``Source``: ``run_source`` connects it, stops it and
counts what it sent.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any, Protocol, runtime_checkable

from cyclopts import Parameter

from bridge.terminal import Output, stop_signals
from bridge.wire.config import WireConfig

if TYPE_CHECKING:
    from bridge.wire.session import WireSession

Duration = Annotated[float | None, Parameter(name=("--duration", "--duration-s"))]
"""How long a command publishes [s]; None: until it is told to stop."""


@runtime_checkable
class Source(Protocol):
    """Publishes what one device or simulation has to say."""

    def run(self, session: "WireSession", stop: threading.Event, output: Output) -> dict[str, Any]:
        """Publish until ``stop`` is set or there is nothing left, and count what was sent."""


def run_source(
    source: Source, wire: WireConfig, output: Output, *, duration_s: float | None = None
) -> dict[str, Any]:
    """Run a source until it ends, SIGINT or SIGTERM arrives, or the time is over."""
    from bridge.wire.session import open_session  # noqa: PLC0415  # zenoh only when live

    with stopping(duration_s) as stop, open_session(wire) as session:
        return source.run(session, stop, output)


@contextmanager
def stopping(duration_s: float | None) -> Iterator[threading.Event]:
    """Set an event on SIGINT, on SIGTERM, or when the time is over; None: never."""
    with stop_signals() as stop:
        timer = None if duration_s is None else threading.Timer(duration_s, stop.set)
        if timer is not None:
            timer.daemon = True
            timer.start()
        try:
            yield stop
        finally:
            if timer is not None:
                timer.cancel()
