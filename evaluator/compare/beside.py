"""Progress and time to success of two candidates, compared beside their success.

Of each pair it is asked who did more of the task, or who was done sooner: a failure is never done.
So a pair is won, lost or level, which is counted as pairs of outcomes are
(``evaluator/statistics/sequential.py``) and holds at any look, too. A pair is one start that both
tried, else one trial of each in their order.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from statistics import mean, median

from evaluator.compare.rows import TrialRow

Value = Callable[[TrialRow], float | None]


def _progress(row: TrialRow) -> float | None:
    """Part of the task that was done; nothing of a trial that has no outcome."""
    if row.progress is not None:
        return row.progress
    if row.recorded is None:
        return 0.0
    return row.k / row.n if row.unit != "trial" and row.k is not None and row.n else None


def _promptness(row: TrialRow) -> float | None:
    """The sooner the more; None where nobody knows how long a success took."""
    if not row.recorded:
        return -math.inf
    return None if row.time_s is None else -row.time_s


@dataclass(frozen=True)
class Measure:
    """What is compared beside success."""

    name: str
    value: Value
    won: str
    lost: str
    unit: str
    scale: float
    of_all: Callable[[Sequence[float]], float]

    def is_recorded(self, rows: Sequence[TrialRow]) -> bool:
        """Whether it says more than the outcomes of these do."""
        return any(w is not None and abs(w) not in (0, 1, math.inf) for w in map(self.value, rows))

    def shown(self, rows: Sequence[TrialRow]) -> str:
        """Mean or median of the trials that have one."""
        found = [w for w in map(self.value, rows) if w is not None and not math.isinf(w)]
        return f"{self.scale * self.of_all(found):.3g}{self.unit}" if found else "none"

    def pairs(
        self, sides: Iterable[tuple[bool, TrialRow]]
    ) -> Iterator[tuple[TrialRow, TrialRow, float]]:
        """Pair trials in their order: of the first, of the second, above 0 where the second won."""
        waiting: dict[tuple[str, str, bool], list[TrialRow]] = {}
        for is_second, row in sides:
            mine, key = self.value(row), (row.task, row.start_id or "")
            partners = waiting.get((*key, not is_second))
            if mine is not None and not partners:
                waiting.setdefault((*key, is_second), []).append(row)
            elif mine is not None and partners:
                other = partners.pop(0)
                theirs = self.value(other) or 0.0
                won = 0.0 if mine == theirs else mine - theirs if is_second else theirs - mine
                yield (other, row, won) if is_second else (row, other, won)


MEASURES = (
    Measure("progress", _progress, "more", "less", " %", 100.0, mean),
    Measure("time to success", _promptness, "sooner", "later", " s", -1.0, median),
)
