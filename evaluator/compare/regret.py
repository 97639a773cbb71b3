"""What it costs to take what the twin ranks first, and which pairs of candidates it confuses."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from evaluator.compare.measure import mean_of, measured
from evaluator.compare.rows import RateGroup
from evaluator.measurements import REGRET, WRONG_BY, WRONG_PAIRS
from evaluator.result import Interval, Measurement
from evaluator.statistics.intervals import LEVEL, normal_quantile
from evaluator.statistics.sequential import ALPHA, Evidence, Stratum

METHOD = "multiple-comparisons-with-the-best"


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Candidates over the tasks that all of them have."""

    kind: str
    """policy or condition."""
    names: tuple[str, ...]
    members: tuple[tuple[RateGroup, ...], ...]
    """Groups of each candidate, in the same order of tasks."""

    def rates(self, side: str) -> list[float]:
        """Mean rate of each candidate, recorded or of the twin."""
        found = [[float(getattr(g, f"{side}_rate") or 0) for g in each] for each in self.members]
        return [sum(each) / len(each) for each in found]


def choice_of(groups: Sequence[RateGroup]) -> Choice | None:
    """Return what is chosen between: policies, else conditions; None where there is one alone."""
    kinds = ("policy", "condition")
    kind = next((k for k in kinds if len({getattr(g, k) for g in groups}) > 1), None)
    if kind is None:
        return None
    other = kinds[1 - kinds.index(kind)]
    names = tuple(dict.fromkeys(getattr(group, kind) for group in groups))
    cells: dict[tuple[str, str], dict[str, RateGroup]] = {}
    for group in groups:
        cells.setdefault((group.task, getattr(group, other)), {})[getattr(group, kind)] = group
    shared = [cell for cell in cells.values() if len(cell) == len(names)]
    if not shared:
        return None
    members = tuple(tuple(cell[name] for cell in shared) for name in names)
    return Choice(kind=kind, names=names, members=members)


def regret_results(groups: Sequence[RateGroup]) -> list[Measurement]:
    """Of groups with both rates: the loss of the twin's first, and the pairs it orders wrongly."""
    choice = choice_of(groups)
    if choice is None:
        return []
    recorded, sim = choice.rates("recorded"), choice.rates("sim")
    first = [place for place, rate in enumerate(sim) if rate == max(sim)]
    words = " or ".join(choice.names[place].replace("_", " ") for place in first)
    loss = 100 * (max(recorded) - sum(recorded[place] for place in first) / len(first))
    count = len(choice.names)
    regret = measured(
        REGRET.of(words=words),
        lambda: (loss, _with_the_best(choice, first)),
        n=count,
        counted=choice.kind,
        reason_without_interval="the number of trials of a group is not known",
        episodes=[name for each in choice.members for group in each for name in group.episodes],
    )
    pairs = [(i, j) for j in range(count) for i in range(j) if recorded[i] != recorded[j]]
    wrong = [(i, j) for i, j in pairs if (recorded[i] - recorded[j]) * (sim[i] - sim[j]) <= 0]
    named = [f"{choice.names[i]} and {choice.names[j]}" for i, j in wrong[:4]]

    are_wrong = [float(pair in wrong) for pair in pairs]
    same = "all candidates have the same recorded rate"
    off = [100 * abs(recorded[i] - recorded[j]) for i, j in wrong]
    shown = f": {', '.join(named).replace('_', ' ')}" if named else ""
    why = "the pairs are these; each has its comparison"
    of_pairs = partial(measured, n=len(pairs), counted="pair", reason_without_interval=why)
    return [
        regret,
        of_pairs(WRONG_PAIRS.of(words=shown), partial(mean_of, are_wrong, "wrong pairs", same)),
        of_pairs(
            WRONG_BY.of(words=shown), partial(mean_of, off, "wrong pairs", "no pair is wrong")
        ),
    ]


def _with_the_best(choice: Choice, first: Sequence[int]) -> Interval | None:
    """Hsu 1984: the loss lies between the largest lower and the largest upper end to the others."""
    z = normal_quantile(1 - ALPHA / (2 * (len(choice.names) - 1)))
    lows, highs = [], []
    for mine in first:
        others = [place for place in range(len(choice.names)) if place != mine]
        ends = [_difference(choice.members[mine], choice.members[place], z) for place in others]
        known = [each for each in ends if each is not None]
        if len(known) < len(ends):
            return None
        lows.append(max(0.0, *(each.low for each in known)))
        highs.append(max(0.0, *(each.high for each in known)))
    return Interval(low=100 * min(lows), high=100 * max(highs), level=LEVEL, method=METHOD)


def _difference(
    first: Sequence[RateGroup], second: Sequence[RateGroup], z: float
) -> Interval | None:
    strata = []
    for a, b in zip(first, second, strict=True):
        if a.unit != "trial" or b.unit != "trial":
            continue  # parts of one trial are not independent
        if a.recorded.k is None or not a.recorded.n or b.recorded.k is None or not b.recorded.n:
            return None
        counts = (a.recorded.k, a.recorded.n), (b.recorded.k, b.recorded.n)
        strata.append(Stratum(first=counts[0], second=counts[1]))
    return Evidence(strata=tuple(strata)).interval(z) if strata else None
