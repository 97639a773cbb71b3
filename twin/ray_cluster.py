"""Pieces of work as tasks of a Ray cluster, which needs a token.

Ray 2.60 without a token runs anybody's code, and its control service listens on every interface
even where a loopback address was asked for (measured), so a cluster without one is refused.
"""

import os
import socket
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from bridge.episode import provenance
from bridge.errors import MissingDependencyError, UsageError
from bridge.process_pool import ATTEMPTS, Answer, Failed, Function, Item, do, lost
from bridge.wire.errors import is_loopback
from twin.errors import TwinError
from twin.physics.config import ENGINES

LOOPBACK = "127.0.0.1"
WINDOW = 2
"""Tasks per processor that are handed over before the first are back: one waits while one runs."""
MODE, TOKEN, TOKEN_PATH = "RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"
HIDDEN_LINES = "RAY_DEDUP_LOGS_SKIP_REGEX"
"""Ray tells of each lost process on standard output, in the middle of what a program reads there;
what was lost is in the answers."""
ANSWER_S = 5.0
"""How long the head of a cluster may take to accept a connection."""
LOOK_S, EMPTY_LOOKS = 60.0, 5
"""How often a cluster from which nothing comes is asked for its processors, and how often it may
have none: one that makes nodes when they are asked for needs some minutes."""
TOKEN_FILE = Path(".ray") / "auth_token"
"""Below the home folder; where Ray itself looks last."""


class RayClusterError(TwinError):
    """The cluster cannot be reached or used."""


class RayRunner:
    """Does pieces of work as Ray tasks; see ``bridge.process_pool.Runner``."""

    def __init__(self, address: str) -> None:
        """Connect later."""
        self._address = address
        self._ray: Any = None

    def __enter__(self) -> "RayRunner":
        """Connect; refuses a cluster without a token."""
        self._ray = _connect(self._address)
        return self

    def run(
        self, function: Function, items: Sequence[Item], cost: Callable[[Item], float]
    ) -> Iterator[tuple[Item, Answer | Failed]]:
        """See ``Runner``; Ray itself begins what lost its node once more."""
        ray = self._ray
        most = WINDOW * max(1, int(ray.cluster_resources().get("CPU", 1)))
        task = ray.remote(num_cpus=1, max_retries=ATTEMPTS - 1)(_task)
        todo = deque(sorted(items, key=cost, reverse=True))
        running: dict[Any, Item] = {}
        while todo or running:
            while todo and len(running) < most:
                item = todo.popleft()
                running[task.remote(function, item, code_version())] = item
            for reference in self._done(list(running)):
                item = running.pop(reference)
                try:
                    yield item, ray.get(reference)
                except ray.exceptions.RayError as error:
                    yield item, lost(f"Ray lost it: {_first_line(error)}")

    def _done(self, running: list[Any]) -> list[Any]:
        """Wait until something is done; give up after minutes without a processor."""
        empty = 0
        while empty < EMPTY_LOOKS:
            done, _ = self._ray.wait(running, num_returns=1, timeout=LOOK_S)
            if done:
                return list(done)
            empty = 0 if self._ray.cluster_resources().get("CPU", 0) else empty + 1
        message = (
            f"the Ray cluster at {self._address} has had no processor for "
            f"{LOOK_S * EMPTY_LOOKS / 60:.0f} minutes: all its nodes ended, or none was started "
            "beside its head. What was done is kept. Start a node, then run the command again."
        )
        raise RayClusterError(message)

    def __exit__(self, *_: object) -> None:
        """Leave; the cluster goes on."""
        self._ray.shutdown()


def _connect(address: str) -> Any:
    settings: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    _check_token()
    _check_somebody_listens(address)
    if is_loopback(f"tcp/{address}"):
        # Otherwise Ray replaces the loopback address by the machine's own, where nobody answers.
        settings["_node_ip_address"] = LOOPBACK
    os.environ[MODE] = "token"
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault(HIDDEN_LINES, ".*")
    try:
        import ray  # noqa: PLC0415  # seconds, and only with --ray
    except ImportError as error:
        raise MissingDependencyError(package="ray", extra="cluster", purpose="--ray") from error
    try:
        ray.init(address=address, **settings)
    except (ConnectionError, RuntimeError, ValueError, OSError, ray.exceptions.RayError) as error:
        ray.shutdown()
        message = (
            f"no Ray cluster to use at {address}: {_first_line(error)}. It must have been started "
            f"with {MODE}=token and the same token as here; see docs/scale.md."
        )
        raise RayClusterError(message) from error
    return ray


def _check_token() -> None:
    """Refuse to speak to a cluster that lets anybody in."""
    if os.environ.get(MODE, "token") != "token":
        message = f"{MODE} is {os.environ[MODE]!r}: --ray only speaks to a cluster with tokens."
        raise UsageError(message)
    if os.environ.get(TOKEN) or os.environ.get(TOKEN_PATH):
        return
    if not (Path.home() / TOKEN_FILE).is_file():
        message = (
            f"--ray needs the cluster's token: set {TOKEN_PATH} to the file that holds it "
            f"(or put it at ~/{TOKEN_FILE}). docs/scale.md says how to make one."
        )
        raise UsageError(message)


def _check_somebody_listens(address: str) -> None:
    """Ray itself tries for minutes, and tells its tries to the terminal."""
    host, _, port = address.rpartition(":")
    host = host.strip("[]")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        message = f"--ray {address!r} is not an address: give HOST:PORT of the head."
        raise UsageError(message)
    try:
        socket.create_connection((host, int(port)), timeout=ANSWER_S).close()
    except OSError as error:
        message = (
            f"no Ray cluster to use at {address}: {_first_line(error)}. Start its head there: "
            "ray start --head, with a token; see docs/scale.md."
        )
        raise RayClusterError(message) from error


def code_version() -> str:
    """What decides the bytes of a replay, besides its job."""
    # A second, while which processes of a cluster start.
    from twin.physics.engines import engine_version  # noqa: PLC0415
    from twin.replay.job import REPLAY_VERSION  # noqa: PLC0415

    engines = []
    for engine in ENGINES:
        with suppress(MissingDependencyError):
            engines.append(engine_version(engine))
    about = provenance.software()
    return f"{about['version']}, replays {REPLAY_VERSION}, {', '.join(engines)}"


def _task(function: Function, item: Any, version: str) -> Answer | Failed:
    """One piece of work on some node."""
    problem = _out_of_place(item, version)
    return do(function, item) if problem is None else Failed(message=problem, known=True)


def _out_of_place(item: Any, version: str) -> str | None:
    """Say why a node cannot do a piece of work; None when it can."""
    node = socket.gethostname()
    if version != code_version():
        return (
            f"node {node} runs robot-gst {code_version()}, not {version} as here: install the same "
            "version on every node"
        )
    for path in getattr(item, "needed_paths", tuple)():
        if not path.exists():
            return (
                f"node {node} does not see {path}: every node reads and writes the run folder "
                "under the same path, so share it between them"
            )
    return None


def _first_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return (lines[0] if lines else type(error).__name__).rstrip(".")
