"""Processes that may die or hang: each message has a deadline, and a death costs one item.

``Worker`` is one process, ``ProcessPool`` several. ``run`` tells of what no process could do
(simulation, which may take its process down); ``map`` does it here (reading and comparing). Neither
pool of the standard library will do: ``concurrent.futures`` breaks as a whole when one process is
killed, and with Python 3.11 waits for ever when that happens while another one is being started;
``multiprocessing.Pool`` waits for what a dead process had.

A process is a new interpreter, for threads and simulators' memory must not be forked, and the
program's own main module stays unloaded there. It talks over a pipe of its own alone, so it ends
with the object that stands for it and with the program that holds that object, however that ends:
the pipe it listens to closes.
"""

import errno
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import traceback
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing.connection import Connection, Pipe, wait
from typing import Any, Protocol, TypeVar, runtime_checkable

from bridge.errors import BridgeError, GstError

ONE_THREAD: Mapping[str, str] = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OMP_WAIT_POLICY": "passive",
}
"""Side by side, libraries that start a thread for each core only get in each other's way."""
REFUSED = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO)
"""What a disk says that is full, or may not be written; everything else is a bug here."""
PATIENCE_S = 60.0
"""For a message that has begun, or with work that should take a tenth of a second."""
JOIN_S = 5.0

Item = TypeVar("Item")
Result = TypeVar("Result")
Answer = Any
Function = Callable[[Any], Answer]


class WorkerLostError(BridgeError):
    """There will be no answer from a process."""


class WorkerDiedError(WorkerLostError):
    """The process that did the work is gone."""

    def __init__(self, *, status: int | None) -> None:
        """Remember its exit code, or minus the number of the signal that ended it."""
        self.status = status
        super().__init__(f"the process that did it ended {_ending(status)}")


class TimeIsUpError(WorkerLostError):
    """The work was not done in time."""


class NoProcessError(BridgeError):
    """The system gives no process to work in."""

    def __init__(self, error: OSError) -> None:
        """Name the reason it gave."""
        super().__init__(
            f"the system gives no further process ({error.strerror or error}). End other programs, "
            "or work in this one: --workers 1."
        )


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


@dataclass(frozen=True, kw_only=True)
class Failed:
    """An exception, as far as it crosses between processes."""

    message: str
    known: bool
    """A ``GstError``, whose message a user can act on; anything else is a bug."""
    trace: str = ""


def do(function: Function, item: Any) -> Answer | Failed:
    """Do one piece of work; whatever goes wrong with it is its answer."""
    try:
        return function(item)
    except GstError as error:
        return Failed(message=str(error), known=True)
    except Exception as error:  # noqa: BLE001  # one bad item does not stop a thousand
        if isinstance(error, OSError) and error.errno in REFUSED:
            where = f" at {error.filename}" if error.filename else ""
            return Failed(message=f"the disk refuses{where}: {error.strerror}", known=True)
        message = f"internal error: {type(error).__name__}: {error}"
        return Failed(message=message, known=False, trace=traceback.format_exc())


class Worker:
    """A process that does one piece of work after another, in the order they were begun."""

    def __init__(self, *, quiet: bool = False) -> None:
        """Start it; what it imports, it imports with the first piece of work."""
        places = os.pathsep.join(place or os.getcwd() for place in sys.path)  # noqa: PTH109
        ours, theirs = Pipe()
        self.outlet: Any = ours
        """Becomes readable with an answer, and when the process ends."""
        with theirs:
            code = f"from {__name__} import _serve; _serve({theirs.fileno()})"
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-c", code],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL if quiet else None,
                pass_fds=[theirs.fileno()],
                env={**os.environ, **ONE_THREAD, "PYTHONPATH": places},
            )
        self._close = weakref.finalize(self, _end, self.process, self.outlet)
        self._num_begun = 0

    @property
    def busy(self) -> bool:
        """Whether an answer is still to come."""
        return self._num_begun > 0

    def begin(self, function: Function, item: Any, timeout_s: float | None = None) -> None:
        """Give it a piece of work; the function is one of a module that can be imported.

        Args:
            timeout_s: For handing it over; ``PATIENCE_S`` without a number.
        """
        with self._within(PATIENCE_S if timeout_s is None else timeout_s, "it took no more"):
            self.outlet.send((function, item))
        self._num_begun += 1

    def finish(self, timeout_s: float | None = None) -> Answer | Failed:
        """Wait for the next answer."""
        if not wait([self.outlet], timeout_s):
            raise TimeIsUpError(f"no answer within {timeout_s:g} s")
        with self._within(PATIENCE_S, "it said no more"):
            answer = self.outlet.recv()
        self._num_begun -= 1
        return answer

    @contextmanager
    def _within(self, limit_s: float, told: str) -> Iterator[None]:
        """End the process where a message to it or from it takes too long."""
        killer = threading.Timer(limit_s, self.process.kill)
        killer.daemon = True
        killer.start()
        try:
            yield
        except (EOFError, OSError, ValueError) as error:  # it ended, or was closed meanwhile
            if killer.finished.is_set():
                raise TimeIsUpError(f"{told} for {limit_s:g} s") from error
            raise WorkerDiedError(status=self._status()) from error
        finally:
            killer.cancel()

    def _status(self) -> int | None:
        with suppress(subprocess.TimeoutExpired):
            return self.process.wait(JOIN_S)
        return None

    def close(self) -> None:
        """End it, also in the middle of something: it then leaves no finished file."""
        self._close()


def _end(process: "subprocess.Popen[bytes]", outlet: "Connection[Any, Any]") -> None:
    process.kill()
    with suppress(OSError):
        process.wait()  # before the pipe closes: another thread may still listen
    outlet.close()


def _serve(descriptor: int) -> None:
    """Work in a process of its own, until its owner is gone."""
    # The owner decides when to stop; Ctrl-C reaches every process of the terminal.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    owner: Connection[Any, Any] = Connection(descriptor)
    arrived: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(owner, arrived), daemon=True).start()
    while True:
        function, item = pickle.loads(arrived.get())
        owner.send(do(function, item))


def _listen(owner: "Connection[Any, Any]", arrived: "queue.SimpleQueue[bytes]") -> None:
    with suppress(EOFError, OSError):
        while True:
            arrived.put(owner.recv_bytes())
    os._exit(0)  # in the middle of anything: nobody waits for it


ATTEMPTS = 2
"""What died twice is not tried again."""
WORTH_S = 3.0
"""Work for which ``map`` starts processes: each needs about one second until it can begin."""
CHUNK_S = 0.1
"""Work that ``map`` hands over at once: short, so that none waits long for another at the end."""
MAX_CHUNK = 100
MOST = 8
"""Processes by default: each takes up to half a gigabyte; more are used when asked for."""


@runtime_checkable
class Runner(Protocol):
    """Does a function for many items; a context manager that ends what it started."""

    def run(
        self, function: Function, items: Sequence[Item], cost: Callable[[Item], float]
    ) -> Iterator[tuple[Item, Answer | Failed]]:
        """Yield every item with what came out, in any order."""

    def __enter__(self) -> "Runner":
        """Use as a context manager."""

    def __exit__(self, *_: object) -> None:
        """End what was started."""


class ProcessPool:
    """Processes side by side; they start once there is work and stay until the end.

    A pool of none does the work here, one item after another in the order they came.
    """

    def __init__(self, size: int, *, prepare: Function | None = None, quiet: bool = False) -> None:
        """Start nothing yet."""
        self._size, self._prepare, self._quiet = size, prepare, quiet
        self.workers: list[Worker] = []

    def _start(self) -> Worker:
        worker = Worker(quiet=self._quiet)
        self.workers.append(worker)
        return worker

    def _lose(self, worker: Worker) -> None:
        worker.close()
        self.workers.remove(worker)

    def run(
        self,
        function: Function,
        items: Sequence[Item],
        cost: Callable[[Item], float],
        patience_s: float | None = None,
    ) -> Iterator[tuple[Item, Answer | Failed]]:
        """See ``Runner``; an item whose process died is tried once more after all others.

        The longest go first, so that no process is left with a long one at the end (Graham 1969).
        """
        if not self._size:
            yield from ((item, do(function, item)) for item in items)
            return
        todo = deque((item, ATTEMPTS) for item in sorted(items, key=cost, reverse=True))
        at_work: dict[Worker, tuple[Item, int]] = {}
        try:
            while todo or at_work:
                while todo and len(at_work) < self._size:
                    self._begin(function, todo, at_work)
                outlets = {worker.outlet: worker for worker in at_work}
                spoke = wait(list(outlets), patience_s)
                if not spoke:
                    for worker in at_work:
                        worker.process.kill()
                for outlet in spoke:
                    worker = outlets[outlet]
                    try:
                        answer = worker.finish()
                        item, _ = at_work.pop(worker)
                    except WorkerLostError as error:
                        self._lose(worker)
                        item, attempts = at_work.pop(worker)
                        if attempts > 1:
                            todo.append((item, attempts - 1))
                            continue
                        answer = lost(str(error))
                    yield item, answer
        finally:
            for worker in at_work:
                self._lose(worker)

    def _begin(
        self,
        function: Function,
        todo: deque[tuple[Item, int]],
        at_work: dict[Worker, tuple[Item, int]],
    ) -> None:
        """Give a free process the next item."""
        worker = next((worker for worker in self.workers if worker not in at_work), None)
        idle = worker is not None
        try:
            worker = worker or self._start()
        except OSError as error:
            if not at_work:
                raise NoProcessError(error) from error
            self._size = len(at_work)
            return
        try:
            worker.begin(function, todo[0][0])
        except WorkerLostError:
            if idle:  # it ended while it had nothing to do: not the item's fault
                self._lose(worker)
                return
        at_work[worker] = todo.popleft()

    def map(
        self, work: Callable[[Item], Result], items: Sequence[Item], *, each_s: float
    ) -> Iterator[Result]:
        """Yield what ``work`` returns for each item, in the order of the items.

        What no process did is done here: it was killed, hung, ran out of memory, or met an
        exception, which is then raised here, where it always was.
        """
        if not self._size or len(items) * each_s < WORTH_S:
            yield from map(work, items)
            return
        size = max(1, min(MAX_CHUNK, round(CHUNK_S / each_s)))
        chunks = [items[at : at + size] for at in range(0, len(items), size)]
        found: dict[int, Answer | Failed] = {}
        at = 0
        with suppress(NoProcessError):
            numbered, job = list(enumerate(chunks)), partial(_do_chunk, work, self._prepare)
            for (number, _), answer in self.run(job, numbered, lambda c: -c[0], PATIENCE_S):
                found[number] = answer
                while at in found:
                    yield from _results(work, chunks[at], found.pop(at))
                    at += 1
        for number in range(at, len(chunks)):
            yield from _results(work, chunks[number], found.get(number))

    def __enter__(self) -> "ProcessPool":
        """Use as a context manager."""
        return self

    def __exit__(self, *_: object) -> None:
        """End all of them at once; what is being done is lost."""
        for worker in self.workers:
            worker.process.kill()
        for worker in list(self.workers):
            self._lose(worker)


ALONE = ProcessPool(0)
"""Works in this process."""


def _do_chunk(
    work: Callable[[Item], Result], prepare: Function | None, chunk: tuple[int, Sequence[Item]]
) -> list[Result]:
    if prepare is not None:
        _once(prepare)
    return [work(item) for item in chunk[1]]


@cache
def _once(prepare: Function) -> None:
    prepare(None)


def _results(
    work: Callable[[Item], Result], chunk: Sequence[Item], answer: Answer | Failed | None
) -> Iterable[Result]:
    return answer if isinstance(answer, list) else map(work, chunk)


def lost(reason: str) -> Failed:
    """What an item comes to whose process died each time."""
    return Failed(message=f"{reason}, {ATTEMPTS} times", known=True)


def cores() -> int:
    """Processors that this program may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on this system
        return os.cpu_count() or 1


def runner_of(workers: int | None) -> Runner:
    """This process, or several: one for each core where nobody said a number."""
    size = workers or default_size()
    return ProcessPool(size) if size > 1 else ALONE


def default_size() -> int:
    """One process for each core, and no more than ``MOST``, where nobody said a number."""
    return min(MOST, cores())
