"""Where planned, executed and recorded part first, counted by task, control step and cause."""

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
            writer.write_json("/cell/event", event, type_name=schema.EVENT, log_time_ns=stamp_ns)
        writer.write_json(
            "/cell/replay/divergence",
            record,
            type_name=schema.DIVERGENCE,
            log_time_ns=START_NS + 4_000_000_000,
        )
    return path


INSTANTS = {
    0: "grasp",
    999_999_999: "grasp",
    1_000_000_000: "",
    1_500_000_000: "place",
    2_999_999_999: "place",
    3_500_000_000: "",
}


@pytest.mark.parametrize(("t_ns", "stage"), INSTANTS.items())
def test_an_instant_belongs_to_the_step_that_has_begun_and_not_ended(
    tmp_path: Path, t_ns: int, stage: str
) -> None:
    path = replayed(tmp_path / "replay.mcap", "p", quantity(t_ns))
    found = episodes.first_divergence(episodes.Episode.open(path))
    assert found is not None
    assert (found.stage, found.attribution, found.body) == (stage, "contact", "cube")


def test_what_does_not_part_is_none(tmp_path: Path) -> None:
    path = replayed(tmp_path / "replay.mcap", "p", None)
    assert episodes.first_divergence(episodes.Episode.open(path)) is None


def test_trials_are_counted_by_step_and_cause_also_from_the_cache(
    maker: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    apart = {
        "t1": episodes.FirstDivergence(
            attribution="contact",
            quantity="object_position",
            between="planned and recorded",
            body="cube",
            stage="place",
        ),
        "t2": None,
    }
    apart["t3"] = apart["t1"]
    for name in apart:
        maker.trial(name, start_id=name)
        maker.replay(name)
        maker.replay(name, trajectory="executed")

    def found(episode: Any) -> episodes.FirstDivergence | None:
        return apart[episode.derived.source_episode]

    monkeypatch.setattr(episodes, "first_divergence", found)
    once = divergences_of(maker)
    assert once == apart
    monkeypatch.setattr(episodes, "first_divergence", lambda _: pytest.fail("read again"))
    assert divergences_of(maker) == once


def divergences_of(maker: Any) -> dict[str, episodes.FirstDivergence | None]:
    with SummaryCache(maker.run.results_dir / FOLDER) as cache:
        return {row.episode: row.divergence for row in compare_run(maker.run, cache=cache).rows}
