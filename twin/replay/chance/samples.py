"""Success as a probability: replays of varied starts and settings, and what they add up to."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from bridge.errors import GstError, UsageError
from bridge.task.record import check_record
from bridge.task.verdict import Verdict
from twin.replay.chance.draw import Variation, draw_variation, sample_rng
from twin.replay.config import ReplayConfig
from twin.replay.place.scene import ReplayScene

SCHEMA_VERSION = 1
LEVEL = 0.95
SLOWER = 1.5
"""A sample may take this much longer than the longest replay so far."""

Replay = Callable[[ReplayScene, ReplayConfig], Verdict]


@dataclass(frozen=True, kw_only=True)
class Sample:
    """What one varied replay said."""

    plan_id: str
    index: int
    variation: Mapping[str, Any]
    accepted: bool | None
    first_failing: str | None
    reason: str | None

    def to_record(self) -> dict[str, Any]:
        """Return the gst sample v1 record, checked against its schema."""
        record = {
            "schema_version": SCHEMA_VERSION,
            "plan_id": self.plan_id,
            "index": self.index,
            "variation": dict(self.variation),
            "accepted": self.accepted,
            "first_failing": self.first_failing,
            "reason": self.reason,
        }
        check_record(record, name="sample")
        return record


def replay_samples(
    replay: Replay,
    scene: ReplayScene,
    config: ReplayConfig,
    *,
    plan_id: str,
    identity: str,
    ends_s: float | None = None,
    expected_s: float = 0.0,
    monotonic: Callable[[], float] = time.monotonic,
) -> tuple[Sample, ...]:
    """Run up to ``config.samples`` varied replays.

    Args:
        replay: Replays one varied start; its verdict counts.
        scene: The nominal start, with covariances.
        config: The nominal settings.
        plan_id: Written into the records.
        identity: Of the start; the same one draws the same variations.
        ends_s: No sample is begun that would not be done by then, on the monotonic clock.
        expected_s: How long one replay takes, from the nominal one.
        monotonic: The clock.

    Raises:
        UsageError: For a kinematic replay, which moves no objects.
    """
    if config.samples and config.mode != "dynamic":
        message = "a kinematic replay moves no objects: it has no success probability. Use dynamic."
        raise UsageError(message)
    samples: list[Sample] = []
    longest_s = expected_s
    for index in range(config.samples):
        started_s = monotonic()
        if ends_s is not None and started_s + SLOWER * longest_s > ends_s:
            break
        variation = draw_variation(sample_rng(config.seed, identity, index), scene, config)
        samples.append(_sample(replay, scene, config, variation, plan_id, index))
        longest_s = max(longest_s, monotonic() - started_s)
    return tuple(samples)


def _sample(
    replay: Replay,
    scene: ReplayScene,
    config: ReplayConfig,
    variation: Variation,
    plan_id: str,
    index: int,
) -> Sample:
    accepted, failing, reason = None, None, None
    try:
        verdict = replay(variation.scene(scene), variation.config(config))
        accepted, failing, reason = verdict.accepted, verdict.first_failing, verdict.reason
    except GstError as error:  # this variation cannot be replayed; the others can
        reason = str(error)
    return Sample(
        plan_id=plan_id,
        index=index,
        variation=variation.to_record(config),
        accepted=accepted,
        first_failing=failing,
        reason=reason,
    )


def with_probability(verdict: Verdict, samples: Sequence[Sample]) -> Verdict:
    """Add the share of accepted samples with its Wilson interval; without samples nothing.

    A sample that could not be decided counts among those that were not accepted.
    """
    if not samples:
        return verdict
    from scipy.stats import binomtest  # noqa: PLC0415  # half a second, and only with samples

    k, n = sum(sample.accepted is True for sample in samples), len(samples)
    interval = binomtest(k, n).proportion_ci(LEVEL, method="wilson")
    low, high = float(interval.low), float(interval.high)
    return replace(verdict, p_success={"value": k / n, "low": low, "high": high, "k": k, "n": n})
