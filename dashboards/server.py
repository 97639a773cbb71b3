"""Serve the review pages until stopped: address, token, signals."""

import os
import secrets
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import uvicorn

from bridge.heartbeat import BEAT
from bridge.terminal import Output
from dashboards.app import create_app
from dashboards.comparison import judge, stop_updates
from dashboards.config import DashboardConfig
from dashboards.errors import DashboardError
from dashboards.guard import Admission, is_loopback
from dashboards.library import Library

END_S = 0.5
"""How long threads without work take to end, with a wide margin."""


@dataclass(frozen=True, kw_only=True)
class Address:
    """Where the pages are."""

    host: str
    port: int
    token: str | None

    @property
    def url(self) -> str:
        """The address to open."""
        query = f"?token={self.token}" if self.token else ""
        host = "127.0.0.1" if self.host in ("0.0.0.0", "::") else self.host
        shown = f"[{host}]" if ":" in host else host
        return f"http://{shown}:{self.port}/{query}"

    @property
    def ssh_line(self) -> str:
        """The command that brings the pages to another computer."""
        target = "127.0.0.1" if self.host in ("0.0.0.0", "::") else self.host
        shown = f"[{target}]" if ":" in target else target
        return f"ssh -L {self.port}:{shown}:{self.port} {socket.gethostname()}"


def listen(config: DashboardConfig) -> socket.socket:
    """Bind the address.

    Raises:
        DashboardError: When another program has it, or it is not ours to bind.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            config.host, config.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        listener = socket.socket(family, kind, protocol)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen(64)
        except OSError:
            listener.close()
            raise
    except OSError as error:
        raise DashboardError(
            f"cannot listen on {config.host} port {config.port}: {error.strerror or error}. "
            "Choose another port with --port, or --port 0 for any free one."
        ) from error
    return listener


def serve(runs: Sequence[Path], config: DashboardConfig, output: Output) -> int:
    """Show run folders until SIGINT or SIGTERM; prints the address first.

    Args:
        runs: Run folders; those of the same name get a number.
    """
    library = Library.open(runs)
    listener = listen(config)
    token = None if is_loopback(config.host) else secrets.token_urlsafe(24)
    address = Address(host=config.host, port=listener.getsockname()[1], token=token)
    app = create_app(library, Admission(host=config.host, token=token), config)
    server = uvicorn.Server(
        uvicorn.Config(
            app,
            log_level="warning",
            lifespan="off",
            server_header=False,
            timeout_graceful_shutdown=2,
        )
    )
    text = f"Dashboard: {address.url}\nFrom another computer: {address.ssh_line}\nStop with Ctrl-C."
    record = {"url": address.url, "ssh": address.ssh_line, "runs": [*library.runs]}
    others = set(threading.enumerate())
    judge(library.pick(None))  # what changed is read while the reader is still opening the page
    app.state.pages.is_ending = lambda: server.should_exit
    with listener, _ending_on_signals(server), BEAT.doing(None):
        output.result(record, text)
        server.run(sockets=[listener])
    app.state.pages.end_live()
    stop_updates()
    if _are_at_work(set(threading.enumerate()) - others):
        # Python waits for threads that make a page, a minute for a large run, and ends others by
        # unwinding them, which aborts the process inside native code. What the evaluator keeps is
        # written whole, so nothing is left half done.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
    return 0


def _are_at_work(threads: set[threading.Thread]) -> bool:
    """Whether one of them goes on, a moment after it was told to end."""
    ends_s = time.monotonic() + END_S
    for thread in threads:
        thread.join(max(0.0, ends_s - time.monotonic()))
    return any(thread.is_alive() for thread in threads)


@contextmanager
def _ending_on_signals(server: uvicorn.Server) -> Iterator[None]:
    """Make SIGINT and SIGTERM an ordinary end, also before uvicorn listens for them itself.

    uvicorn raises the signal it caught once more after it has stopped; that does nothing here.
    """

    def stop(_number: int, _frame: FrameType | None) -> None:
        server.should_exit = True

    before = {kind: signal.signal(kind, stop) for kind in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)
