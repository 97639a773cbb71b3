"""What planned, executed and recorded part by first, read once and then kept."""

from pathlib import Path
from typing import Any

import pytest

from bridge.episode import schema
from bridge.episode.writer import EpisodeWriter
from evaluator.cache import FOLDER, SummaryCache
from evaluator.compare import compare_run
from evaluator.run_reader import episodes

START_NS = 5_000_000_000
STEPS = (("grasp", 0, 1_000_000_000), ("place", 1_500_000_000, 3_000_000_000))


def quantity(t_ns: int, attribution: str = "contact") -> dict[str, Any]:
    return {
        "between": ["planned", "recorded"],
        "quantity": "object_position",
        "body": "cube",
        "first_t_ns": t_ns,
        "size": 0.07,
        "limit": 0.02,
        "unit": "m",
        "attribution": attribution,
        "detail": "cube lies 70 mm apart",
    }


def replayed(path: Path, plan_id: str, first: dict[str, Any] | None) -> Path:
    """Write the events and the divergence of a replay, and nothing else."""
    record = {
        "schema_version": 1,
        "plan_id": plan_id,
        "lag_s": None,
        "first": first,
        "quantities": [] if first is None else [first],
        "not_compared": [],
    }
    with EpisodeWriter(path) as writer:
        told = [("execution_started", None, 0)]
        for name, begins_ns, ends_ns in STEPS:
            told += [("stage_started", name, begins_ns), ("stage_ended", name, ends_ns)]
        for kind, stage, t_ns in told:
            stamp_ns = START_NS + t_ns
            event = {"schema_version": 1, "stamp_ns": stamp_ns, "type": kind, "plan_id": plan_id}
            event |= {} if stage is None else {"stage_id": stage}
            writer.write("/cell/event", event, type_name=schema.EVENT, log_time_ns=stamp_ns)
        writer.write(
            "/cell/replay/divergence",
            record,
            type_name=schema.DIVERGENCE,
            log_time_ns=START_NS + 4_000_000_000,
        )
    return path


@pytest.mark.parametrize("attribution", ["tracking", "contact"])
def test_what_parts_first_is_read(tmp_path: Path, attribution: str) -> None:
    path = replayed(tmp_path / "replay.mcap", "p", quantity(0, attribution))
    assert episodes.first_divergence(episodes.Episode.open(path)) == attribution


def test_what_does_not_part_is_empty(tmp_path: Path) -> None:
    path = replayed(tmp_path / "replay.mcap", "p", None)
    assert episodes.first_divergence(episodes.Episode.open(path)) == ""


def test_trials_are_counted_by_step_and_cause_also_from_the_cache(
    maker: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    apart = {"t1": "contact", "t2": "", "t3": "contact"}
    for name in apart:
        maker.trial(name, start_id=name)
        maker.replay(name)
        maker.replay(name, trajectory="executed")

    def found(episode: Any) -> str:
        return apart[episode.derived.source_episode]

    monkeypatch.setattr(episodes, "first_divergence", found)
    once = divergences_of(maker)
    assert once == apart
    monkeypatch.setattr(episodes, "first_divergence", lambda _: pytest.fail("read again"))
    assert divergences_of(maker) == once


def divergences_of(maker: Any) -> dict[str, str]:
    with SummaryCache(maker.run.results_dir / FOLDER) as cache:
        return {row.episode: row.divergence for row in compare_run(maker.run, cache=cache).rows}
