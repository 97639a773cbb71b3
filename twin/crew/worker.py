"""One process that does one piece of work after another, and may hang or die without harm.

Whoever asked sees an answer, a death or a time that is up, and can start the process again.
"""

import contextlib
import errno
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from bridge.errors import GstError
from twin.errors import TwinError

ONE_THREAD: Mapping[str, str] = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OMP_WAIT_POLICY": "passive",
}
"""Side by side, libraries that start a thread for each core only get in each other's way."""
REFUSED = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO)
"""What a disk says that is full, or may not be written; everything else is a bug here."""
JOIN_S = 5.0
WHOLE_S = 5.0
"""For the rest of an answer that has begun, where there is a limit at all."""
_starting = threading.Lock()


class WorkerDiedError(TwinError):
    """The process that did the work is gone."""

    def __init__(self, *, status: int | None) -> None:
        """Remember its exit code, or minus the number of the signal that ended it."""
        self.status = status
        super().__init__(f"the process that did it ended {_ending(status)}")


class TimeIsUpError(TwinError):
    """The work was not done in time."""


@dataclass(frozen=True, kw_only=True)
class Failed:
    """An exception, as far as it crosses between processes."""

    message: str
    known: bool
    """A ``GstError``, whose message a user can act on; anything else is a bug."""
    trace: str = ""


Answer = Any
Function = Callable[[Any], Answer]


class Worker:
    """A process that imports once and then works. Close it, or it ends with its owner."""

    def __init__(self) -> None:
        """Start it; what it imports, it imports with the first piece of work."""
        # spawn: PyBullet and pinocchio hold memory that must not be forked.
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_work, args=(theirs,), daemon=True)
        with _one_thread():
            self._process.start()
        theirs.close()
        self.busy = False

    @property
    def pipe(self) -> Connection:
        """Becomes readable with an answer, and when the process ends."""
        return self._pipe

    @property
    def pid(self) -> int | None:
        """Of the process."""
        return self._process.pid

    def begin(self, function: Function, item: Any, timeout_s: float | None = None) -> None:
        """Give it a piece of work; the function is one of a module that can be imported.

        Raises:
            WorkerDiedError: When it is gone already.
            TimeIsUpError: When it has not taken the piece in time; it was ended.
        """
        with self._speaking(timeout_s):
            self._pipe.send((function, item))
        self.busy = True

    def finish(self, timeout_s: float | None = None) -> Answer | Failed:
        """Wait for the answer.

        Raises:
            WorkerDiedError: When the process ended before it answered.
            TimeIsUpError: When it has not answered yet; it goes on working. One that stopped in
                the middle of its answer was ended.
        """
        with self._speaking(None):
            is_there = self._pipe.poll(timeout_s)
        if not is_there:
            message = f"no answer within {timeout_s:g} s"
            raise TimeIsUpError(message)
        with self._speaking(None if timeout_s is None else WHOLE_S):
            answer = self._pipe.recv()
        self.busy = False
        return answer

    @contextmanager
    def _speaking(self, timeout_s: float | None) -> Iterator[None]:
        """Name a death, and cause it after a while: nothing else ends half a message."""
        late = threading.Event()

        def end() -> None:
            late.set()
            self._process.kill()

        limit = None if timeout_s is None else threading.Timer(timeout_s, end)
        if limit is not None:
            limit.daemon = True
            limit.start()
        try:
            yield
        except (EOFError, OSError) as error:
            if not late.is_set():
                raise WorkerDiedError(status=self._status()) from error
        finally:
            if limit is not None:
                limit.cancel()
        if late.is_set():
            message = f"it took no more, or said no more, for {timeout_s:g} s"
            raise TimeIsUpError(message)

    def _status(self) -> int | None:
        self._process.join(JOIN_S)
        return self._process.exitcode

    def close(self) -> None:
        """End it; one in the middle of something is killed, and leaves no finished file."""
        self._pipe.close()
        if self.busy:
            self._process.kill()
        self._process.join(JOIN_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join(JOIN_S)


def _work(pipe: Connection) -> None:
    """Until the owner closes the pipe, or is gone."""
    # The owner decides when to stop; Ctrl-C reaches every process of the terminal.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(EOFError, OSError):
        while True:
            function, item = pipe.recv()
            pipe.send(do(function, item))


def do(function: Function, item: Any) -> Answer | Failed:
    """Do one piece of work; whatever goes wrong with it is its answer."""
    try:
        return function(item)
    except GstError as error:
        return Failed(message=str(error), known=True)
    except OSError as error:
        if error.errno not in REFUSED:
            return _bug(error)
        where = f" at {error.filename}" if error.filename else ""
        return Failed(message=f"the disk refuses{where}: {error.strerror}", known=True)
    except Exception as error:  # noqa: BLE001  # one bad piece does not stop a thousand
        return _bug(error)


def _bug(error: Exception) -> Failed:
    message = f"internal error: {type(error).__name__}: {error}"
    return Failed(message=message, known=False, trace=traceback.format_exc())


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let a process that is started now have one thread per library."""
    with _starting:
        before = {name: os.environ.get(name) for name in ONE_THREAD}
        os.environ.update(ONE_THREAD)
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
                else:
                    os.environ[name] = value


def _ending(status: int | None) -> str:
    if status is None:
        return "without a word"
    if status >= 0:
        return f"with exit code {status}"
    try:
        name = signal.Signals(-status).name
    except ValueError:
        name = f"signal {-status}"
    memory = ", perhaps by a machine short of memory" if name == "SIGKILL" else ""
    return f"by {name}{memory}"
