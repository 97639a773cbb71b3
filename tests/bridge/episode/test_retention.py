"""What may be removed when a disk fills, and what never: the unlabelled and the flagged."""

import json
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import robot_gst
from bridge.clock import AnchoredClock
from bridge.episode.catalogue import flag_episode, label_episode, list_episodes
from bridge.episode.catalogue_store import CatalogueQuery, Entry, RetentionPolicy
from bridge.episode.metadata import EpisodeInfo, Outcome
from bridge.episode.retention import DAY_NS, Removal, choose, may_go, remove
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError
from bridge.record.config import DiskConfig, RecorderConfig
from bridge.record.control import parse_info, parse_outcome
from bridge.record.recorder import Recorder

NOW_NS = 1_800_000_000 * 10**9
SUCCESS = Outcome(result="success", k=1, n=1)

entries = st.lists(
    st.builds(
        Entry,
        file=st.uuids().map(lambda name: f"{name}.mcap"),
        id=st.just("x"),
        kind=st.sampled_from(("trial", "scan", "probe", "imported")),
        outcome=st.sampled_from(("success", "failure", "unknown")),
        flag=st.sampled_from(("", "", "why")),
        error=st.sampled_from(("", "", "broken")),
        tags=st.sampled_from(((), ("keep",), ("x",))),
        start_ns=st.integers(NOW_NS - 100 * DAY_NS, NOW_NS),
        size_bytes=st.integers(0, 10**9),
    ),
    max_size=20,
    unique_by=lambda entry: entry.file,
)
limits = st.none() | st.floats(0, 2000)


@given(entries, limits, limits, limits)
def test_law_what_nobody_labelled_or_somebody_flagged_never_goes(
    found: list[Entry], quota_mb: float | None, days: float | None, size_mb: float | None
) -> None:
    policy = RetentionPolicy(quota_mb=quota_mb, older_than_days=days, larger_than_mb=size_mb)
    gone = choose(found, policy, now_ns=NOW_NS)
    assert len({each.entry.file for each in gone}) == len(gone)
    for entry, _ in gone:
        assert (entry.kind, entry.flag, entry.error) == ("trial", "", "")
        assert entry.outcome in ("success", "failure")
        assert "keep" not in entry.tags
    if policy.is_empty:
        assert not gone
    if quota_mb is not None:
        left = [each for each in found if each not in [entry for entry, _ in gone]]
        is_met = sum(each.size_bytes for each in left) <= quota_mb * 1e6
        assert is_met or not any(may_go(each, policy) for each in left)
        if days is None and size_mb is None and gone:  # no more than it takes, the oldest first
            before = [entry for entry, _ in gone[:-1]]
            rest = [each for each in found if each not in before]
            assert sum(each.size_bytes for each in rest) > quota_mb * 1e6
            kept_ns = [each.start_ns for each in left if may_go(each, policy)]
            assert max(entry.start_ns for entry, _ in gone) <= min(kept_ns, default=NOW_NS)


def test_age_and_size_must_both_hold_where_both_are_given() -> None:
    old = Entry(file="a", id="a", kind="trial", outcome="failure", start_ns=NOW_NS - 40 * DAY_NS)
    found = [
        replace(old, size_bytes=5_000_000),
        replace(old, file="b", size_bytes=500_000_000),
        replace(old, file="c", size_bytes=500_000_000, start_ns=NOW_NS),
    ]

    def gone(**limits: float) -> list[str]:
        policy = RetentionPolicy(**limits)
        return [entry.file for entry, _ in choose(found, policy, now_ns=NOW_NS)]

    assert gone(older_than_days=30.0) == ["a", "b"]
    assert gone(larger_than_mb=100.0) == ["b", "c"]
    assert gone(older_than_days=30.0, larger_than_mb=100.0) == ["b"]


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    return RunFolder.create(tmp_path / "monday")


Record = Callable[..., None]


@pytest.fixture
def record(run: RunFolder) -> Record:
    def write(name: str, *, outcome: Outcome | None = None, **about: object) -> None:
        with EpisodeWriter(run.episodes_dir / f"{name}.mcap") as writer:
            info = EpisodeInfo(id=name, kind="trial", **about)  # type: ignore[arg-type]
            writer.describe(info)
            event = {"schema_version": 1, "stamp_ns": 1, "type": "note", "text": "x" * 20_000}
            at_ns = NOW_NS + len(run.episodes())
            writer.write_json("/lab/event", event, type_name="gst/Event", log_time_ns=at_ns)
            if outcome is not None:
                from bridge.episode.metadata import to_strings

                writer.add_metadata("outcome", to_strings(outcome))

    return write


def robot_gst_json(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, object]:
    assert robot_gst.run([*words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_prune_lists_first_and_removes_when_told(
    run: RunFolder, record: Record, capsys: pytest.CaptureFixture[str]
) -> None:
    record("old", outcome=SUCCESS)
    record("kept", outcome=SUCCESS)
    record("unlabelled")
    record("labelled_later")
    label_episode(run, "labelled_later", Outcome(result="failure"))
    flag_episode(run, "kept", "for the paper")
    words = ("prune", str(run.path), "--quota-mb", "0")
    found = robot_gst_json(capsys, *words)
    assert [each["id"] for each in found["episodes"]] == ["old", "labelled_later"]  # type: ignore[attr-defined]
    assert len(run.episodes()) == 4
    robot_gst_json(capsys, *words, "--delete")
    assert [path.stem for path in run.episodes()] == ["kept", "unlabelled"]
    assert not (run.notes_dir / "labelled_later.outcome.json").exists()
    lines = (run.notes_dir / "removed.jsonl").read_text().splitlines()
    assert [json.loads(line)["id"] for line in lines] == ["old", "labelled_later"]
    assert robot_gst_json(capsys, *words, "--delete")["episodes"] == []


def test_a_flag_is_set_shown_searched_and_taken_away(
    run: RunFolder, record: Record, capsys: pytest.CaptureFixture[str]
) -> None:
    record("a", outcome=SUCCESS)
    record("b", outcome=SUCCESS)
    assert robot_gst.run(["label", str(run.path), "a", "--flag", "odd wrist"]) == 0
    assert robot_gst.run(["ls", str(run.path)]) == 0
    assert "flagged: odd wrist" in capsys.readouterr().out
    flagged = list_episodes(run)
    assert [entry.flag for entry in flagged] == ["odd wrist", ""]
    removal = Removal(replace(flagged[0], flag=""), "")  # it was flagged since it was listed
    assert not remove(run, removal, now_ns=time.time_ns())
    assert robot_gst.run(["label", str(run.path), "a", "--unflag"]) == 0
    assert [entry.flag for entry in list_episodes(run)] == ["", ""]
    assert robot_gst.run(["label", str(run.path), "a"]) == 2
    (run.notes_dir / "a.flag.json").write_text("{")
    assert list_episodes(run)[0].flag == "flagged"  # rather kept than lost


def test_a_policy_that_says_nothing_or_the_wrong_labels_is_refused(
    run: RunFolder, record: Record, capsys: pytest.CaptureFixture[str]
) -> None:
    record("a", outcome=SUCCESS)
    assert robot_gst.run(["prune", str(run.path), "--delete"]) == 2
    assert "say what may go" in capsys.readouterr().err
    with pytest.raises(UsageError, match="only episodes labelled success or failure"):
        RetentionPolicy(outcome=("unknown",))


def test_a_recorder_keeps_its_quota(run: RunFolder) -> None:
    config = RecorderConfig(disk=DiskConfig(quota_mb=1, footer_mb=0, min_free_mb=0))
    recorder = Recorder(run, now_ns=AnchoredClock().now_ns, config=config)
    for number, result in enumerate(("success", None, "failure", "failure")):
        recorder.start(parse_info(f"t{number}", {"cell": "lab"}))
        recorder.mark(os.urandom(300_000).hex())
        outcome = None if result is None else parse_outcome({"result": result})
        recorder.stop(outcome=outcome)
    recorder.close()
    sizes = {path.stem: path.stat().st_size for path in run.episodes()}
    assert "t1" in sizes  # nobody labelled it
    assert "t3" in sizes or sum(sizes.values()) <= 1_000_000
    assert "t0" not in sizes
    assert any(text.startswith("removed t0 (success)") for text in recorder.news)


def test_runs_are_searched_by_words_cell_and_date(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, cell in (("monday", "lab"), ("2026/tuesday", "Other")):
        run = RunFolder.create(tmp_path / "runs" / name)
        for number in range(2):
            with EpisodeWriter(run.episodes_dir / f"t{number}.mcap") as writer:
                writer.describe(
                    EpisodeInfo(
                        id=f"t{number}",
                        kind="trial",
                        cell=cell,
                        instruction=f"Put the RED cube {number} into the box",
                        tags=("wrist",) if number else (),
                    )
                )
                event = {"schema_version": 1, "stamp_ns": 1, "type": "note", "text": ""}
                at_ns = NOW_NS + number * DAY_NS
                writer.write_json("/e", event, type_name="gst/Event", log_time_ns=at_ns)

    def found(*words: str) -> list[str]:
        listed = robot_gst_json(capsys, "ls", str(tmp_path / "runs"), *words)
        rows: list[dict[str, str]] = listed["episodes"]  # type: ignore[assignment]
        return [f"{Path(row['run']).name}/{row['id']}" for row in rows]

    assert found() == ["tuesday/t0", "monday/t0", "tuesday/t1", "monday/t1"]
    assert found("--text", "cube red 1") == ["tuesday/t1", "monday/t1"]
    assert found("--cell", "lab") == ["monday/t0", "monday/t1"]
    assert found("--text", "other", "--tag", "wrist") == ["tuesday/t1"]
    assert found("--sort", "start", "--reverse", "--limit", "1") == ["monday/t1"]
    assert found("--text", "100%") == []
    assert robot_gst.run(["ls", str(tmp_path / "runs")]) == 0
    assert "2026/tuesday/t0" in capsys.readouterr().out
    assert robot_gst.run(["ls", str(tmp_path)]) == 0  # two levels deeper
    (tmp_path / "empty").mkdir()
    assert robot_gst.run(["ls", str(tmp_path / "empty")]) == 2


def test_a_query_of_several_runs_orders_what_is_unknown_first() -> None:
    key = CatalogueQuery(sort="lost").sort_key
    known = [Entry(file=str(lost), id="x", lost=lost) for lost in (3, None, 1)]
    assert [entry.lost for entry in sorted(known, key=key)] == [None, 1, 3]
