"""The demo goes on where it was interrupted, and never ends well with nothing measured."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import robot_gst
from bridge.episode.metadata import EpisodeInfo, Outcome, to_strings
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError
from bridge.terminal import Output
from dashboards import demo
from dashboards.demo import Trial, groups_of, look
from dashboards.errors import DashboardError
from dashboards.standin_settings import DemoConfig

TASK = "cube_into_box"
QUICK = DemoConfig(quick=True, serve=False)
QUIET = Output(quiet=True)
STARTS = [
    (1000, "without_replanning"),
    (1000, "with_replanning"),
    (1001, "without_replanning"),
    (1001, "with_replanning"),
]


def trial(seed: int, condition: str, task: str = TASK, policy: str = "perturbed") -> Trial:
    return Trial(task=task, policy=policy, start_seed=seed, condition=condition)


def record(
    run: RunFolder,
    name: str,
    *,
    start: tuple[int, str] = (1000, ""),
    outcome: Outcome | None = None,
    stopped_by: str = "command",
    stand_in: bool = True,
    policy: str = "perturbed",
) -> Path:
    """Leave an episode behind as the recorder does."""
    path = run.episodes_dir / f"{name}.mcap"
    with EpisodeWriter(path) as writer:
        info = EpisodeInfo(
            id=name,
            kind=name.split("_")[0],
            task=TASK,
            start_seed=start[0],
            condition=start[1],
            policy=policy,
            stand_in=stand_in,
        )
        writer.describe(info)
        writer.add_metadata("recorder", {"stopped_by": json.dumps(stopped_by)})
        if outcome is not None:
            writer.add_metadata("outcome", to_strings(outcome))
    return path


def record_all(run: RunFolder) -> None:
    record(run, "scan_0001")
    for number, start in enumerate(STARTS, start=1):
        record(run, f"trial_{number:04d}", start=start, outcome=Outcome(result="success", k=1))


def without_commands(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Note the commands instead of running them."""
    asked: list[list[str]] = []

    def command(words: list[str]) -> list[str]:
        asked.append(words)
        said = "print('ready, listens on', flush=True)"
        return [sys.executable, "-c", f"{said}; import time; time.sleep(0.2)"]

    monkeypatch.setattr(demo, "_command", command)
    monkeypatch.setattr(demo.Background, "check", lambda _: None)
    return asked


def test_a_whole_recording_is_kept_and_what_is_missing_is_named(run: RunFolder) -> None:
    record_all(run)
    assert look(run, QUICK) == demo.Recorded(num_known=4)
    (run.episodes_dir / "trial_0003.mcap").unlink()
    found = look(run, QUICK)
    assert found.missing == [trial(*STARTS[2])]
    more = look(run, DemoConfig(task=(TASK,), policies=("perturbed",)))
    third = [(1002, "with_replanning"), (1002, "without_replanning")]
    assert more.missing == [trial(*each) for each in (STARTS[2], *third)]


def test_the_demo_tries_the_tasks_it_is_given() -> None:
    usual = [each for group in groups_of(DemoConfig()) for each in group.trials(DemoConfig())]
    # Two tasks, each by the cell's own planner without and with replanning, and by another without.
    assert len({(each.task, each.policy, each.condition) for each in usual}) == 6
    assert len({each.task for each in usual}) == len({each.policy for each in usual}) == 2
    assert len(usual) == len(set(usual)) == 18
    alone = DemoConfig(task=("cube_into_box",), policies=("perturbed",))
    assert len([each for group in groups_of(alone) for each in group.trials(alone)]) == 6
    quick = [each for group in groups_of(QUICK) for each in group.trials(QUICK)]
    assert {(each.task, each.policy) for each in quick} == {(TASK, "perturbed")}
    own = DemoConfig(quick=True, task=("stack_two_cubes",), policies=("perturbed",))
    assert [(each.chosen, each.policy) for each in groups_of(own)] == [
        ("stack_two_cubes", "perturbed")
    ]


def test_every_task_is_scanned_before_the_scene_is_rebuilt(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = replace(QUICK, task=(TASK, "cube_on_block"))
    record_all(run)
    assert look(run, both).unscanned == ["cube_on_block"]
    asked = without_commands(monkeypatch)
    with pytest.raises(DashboardError, match="there is no scan for cube_on_block"):
        demo.run_demo(run.path, both, QUIET)
    scan, calibrate = asked[1], asked[2]
    assert scan[scan.index("--task") + 1] == "cube_on_block"
    assert scan[scan.index("--trials") + 1] == "0"
    assert calibrate[0] == "calibrate"


@pytest.mark.parametrize(
    ("stopped_by", "outcome"),
    [
        ("the recorder was stopped", None),
        ("disk: No space left on device", None),
        ("command", Outcome(result="unknown", detail="interrupted")),
    ],
)
def test_a_scan_that_was_cut_short_is_recorded_anew(
    run: RunFolder, stopped_by: str, outcome: Outcome | None
) -> None:
    path = record(run, "scan_0001", stopped_by=stopped_by, outcome=outcome)
    found = look(run, QUICK)
    assert found.unscanned == [TASK]
    assert list(found.unusable) == [path]


def test_what_a_killed_recorder_left_is_recorded_anew(run: RunFolder) -> None:
    part = run.episodes_dir / "trial_0001.mcap.part"
    part.write_bytes(b"\x89MCAP0\r\n")
    assert look(run, QUICK).unusable == {part: "its recorder was killed"}


def test_a_folder_that_is_being_recorded_into_is_refused(run: RunFolder) -> None:
    writer = EpisodeWriter(run.episodes_dir / "trial_0001.mcap")
    with pytest.raises(UsageError, match="is being written"):
        look(run, QUICK)
    writer.abandon()


@pytest.mark.parametrize(
    ("config", "named"),
    [
        (DemoConfig(seed=2), "--seed 1"),
        (DemoConfig(task=("sloth_into_basket",)), f"--task {TASK}"),
    ],
)
def test_another_demo_does_not_record_into_the_same_folder(
    run: RunFolder, config: DemoConfig, named: str
) -> None:
    record_all(run)
    with pytest.raises(UsageError, match=named):
        look(run, config)


def test_real_recordings_are_not_mixed_with_simulated_ones(run: RunFolder) -> None:
    record(run, "trial_0001", stand_in=False)
    with pytest.raises(UsageError, match="not from the stand-in cell"):
        look(run, QUICK)


def test_a_trial_set_aside_takes_its_label_and_its_replays_along(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    record_all(run)
    path = run.episodes_dir / "trial_0002.mcap"
    path.unlink()
    record(run, "trial_0002", start=STARTS[1], outcome=Outcome(result="unknown", detail="no gate"))
    run.derived_dir.mkdir()
    (run.derived_dir / "trial_0002.replay.planned.mcap").write_bytes(b"")
    asked = without_commands(monkeypatch)
    with pytest.raises(DashboardError, match=r"1 of 4 trials .* Start the demo again"):
        demo.run_demo(run.path, QUICK, QUIET)
    moved = [each.name for each in run.notes_dir.rglob("trial_0002*")]
    assert sorted(moved) == ["trial_0002.mcap", "trial_0002.replay.planned.mcap"]
    assert [words[0] for words in asked] == ["record", "calibrate", "rebuild", "gate", "publish"]
    assert "--missing" in asked[4]
    assert "--no-scan" in asked[4]


def test_every_interrupted_step_leads_to_the_steps_after_it(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = without_commands(monkeypatch)
    with pytest.raises(DashboardError, match=f"there is no scan for {TASK}"):
        demo.run_demo(run.path, QUICK, QUIET)
    assert [words[0] for words in asked] == [
        "record",
        "publish",
        "calibrate",
        "rebuild",
        "gate",
        "publish",
    ]
    record_all(run)
    asked.clear()
    with pytest.raises(FileNotFoundError):  # nobody evaluated
        demo.run_demo(run.path, QUICK, QUIET)
    assert [words[0] for words in asked] == ["calibrate", "rebuild", "replay", "evaluate"]
    assert "--iterations" in asked[1]
    run.scene_dir.mkdir()
    (run.scene_dir / "scene.json").write_text('{"fit": {}}')
    asked.clear()
    with pytest.raises(FileNotFoundError):
        demo.run_demo(run.path, QUICK, QUIET)
    assert [words[0] for words in asked] == ["replay", "evaluate"]


@pytest.mark.parametrize(
    ("replays", "value", "named"), [(0, 0.5, "no replay"), (1, None, "no trial"), (1, 0.5, "")]
)
def test_nothing_measured_is_not_done(
    run: RunFolder,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    replays: int,
    value: float | None,
    named: str,
) -> None:
    record_all(run)
    without_commands(monkeypatch)
    for folder in (run.derived_dir, run.results_dir):
        folder.mkdir()
    for number in range(replays):
        (run.derived_dir / f"trial_000{number}.replay.planned.mcap").write_bytes(b"")
    measurements = [{"value": value, "reason_if_undefined": "no trial"}]
    (run.results_dir / "results.json").write_text(json.dumps({"measurements": measurements}))
    code = robot_gst.run(["demo", str(run.path), "--quick", "--quiet"])
    printed = capsys.readouterr()
    assert code == (1 if named else 0)
    assert ("Done" in printed.out) == (not named)
    assert named in printed.err


def test_a_trial_without_outcome_stands_in_the_end_with_its_cause(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record_all(run)
    monkeypatch.setattr(demo, "step", lambda *_, **__: None)
    monkeypatch.setattr(demo, "_record", lambda run, config, _: look(run, config))
    monkeypatch.setattr(demo, "_refuse_nothing", lambda *_: None)
    (run.episodes_dir / "trial_0002.mcap").unlink()
    void = Outcome(result="unknown", detail="nothing executed, no verdict (cube not found)")
    record(run, "trial_0002", start=STARTS[1], outcome=void)
    run.scene_dir.mkdir()
    fit = {"fit": {"iterations": 120, "underfitted": True}}
    (run.scene_dir / "scene.json").write_text(json.dumps(fit))
    assert demo.run_demo(run.path, QUICK, Output()) == 0
    printed = capsys.readouterr().out
    assert "trial_0002 has no outcome: nothing executed, no verdict (cube not found)." in printed
    assert "underfitted: its time limit struck after 120 of 1000 images" in printed


def test_ctrl_c_says_how_to_go_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def interrupt(*_: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(demo, "run_demo", interrupt)
    path = str(tmp_path / "my run")
    assert robot_gst.run(["demo", path, "--quick"]) == 130
    expected = f"robot-gst: interrupted; continue with: robot-gst demo '{path}' --quick\n"
    assert capsys.readouterr().err == expected
