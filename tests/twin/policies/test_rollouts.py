"""Rollouts from recorded starts: judged, kept, told in a table; policies that fail are marked."""

import re
import sys
from pathlib import Path
from typing import Any

import drawn_run
import numpy as np
import pytest
from scripted_plans import scene_of_test
from scripted_policies import Scripted
from test_in_the_cell import BAD
from test_openpi import Answer, served

from bridge.episode import streams
from bridge.episode.catalogue import label_episode
from bridge.episode.metadata import WITH, EpisodeInfo, Outcome
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.errors import GstError, UsageError
from bridge.exchange.trials_csv import read_trials
from bridge.geometry import se3
from bridge.media.color import encode_png
from bridge.terminal import Output
from evaluator.cache import SummaryCache
from evaluator.compare.run import compare_run, read_run
from twin.policies.check import check_policy, describe_check
from twin.policies.cli import rollout
from twin.policies.config import RolloutConfig
from twin.policies.policy import open_policy
from twin.policies.runs import TABLE, describe_rollouts, roll_out_run

QUIET = Output(quiet=True)


def write_trial(run: RunFolder, name: str, start_id: str, **more: Any) -> None:
    """A further trial, of which only the metadata counts."""
    with EpisodeWriter(run.episodes_dir / f"{name}.mcap") as writer:
        about = {"task": "cube_into_box", "policy": "Scripted", **more}
        writer.describe(EpisodeInfo(id=name, kind="trial", start_id=start_id, **about))


def config(policy: str, **more: Any) -> RolloutConfig:
    address = f"scripted_policies:{policy}"
    return RolloutConfig(policy=address, name=policy, workers=1, **{"max_s": 2.0, **more})


def test_a_policy_that_does_the_task_is_judged_kept_and_compared(run: RunFolder) -> None:
    write_trial(run, "trial_3", "start 1", condition=WITH)  # another condition: not compared
    write_trial(run, "trial_4", "start 1")
    for name, result in (("1", "success"), ("2", "failure"), ("3", "failure"), ("4", "failure")):
        label_episode(run, f"trial_{name}", Outcome(result=result))
    Scripted.seeds.clear()
    found = roll_out_run(run, config("Scripted", max_s=30.0, seed=7, times=2), QUIET)
    assert [row["success"] for row in found["rows"]] == [True] * 4
    assert Scripted.seeds == [7, 8, 7, 8]
    assert "cube_into_box: 4 of 4 rollouts succeed" in describe_rollouts(found)
    trials = read_trials(run.path / TABLE)
    assert [(t.start_id, t.policy, t.recorded, t.sim_planned) for t in trials] == [
        ("start 1", "Scripted", True, True),
        ("start 1", "Scripted", False, True),
        ("start 2", "Scripted", False, True),
        ("start 2", "Scripted", None, True),
    ]
    made = Episode.open(run.derived_dir / found["rows"][0]["file"])
    assert made.derived is not None
    assert made.derived.kind == "rollout"
    assert made.info.policy == "Scripted"
    assert found["rows"][0]["shutters"]["side"]["period_ns"] == 200_000_000  # the recording's
    pictures = [topic for topic in made.topics() if "rendered" in topic]
    assert len(pictures) == 2
    before = {path: path.stat().st_mtime_ns for path in run.derived("*.rollout.*")}
    again = roll_out_run(run, config("Scripted", max_s=30.0, seed=7, times=2), QUIET)
    assert again == found
    assert before == {path: path.stat().st_mtime_ns for path in run.derived("*.rollout.*")}


def test_of_several_settings_the_newest_counts(run: RunFolder) -> None:
    roll_out_run(run, config("Scripted", max_s=30.0), QUIET)
    roll_out_run(run, config("Scripted", max_s=1.0), QUIET)  # too short to do it
    assert [trial.sim_planned for trial in read_trials(run.path / TABLE)] == [False, False]


def test_who_acted_stands_in_the_table_and_another_checkpoint_apart(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_trial(run, "trial_3", "start 1", tags=("checkpoint:b",))
    for name in ("trial_1", "trial_3"):
        label_episode(run, name, Outcome(result="failure"))

    def who(**metadata: str) -> list[tuple[str, int | None, str]]:
        monkeypatch.setattr(Scripted, "metadata", metadata)
        roll_out_run(run, config("Scripted", max_s=1.0, times=2, force=True), QUIET)
        trials = [t for t in read_trials(run.path / TABLE) if t.start_id == "start 1"]
        return [(t.trial_id[-10:], t.recorded, t.checkpoint) for t in trials]

    (_, first, served), (_, second, both) = who(name="scripted")
    assert (first, second) == (False, False)
    assert both == f"b {served}"
    assert served == who(name="scripted")[0][2] != who(name="another")[0][2]
    (_, _, mine), (_, alone, same), (name, recorded, other) = who(checkpoint="c")
    assert mine == same
    assert mine.startswith("c map=")
    assert (alone, recorded, other, name[-9:]) == (None, False, "b", " recorded")
    assert [who(checkpoint="b")[1][place] for place in (1, 2)] == [False, mine.replace("c", "b", 1)]


@pytest.mark.parametrize(
    ("policy", "success", "words"),
    [
        ("still", False, "the middle of cube is .* mm beyond the cavity of box"),
        ("reckless", False, "limits: .* moves at 10.00 rad/s"),
        ("raising", None, "the policy failed: KeyError: 'wrist'"),
    ],
)
def test_what_a_policy_does_wrong_is_told(
    run: RunFolder, policy: str, success: bool | None, words: str
) -> None:
    found = roll_out_run(run, config(policy), QUIET)
    assert [row["success"] for row in found["rows"]] == [success] * 2
    assert all(re.search(words, row["detail"]) for row in found["rows"])
    rows = (run.path / TABLE).read_text().splitlines()[1:]
    assert len(rows) == (0 if success is None else 2)
    made = {path: path.stat().st_mtime_ns for path in run.derived("*.rollout.*")}
    roll_out_run(run, config(policy), QUIET)
    again = {path: path.stat().st_mtime_ns for path in run.derived("*.rollout.*")}
    assert (again == made) is (success is not None)  # what says nothing is asked anew


@pytest.mark.parametrize(("answer", "words"), BAD)
def test_a_bad_answer_marks_its_rollout_as_it_marks_a_trial_in_the_cell(
    run: RunFolder, answer: Answer, words: str
) -> None:
    result, _, words = words.partition(": ")
    with served(answer) as (address, _):
        asked = RolloutConfig(
            policy=address, name="bad", starts="start 1", timeout_s=1.0, workers=1
        )
        (row,) = roll_out_run(run, asked, QUIET)["rows"]
    assert row["success"] is {"unknown": None, "failure": False}[result]
    assert re.match(words, row["detail"])
    assert row["seconds"] < 5.0
    made = streams.joint_track(Episode.open(run.derived_dir / row["file"]))
    assert np.ptp(made.position, axis=0).max() < 0.01  # nothing moved


def test_a_camera_that_is_not_there_marks_every_rollout(run: RunFolder, tmp_path: Path) -> None:
    mapping = tmp_path / "map.toml"
    mapping.write_text('[images.front]\ncamera = "front"\n')
    found = roll_out_run(run, config("still", map=mapping), QUIET)
    assert [(r["task"], r["success"]) for r in found["rows"]] == [("cube_into_box", None)] * 2
    words = r"no camera front in trial_\d; it has: side, wrist"
    assert all(re.fullmatch(words, row["detail"]) for row in found["rows"])


def test_a_camera_that_looks_where_nothing_was_scanned_marks_its_rollout(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    away = se3.look_at(np.array([1.2, -0.8, 0.9]), np.array([9.0, -9.0, 0.9]), np.eye(3)[2])
    monkeypatch.setattr(drawn_run, "T_BASE_SIDE", away)
    urdf, image = scene_of_test().urdf, encode_png(np.full((120, 160, 3), 90, dtype=np.uint8))
    drawn_run.write_recording(run, urdf, "trial_3", images=(image,) * 11, start_id="start 3")
    found = roll_out_run(run, config("still", starts="start 3"), QUIET)
    (row,) = found["rows"]
    assert row["success"] is None
    assert row["detail"] == "camera side sees nothing of the scene: scan what it looks at"
    assert (run.path / TABLE).read_text().count("\n") == 1


def test_the_clock_runs_on_while_it_thinks(run: RunFolder) -> None:
    """Held for 0.5 s before each chunk of 1 s, the plan takes half as long again."""
    prompt = roll_out_run(run, config("Scripted", max_s=30.0), QUIET)["rows"][0]
    late = roll_out_run(run, config("Scripted", max_s=30.0, latency_s=0.5), QUIET)["rows"][0]
    assert late["asked"] == prompt["asked"]
    assert late["seconds"] == pytest.approx(prompt["seconds"] + 0.5 * prompt["asked"], abs=0.6)


def test_starts_are_drawn_as_the_task_says(run: RunFolder) -> None:
    found = roll_out_run(run, config("still", starts="3", seed=5), QUIET)
    assert [row["start_id"] for row in found["rows"]] == ["drawn_5_0", "drawn_5_1", "drawn_5_2"]
    assert len({row["detail"] for row in found["rows"]}) == 3
    for wrong in ("none", "0", "-1", "99999"):
        with pytest.raises(UsageError, match="neither 'recorded', nor a number"):
            roll_out_run(run, config("still", starts=wrong), QUIET)


def test_a_check_explains_one_answer_and_rolls_nothing_out(run: RunFolder) -> None:
    found = check_policy(run, config("Scripted"))
    text = describe_check(found)
    assert "the arm follows at once" in text
    assert "pixels.side: 120 x 160 x 3 uint8" in text
    assert "answered: 10 x 7 float64" in text
    assert "followed for 10 rows, 1.00 s" in text
    assert found["refused"] == ""
    refused = check_policy(run, config("reckless"))
    assert refused["followed"] == 0
    assert "then refused: limits" in describe_check(refused)
    assert run.derived("*.rollout.*") == []


def test_a_file_beside_the_run_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine_alone.py").write_text("def act(observation):\n    return [7.0]\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*sys.path])
    assert open_policy("mine_alone:act", 1.0).infer({}) == [7.0]


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("http://127.0.0.1:1", "neither ws://HOST:PORT nor module:function"),
        ("no_such_module:act", "No module named 'no_such_module'"),
        ("scripted_policies:nothing", "has no attribute 'nothing'"),
        ("scripted_policies", "neither ws://"),
        ("math:pi", "float cannot be asked for actions"),
    ],
)
def test_a_policy_that_is_none_is_told(address: str, words: str) -> None:
    with pytest.raises(GstError, match=words):
        open_policy(address, 1.0)


def test_a_run_without_trials_of_the_task_says_so(run: RunFolder) -> None:
    with pytest.raises(GstError, match="no trial of task 'fold'"):
        roll_out_run(run, config("still", task="fold"), QUIET)


def test_lerobots_policies_are_asked_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    class Acts:
        def select_action(self, observation: dict[str, Any]) -> np.ndarray:
            return np.asarray(observation["agent_pos"])

    monkeypatch.setattr("scripted_policies.Acts", Acts, raising=False)
    policy = open_policy("scripted_policies:Acts", 1.0)
    assert policy.infer({"agent_pos": [1.0]}).tolist() == [1.0]


def test_a_run_is_evaluated_with_its_rollouts(run: RunFolder) -> None:
    """Each recorded trial of a policy has its own rollout beside it, and no table is written."""
    write_trial(run, "trial_4", "start 1")
    write_trial(run, "trial_5", "start 1", policy="another")
    for name, result in (("1", "success"), ("2", "failure"), ("4", "failure"), ("5", "failure")):
        label_episode(run, f"trial_{name}", Outcome(result=result))
    found = roll_out_run(run, config("Scripted", max_s=30.0, times=2), QUIET)
    files = {(row["start_id"], row["number"]): row["file"] for row in found["rows"]}
    trials = {
        trial.row.episode: trial.row for trial in read_run(run, SummaryCache(None), QUIET).trials
    }
    assert {name: row.twin for name, row in trials.items()} == {
        "trial_1": True, "trial_2": True, "trial_4": True, "trial_5": None,
    }  # fmt: skip
    assert trials["trial_1"].twin_replay == files["start 1", 0]
    assert trials["trial_4"].twin_replay == files["start 1", 1]
    assert trials["trial_2"].twin_replay == files["start 2", 0]
    comparison = compare_run(run)
    by_id = {item.id: item for item in comparison.measurements}
    for side, counted in (("recorded", (1, 3)), ("sim_planned", (3, 3))):
        rate = by_id[f"rate.{side}.cube_into_box.-.Scripted"]
        assert (rate.k, rate.n) == counted


def test_another_checkpoint_in_the_cell_ends_the_evaluation(run: RunFolder) -> None:
    write_trial(run, "trial_6", "start 1", tags=("checkpoint:code=other:act map=0123",))
    roll_out_run(run, config("Scripted", max_s=1.0), QUIET)
    with pytest.raises(UsageError, match=r"policy 'Scripted' is map .* in trial_6"):
        compare_run(run)


def test_no_second_command_writes_replays_meanwhile(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path)
    (run.episodes_dir / "trial.mcap").write_bytes(b"")
    with run.alone_in(run.derived_dir), pytest.raises(UsageError, match="another command writes"):
        rollout(run.path, config=RolloutConfig(policy="a:b"))
