"""Read and compare on all cores: this process and others beside it work off one list.

Reading an episode is Python from end to end, so these are processes; ``parallel`` has threads, for
images. Whatever another process did not do, this one does: one that is killed, hangs or runs out
of memory costs time only, and an exception nobody expected is raised here, where it always was.
``docs/decisions/0008-caches-and-processes.md`` says why.
"""

import gc
import io
import os
import pickle
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import wait
from typing import Any, BinaryIO, Generic, TypeVar

from evaluator.child_process import ChildProcess, receive, send

Item = TypeVar("Item")
Result = TypeVar("Result")

WORTH_S = 3.0
"""Work for which one more process is started. It needs about one second until it can begin."""
MAX_PROCESSES = 32
"""Beyond this the one that collects what the others found cannot keep up."""
CHUNK_S = 0.1
"""Work handed over at once: short, so that none waits long for another at the end."""
MAX_CHUNK = 100
AHEAD = 2
"""Chunks handed over before the first is back, so that nobody waits for the next."""
LOOK_S = 0.02
"""A look at what the others have found takes a tenth as long as reading a file."""
MAX_WAIT_S = 60.0
"""For a chunk that should take a tenth of a second; a process that hangs must not hold the rest."""
GONE = (EOFError, OSError, pickle.UnpicklingError, AttributeError, ImportError)
"""What listening to a process raises that ended, or that came to load newer code than ours."""
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Side by side, libraries that start a thread for each core only get in each other's way."""


class Workers:
    """Processes that are started once there is enough to do, and stay for the next list.

    Use as a context manager, which ends them; they end with this object and with the program too.
    """

    def __init__(self, most: int | None = None) -> None:
        """Start nothing yet.

        Args:
            most: Processes at once, this one included; one for each core without it.
        """
        self._most = min(_cores(), MAX_PROCESSES) if most is None else most
        self.started: list[_Worker] = []

    def map(
        self, work: Callable[[Item], Result], items: Sequence[Item], *, each_s: float
    ) -> Iterator[Result]:
        """Yield what ``work`` returns for each item, in the order of the items.

        Args:
            work: A function of a module that can be imported; follows from the item alone.
            items: What to work on; they and the results cross between processes.
            each_s: About how long one takes here [s].
        """
        self._start(int(len(items) * each_s / WORTH_S))
        if not self.started:
            yield from map(work, items)
            return
        todo = _List(work, items)
        next_look_s = 0.0
        try:
            for number in range(len(items)):
                while number not in todo.found:
                    if not todo.is_more or time.monotonic() >= next_look_s:
                        self._exchange(todo)
                        next_look_s = time.monotonic() + LOOK_S
                    todo.do_one()
                yield todo.found.pop(number)
        finally:
            for worker in [worker for worker in self.started if worker.asked]:
                self._lose(worker, todo)

    def _start(self, wanted: int) -> None:
        wanted = min(self._most - 1, wanted)
        try:
            while len(self.started) < wanted:
                self.started.append(_Worker())
        except OSError:  # the system gives no further process
            self._most = 1 + len(self.started)

    def _exchange(self, todo: "_List[Any, Any]") -> None:
        """Take what the others have found, and hand out more; wait only with nothing to do here."""
        streams = {worker.outlet: worker for worker in self.started}
        patience_s = 0.0 if todo.is_more else MAX_WAIT_S
        spoke = wait(list(streams), patience_s) if streams else []
        for stream in spoke:
            worker = streams[stream]
            try:
                answer = worker.answer()
            except GONE:
                self._lose(worker, todo)
            else:
                todo.take(answer)
        if patience_s and not spoke:
            for worker in streams.values():
                self._lose(worker, todo)
        for worker in self.started:
            while worker.is_ready and len(worker.asked) < AHEAD and todo.is_fresh:
                worker.ask(todo.work, todo.items, todo.chunk(1 + len(self.started)))

    def _lose(self, worker: "_Worker", todo: "_List[Any, Any]") -> None:
        worker.end()
        self.started.remove(worker)
        for numbers in worker.asked:
            todo.again.extend(numbers)

    def __enter__(self) -> "Workers":
        """Use as a context manager."""
        return self

    def __exit__(self, *_: object) -> None:
        """End all at once, whatever they are doing."""
        for worker in self.started:
            worker.process.kill()
        for worker in self.started:
            worker.end()
        self.started.clear()


SERIAL = Workers(1)
"""Nobody but this process."""


class _List(Generic[Item, Result]):
    """What is to be done, what was handed out, and what was found."""

    def __init__(self, work: Callable[[Item], Result], items: Sequence[Item]) -> None:
        self.work, self.items = work, items
        self.next = 0
        """The first item that nobody has had."""
        self.again: deque[int] = deque()
        """Items that another process did not do."""
        self.found: dict[int, Result] = {}
        self._done, self._spent_s = 0, 0.0

    @property
    def is_fresh(self) -> bool:
        """Whether there is an item nobody has had."""
        return self.next < len(self.items)

    @property
    def is_more(self) -> bool:
        """Whether this process has something to do."""
        return self.is_fresh or bool(self.again)

    def do_one(self) -> None:
        """Do the next item here, if there is one."""
        if not self.is_more:
            return
        number = self.again.popleft() if self.again else self.chunk_of(1)[0]
        began_s = time.monotonic()
        self.found[number] = self.work(self.items[number])
        self._spent_s += time.monotonic() - began_s
        self._done += 1

    def chunk(self, processes: int) -> range:
        """Take what will last for a moment, judging by what it took here."""
        if not self._done:
            return self.chunk_of(1)
        lasts = int(CHUNK_S * self._done / max(self._spent_s, 1e-6))
        fair = (len(self.items) - self.next) // (AHEAD * processes)
        return self.chunk_of(max(1, min(lasts, fair, MAX_CHUNK)))

    def chunk_of(self, size: int) -> range:
        """Take so many items from those nobody has had."""
        self.next += size
        return range(self.next - size, self.next)

    def take(self, answer: "tuple[range, list[Result] | None] | None") -> None:
        """Note what another process found, or that it did not."""
        if answer is None:
            return
        numbers, results = answer
        if results is None:
            self.again.extend(numbers)
        else:
            self.found.update(zip(numbers, results, strict=True))


class _Worker(ChildProcess):
    """One process as this one sees it."""

    def __init__(self) -> None:
        super().__init__(__name__, ONE_THREAD)
        assert isinstance(self.process.stdout, io.BufferedReader)  # noqa: S101  # for the checker
        self.outlet = self.process.stdout.raw
        """Nothing may be read ahead of what is waited for."""
        self.is_ready = False
        self.asked: deque[range] = deque()

    def ask(self, work: Callable[[Item], object], items: Sequence[Item], numbers: range) -> None:
        self.asked.append(numbers)
        self.send((work, [items[number] for number in numbers]))

    def answer(self) -> tuple[range, list[Any] | None] | None:
        """Return the items and what was found; None when it only says that it can begin."""
        found = pickle.loads(receive(self._read))
        if not self.is_ready:
            self.is_ready = True
            return None
        return self.asked.popleft(), found

    def _read(self, size: int) -> bytes | None:
        """Not for ever: a process may be stopped in the middle of an answer."""
        if not wait([self.outlet], MAX_WAIT_S):
            raise TimeoutError
        found: bytes | None = self.outlet.read(size)
        return found


def serve(next_message: Callable[[], Any], outbox: BinaryIO) -> None:
    """Work until the owner ends; see ``ChildProcess``."""
    import evaluator.compare.summaries  # noqa: F401, PLC0415  # what nearly all work needs

    gc.collect()
    gc.freeze()  # nothing loaded so far is garbage
    # What would be printed is told by the owner, who does it once more.
    warnings.simplefilter("error", append=True)
    send(outbox, None)
    while True:
        work, items = next_message()
        try:
            found = [work(item) for item in items]
        except Exception:  # noqa: BLE001  # the owner will meet it too, and say so
            found = None
        send(outbox, found)


def _cores() -> int:
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on this system
        return os.cpu_count() or 1
