"""Pieces of work put together into tasks, where each task costs something beside its work.

A task of Ray costs processors some 10 ms (measured), which many short pieces together save; single
pieces at the end keep all processors busy (guided self-scheduling; Polychronopoulos and Kuck 1987).
"""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Generic

from twin.crew.pool import Item

TASK_S = 2.0
"""About as long as a task may take; a piece that takes longer is a task of its own."""
SHARE = 4
"""A task takes so many times less than a processor's part of what is left."""


class Batches(Generic[Item]):
    """What is to be done, the longest first, by tasks whose length it learns from those before."""

    def __init__(
        self, items: Sequence[Item], cost: Callable[[Item], float], processors: int
    ) -> None:
        """Have everything to do.

        Args:
            items: The pieces.
            cost: How long one takes, in any unit.
            processors: Among which they are shared.
        """
        self._cost = cost
        self._shares = SHARE * processors
        self._todo = deque(sorted(items, key=cost, reverse=True))
        self._alone: deque[Item] = deque()
        self._spent_s = self._done_cost = 0.0

    def __bool__(self) -> bool:
        """Whether something is left to take."""
        return bool(self._todo or self._alone)

    def take(self) -> list[Item]:
        """Take the next task; alone what was lost, and what comes before any length is known."""
        if self._alone:
            return [self._alone.popleft()]
        most_pieces = len(self._todo) // self._shares
        most_cost = TASK_S * self._done_cost / self._spent_s if self._spent_s > 0 else 0.0
        batch = [self._todo.popleft()]
        total = self._cost(batch[0])
        while len(batch) < most_pieces:
            total += self._cost(self._todo[0])
            if total > most_cost:
                break
            batch.append(self._todo.popleft())
        return batch

    def learn(self, batch: Sequence[Item], seconds: float) -> None:
        """Remember how long a task took where it was done."""
        self._spent_s += seconds
        self._done_cost += sum(self._cost(item) for item in batch)

    def again(self, batch: Sequence[Item]) -> None:
        """Take each piece of a lost task once more, alone: one of them may be to blame."""
        self._alone.extend(batch)
