"""What decides a plan, how far from the edge it is, and which varied quantity goes with it.

Read from a verdict alone, so that gate, ``replay``, pages and Rerun say the same of it.
"""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from bridge.task.verdict import Verdict

LEVEL = 0.95
NEAR_M = 0.01
"""Samples that miss their goal by no more might succeed with a little more."""
SHUFFLES = 999


def what_decides(verdict: Verdict) -> Iterator[str]:
    """What fails, or the goal nearest to its edge; what a little more brings; what else fails."""
    samples = verdict.samples or {"accepted": (), "cause": (), "missed_m": (), "drawn": {}}
    n, causes = len(samples["accepted"]), Counter(samples["cause"])
    lengths = [item for item in verdict.findings if item.get("short_m") is not None]
    if verdict.first_failing not in (None, "terminal"):
        yield verdict.factors()[verdict.first_failing].detail or verdict.first_failing
    elif lengths:
        goal = max(lengths, key=lambda item: item["short_m"])
        short_mm = goal["short_m"] * 1e3
        edge = f"{-short_mm:.0f} mm to spare" if short_mm <= 0 else f"{short_mm:.0f} mm short"
        yield f"{goal['detail']}, {edge}"
    missed = zip(samples["missed_m"], samples["cause"], strict=True)
    near = [each for each in missed if each[0] is not None and each[0] <= NEAR_M]
    if near:
        causes.subtract(cause for _, cause in near)
        more_mm, would = np.ceil(max(near)[0] * 1e3), causes[""] + len(near)
        yield f"with {more_mm:.0f} mm more {would} of {n} varied replays would succeed"
    failed = [(cause, times) for cause, times in causes.most_common() if cause and times]
    yield from (f"{times} fail by {cause}" for cause, times in failed[:1])


def goes_with_success(verdict: Verdict) -> dict[str, float]:
    """What goes with the varied replays' success, in words, and how strongly; strongest first.

    A quantity counts by its value or by how far that is off the middle. Strength: Somers' d, 1
    where every success has more of it than every failure. Only what is beyond chance is named: what
    the strongest of all reaches once in 20 where outcomes are dealt at random (Westfall and Young
    1993). Where there is none, why, at strength 0; nothing where nothing was varied.
    """
    from scipy.stats import rankdata  # noqa: PLC0415  # slow, and only of samples

    samples = verdict.samples
    if samples is None:
        why = ["what they varied was not kept: replay once more"] if verdict.p_success else []
        return dict.fromkeys(why, 0.0)
    good = np.array([each is True for each in samples["accepted"]])
    n, k = len(good), int(good.sum())
    if k in (0, n):
        return {f"all {'succeed' if k else 'fail'}, so none shows what decides": 0.0}
    drawn = np.array([*samples["drawn"].values()])
    values = np.concatenate([drawn, np.abs(drawn - np.median(drawn, axis=1, keepdims=True))])
    ranks = rankdata(values, axis=1)
    weights = np.where(good, 1 / k, -1 / (n - k)) * 2 / n
    dealt = np.random.default_rng(0).permuted(np.tile(weights, (SHUFFLES, 1)), axis=1)
    limit = np.quantile(np.abs(ranks @ dealt.T).max(axis=0), LEVEL)
    strengths = ranks @ weights
    found: dict[str, tuple[str, float]] = {}
    for place in np.argsort(-np.abs(strengths), kind="stable"):
        name, _, unit = [*samples["drawn"]][place % len(drawn)].rpartition(" ")
        if abs(strengths[place]) > limit and name not in found:
            off = " off the middle" if place >= len(drawn) else ""
            yes, no = (_text(float(np.median(values[place][s])), unit) for s in (good, ~good))
            text = f"{name}{off}: {yes} where it succeeds, {no} where not"
            found[name] = text, float(abs(strengths[place]))
    none = f"none of {len(drawn)} varied quantities goes with success more than chance does"
    return dict(found.values()) or {f"{none}; more samples may show one": 0.0}


def _text(value: float, unit: str) -> str:
    return f"{value * 1e3:+.1f} mm" if unit == "m" else f"{value:.2f} {unit}"
