"""Many pieces of work on several processes; a process that dies costs the piece it was doing.

Longest first, so that no process is left with a long piece at the end (Graham 1969). A piece whose
process died is tried once more after all others, and then named as failed.
"""

import multiprocessing.connection
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Protocol, TypeVar, runtime_checkable

from twin.crew.worker import Answer, Failed, Function, Worker, WorkerDiedError, do
from twin.errors import TwinError

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
