"""The page's time: seconds of source time since the first sample of an episode."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from dashboards.recording import Recording


@dataclass(frozen=True, kw_only=True)
class PageClock:
    """From source stamps [ns] to seconds on the page and back."""

    zero_ns: int
    end_s: float
    recorded_ns: tuple[int, int]
    starts_ns: dict[str, int]
    """When each executed plan started."""

    @staticmethod
    def of(recording: Recording) -> "PageClock":
        """Start at the first sample of the recording."""
        first, last = recording.first_stamp_ns(), recording.last_stamp_ns()
        zero = 0 if first is None else first
        end = zero if last is None else last
        starts = {}
        for _, plan in recording.plans:
            interval = recording.executed_ns(plan.id)
            if interval is not None:
                starts[plan.id] = interval[0]
        return PageClock(
            zero_ns=zero,
            end_s=max((end - zero) * 1e-9, 1e-3),
            recorded_ns=(zero, end),
            starts_ns=starts,
        )

    @property
    def span_s(self) -> tuple[float, float]:
        """The whole time axis."""
        return 0.0, self.end_s

    def clamp(self, t_s: float) -> float:
        """Return the nearest time on the axis."""
        return min(max(t_s, 0.0), self.end_s)

    def seconds(self, stamp_ns: int) -> float:
        """Return the page time of a source stamp."""
        return (stamp_ns - self.zero_ns) * 1e-9

    def stamp_ns(self, t_s: float) -> int:
        """Return the source stamp of a page time."""
        return self.zero_ns + round(t_s * 1e9)

    def all_seconds(
        self, stamps_ns: Int[np.ndarray, " num_samples"]
    ) -> Float[np.ndarray, " num_samples"]:
        """Return the page times of many source stamps."""
        return (np.asarray(stamps_ns) - self.zero_ns) * 1e-9

    def of_plan_time(self, plan_id: str, t_ns: int | None) -> float | None:
        """Return the page time of an instant of a plan; None if it never ran."""
        if t_ns is None or plan_id not in self.starts_ns:
            return None
        return self.seconds(self.starts_ns[plan_id] + t_ns)

    def replay_seconds(
        self, replay: Recording, stamps_ns: Int[np.ndarray, " num_samples"]
    ) -> Float[np.ndarray, " num_samples"] | None:
        """Place a replay's stamps: its own clock starts with the plan unless it kept ours.

        None when the replayed plan was never executed, so that it has no place on this axis.
        """
        first = replay.first_stamp_ns()
        if first is None:
            return None
        if self.recorded_ns[0] <= first <= self.recorded_ns[1]:
            return self.all_seconds(stamps_ns)
        plan_id = replay.derived.plan_id if replay.derived else None
        if plan_id is None or plan_id not in self.starts_ns:
            return None
        return self.all_seconds(np.asarray(stamps_ns) - first + self.starts_ns[plan_id])
