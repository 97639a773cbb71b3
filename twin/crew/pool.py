"""Many pieces of work on several processes; a process that dies costs the piece it was doing.

Longest first, so that no process is left with a long piece at the end (Graham 1969). A piece whose
process died is tried once more after all others, and then named as failed.
"""

import contextlib
import errno
import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, Protocol, TypeVar, runtime_checkable

from bridge.errors import GstError
from twin.errors import TwinError

# --- One process that does one piece of work after another, and may hang or die without harm.
#
# Whoever asked sees an answer, a death or a time that is up, and can start the process again.

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


ATTEMPTS = 2
Item = TypeVar("Item")


@runtime_checkable
class Runner(Protocol):
    """Does a function for many items; a context manager that ends what it started."""

    def run(
        self, function: Function, items: Sequence[Item], cost: Callable[[Item], float]
    ) -> Iterator[tuple[Item, Answer | Failed]]:
        """Yield every item with what came out, in any order.

        Args:
            function: Of a module that can be imported; what it raises becomes ``Failed``.
            items: Records that can be pickled.
            cost: How long an item takes, in any unit; the longest are begun first.
        """

    def __enter__(self) -> "Runner":
        """Use as a context manager."""

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End what was started."""


class Alone:
    """One after another in this process, in the order they came."""

    def run(
        self, function: Function, items: Sequence[Item], cost: Callable[[Item], float]
    ) -> Iterator[tuple[Item, Answer | Failed]]:
        """See ``Runner``."""
        for item in items:
            yield item, do(function, item)

    def __enter__(self) -> "Alone":
        """Nothing was started."""
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing to end."""


class NoProcessError(TwinError):
    """The system gives no process to work in."""

    def __init__(self, error: OSError) -> None:
        """Name the reason it gave."""
        super().__init__(
            f"the system gives no further process ({error.strerror or error}). End other programs, "
            "or work in this one: --workers 1."
        )


@dataclass
class _Piece:
    item: Any
    attempts: int = 0


class Crew:
    """Processes side by side; they start with the first work there is and stay until the end."""

    def __init__(self, size: int) -> None:
        """Have at most so many."""
        self._size = size
        self._idle: list[Worker] = []
        self._at_work: dict[int, tuple[Worker, _Piece]] = {}

    def run(
        self, function: Function, items: Sequence[Item], cost: Callable[[Item], float]
    ) -> Iterator[tuple[Item, Answer | Failed]]:
        """See ``Runner``; with fewer processes where the system gives no more.

        Raises:
            NoProcessError: When it gives none at all.
        """
        todo = deque(_Piece(item) for item in sorted(items, key=cost, reverse=True))
        while todo or self._at_work:
            while todo and len(self._at_work) < self._size:
                self._begin(function, todo)
            yield from self._collect(todo)

    def _begin(self, function: Function, todo: deque[_Piece]) -> None:
        """Give a free worker the next piece."""
        fresh = not self._idle
        try:
            worker = Worker() if fresh else self._idle.pop()
        except OSError as error:
            if not self._at_work:
                raise NoProcessError(error) from error
            self._size = len(self._at_work)
            return
        piece = todo.popleft()
        try:
            worker.begin(function, piece.item)
        except WorkerDiedError:
            if not fresh:  # it ended while it had nothing to do: not the piece's fault
                worker.close()
                todo.appendleft(piece)
                return
        piece.attempts += 1
        self._at_work[worker.pipe.fileno()] = (worker, piece)

    def _collect(self, todo: deque[_Piece]) -> Iterator[tuple[Any, Answer | Failed]]:
        """Wait until something is done, and yield all that is."""
        pipes = [worker.pipe for worker, _ in self._at_work.values()]
        for pipe in multiprocessing.connection.wait(pipes):
            worker, piece = self._at_work.pop(pipe.fileno())  # type: ignore[union-attr]
            try:
                answer = worker.finish()
            except WorkerDiedError as error:
                worker.close()
                if piece.attempts < ATTEMPTS:
                    todo.append(piece)
                    continue
                answer = lost(str(error))
            else:
                self._idle.append(worker)
            yield piece.item, answer

    def __enter__(self) -> "Crew":
        """Use as a context manager."""
        return self

    def __exit__(self, *_: object) -> None:
        """End all of them; work that is being done is lost."""
        for worker in (*self._idle, *(worker for worker, _ in self._at_work.values())):
            worker.close()
        self._idle.clear()
        self._at_work.clear()


def lost(reason: str) -> Failed:
    """What a piece comes to whose process died each time."""
    return Failed(message=f"{reason}, {ATTEMPTS} times", known=True)


# --- How many processes work side by side where nobody said a number.

MOST = 8
"""Each takes up to half a gigabyte; more are used when they are asked for."""


def default_size() -> int:
    """One process for each core that this one may use, and no more than ``MOST``."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on this system
        cores = os.cpu_count() or 1
    return min(MOST, cores)
