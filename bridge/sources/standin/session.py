"""One session of the stand-in cell, from the files to the last episode."""

import contextlib
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from bridge.clock import AnchoredClock
from bridge.episode.metadata import EpisodeInfo, Outcome
from bridge.errors import BridgeError
from bridge.sources.standin.cell import StandinCell, StoppedError
from bridge.sources.standin.cell_file import draw_hidden, load_cell
from bridge.sources.standin.operator import Operator
from bridge.sources.standin.settings import SessionConfig
from bridge.sources.standin.streams import Session, Streams
from bridge.task.find import chosen_task_file
from bridge.terminal import Output


def run_session(
    session: Session,
    config: SessionConfig,
    output: Output,
    *,
    should_stop: Callable[[], bool] = lambda: False,
    start_ns: int | None = None,
) -> dict[str, Any]:
    """Record a scan and trials as the configuration says."""
    task_file = chosen_task_file(config.task)
    task = task_file.task()
    file = load_cell(config.cell_file or task.cell)
    cell = StandinCell(
        file,
        task,
        draw_hidden(file, config.seed, task),
        Streams(session, config.cell),
        seed=config.seed,
        first_start=config.first_start,
        rate_hz=config.rate_hz,
        scale=config.image_scale,
        start_ns=AnchoredClock().now_ns() if start_ns is None else start_ns,
        should_stop=should_stop,
    )
    operator = Operator(cell, session, config, output, task_file)
    stopped = False
    try:
        if config.scan:
            operator.scan()
        operator.trials()
    except StoppedError:
        stopped = True
        operator.abandon(discard=False)
    except Exception:
        with contextlib.suppress(BridgeError):  # the first error is the one to show
            operator.abandon(discard=True)
        raise
    return _summary(operator, config, task.name, stopped=stopped)


@dataclass(frozen=True)
class StandinSource:
    """The stand-in cell as a ``bridge.sources.source.Source``."""

    config: SessionConfig

    def run(self, session: Any, stop: threading.Event, output: Output) -> dict[str, Any]:
        """Record as the configuration says, or until stopped; see ``run_session``."""
        from bridge.wire.clocks import announce  # noqa: PLC0415  # zenoh only when live

        announce(session, self.config.cell, has_clock=False)  # the stamps are simulated time
        return run_session(session, self.config, output, should_stop=stop.is_set)


def _summary(
    operator: Operator, config: SessionConfig, task_name: str, *, stopped: bool
) -> dict[str, Any]:
    objects: dict[str, dict[str, int]] = {}
    for info, outcome in operator.results:
        if outcome.unit == "object":
            sums = objects.setdefault(_treatment(info), {"k": 0, "n": 0})
            sums["k"], sums["n"] = sums["k"] + outcome.k, sums["n"] + outcome.n
    return {
        "stand_in": True,
        "cell": config.cell,
        "task": task_name,
        "seed": config.seed,
        "scan": operator.scanned,
        "outcomes": _counts(operator.results),
        "objects": objects,
        "retries": _counts(operator.retries),
        "unknown": {i.id: o.detail for i, o in operator.results if o.result == "unknown"},
        "stopped": stopped,
    }


def _counts(attempts: list[tuple[EpisodeInfo, Outcome]]) -> dict[str, dict[str, int]]:
    """Per treatment, how attempts ended; new starts after a failure are in no count of trials."""
    counts: dict[str, Counter[str]] = {}
    for info, outcome in attempts:
        counts.setdefault(_treatment(info), Counter())[outcome.result] += 1
    return {treatment: dict(counter) for treatment, counter in counts.items()}


def _treatment(info: EpisodeInfo) -> str:
    return info.study_arm or info.condition


def describe(summary: dict[str, Any]) -> str:
    """A few lines for a person."""
    lines = [f"stand-in cell {summary['cell']}: scan {'recorded' if summary['scan'] else 'none'}"]
    for condition, counts in summary["outcomes"].items():
        total = sum(counts.values())
        listed = ", ".join(f"{count} {result}" for result, count in sorted(counts.items()))
        sums = summary["objects"].get(condition)
        told = f"; {sums['k']} of {sums['n']} objects" if sums else ""
        lines.append(f"  {condition}: {total} trials, {listed}{told}")
    for condition, counts in summary["retries"].items():
        listed = ", ".join(f"{count} {result}" for result, count in sorted(counts.items()))
        lines.append(f"  {condition}: {sum(counts.values())} retried after a failure, {listed}")
    lines += [f"  {name} unknown: {why}" for name, why in summary["unknown"].items()]
    if summary["stopped"]:
        lines.append("  stopped before the end")
    return "\n".join(lines)
