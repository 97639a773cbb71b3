"""What ``plan RUN`` leaves in a run: the accepted plan, those refused before, a replay of each."""

import json

import numpy as np
import pytest
from planned_start import CUBE as FILE
from planned_start import problem_of_test, write_episode
from verdicts import verdict_of

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.task.plan import Plan
from bridge.task.verdict import Factor, Verdict
from dashboards.rerun_view import export_rrd, run_of
from dashboards.rerun_viewer import episode_of
from twin.plan.config import PlanConfig
from twin.plan.ground.run_tasks import UnderstoodTask
from twin.plan.once import Begun, Planned, Start, plan_once, start_of

SEEN_NS = 5_000_000_000


def verdict(plan: Plan, accepted: bool) -> Verdict:
    terminal = Factor(value=accepted, cause=None if accepted else "inside", bodies=("cube", "box"))
    nearest = {"t_ns": 0, "distance_m": 0.1, "bodies": ["gripper", "box"]}
    return verdict_of(plan.id, terminal=terminal, nearest=nearest)


def planned(run: RunFolder, answers: list[bool]) -> Planned:
    """Rounds of planning, judged as told."""
    path = run.episodes_dir / "trial_0001.mcap"
    write_episode(path, FILE, kind="trial")
    problem = problem_of_test()
    episode = Episode.open(path)
    start = Start(episode=episode, seen_ns=SEEN_NS, localised={}, problem=problem)
    left = iter(answers)
    understood = UnderstoodTask(file=FILE, grounding=None)
    config = PlanConfig(rounds=len(answers))
    begun = Begun(understood=understood, start=start)
    return plan_once(run, begun, lambda plan: verdict(plan, next(left)), config)


@pytest.fixture(scope="module")
def steered(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunFolder, Planned]:
    run = RunFolder.create(tmp_path_factory.mktemp("once") / "run")
    return run, planned(run, [False, True])


def test_the_refused_plan_stays_beside_the_accepted_one(steered: tuple[RunFolder, Planned]) -> None:
    run, done = steered
    refused, accepted = (each.candidate.plan for each in done.attempts)
    assert done.path == run.plans_dir / f"{accepted.id}.json"
    there = {path.name for path in run.plans_dir.iterdir()}
    assert there == {
        f"{refused.id}.refused.json",
        f"{accepted.id}.json",
        f"{refused.id}.replay.mcap",
        f"{accepted.id}.replay.mcap",
    }
    kept = Plan.from_json((run.plans_dir / f"{refused.id}.refused.json").read_bytes())
    assert kept == refused
    assert json.loads(done.path.read_bytes())["parent_id"] == refused.id


def test_a_plan_is_named_by_its_start(steered: tuple[RunFolder, Planned]) -> None:
    _, done = steered
    name = "cube_into_box.trial_0001.nominal.0"
    assert [each.candidate.plan.id for each in done.attempts] == [f"{name}.0", f"{name}.1"]


def test_a_replay_holds_the_plan_its_verdict_and_the_moving_arm(
    steered: tuple[RunFolder, Planned],
) -> None:
    run, done = steered
    for attempt in done.attempts:
        plan = attempt.candidate.plan
        episode = Episode.open(run.plans_dir / f"{plan.id}.replay.mcap")
        assert streams.plans(episode) == [(SEEN_NS, plan)]
        assert [each for _, each in streams.verdicts(episode)] == [attempt.verdict]
        joints = streams.joint_track(episode)
        assert joints.stamps_ns[0] == SEEN_NS
        assert np.abs(np.diff(joints.position, axis=0)).max() > 0
    assert not run.derived_dir.exists(), "evaluation reads what is there"


def test_the_view_shows_the_replay_of_a_plan(
    steered: tuple[RunFolder, Planned], tmp_path_factory: pytest.TempPathFactory
) -> None:
    _, done = steered
    assert done.path is not None
    path = episode_of(done.path)
    out = tmp_path_factory.mktemp("view") / "plan.rrd"
    shown = export_rrd(path, out, run_of(path))
    assert shown.sides == ("replayed/planned/dynamic",)
    assert not [note for note in shown.notes if "plan" in note]


def test_where_plans_begin_is_said(steered: tuple[RunFolder, Planned]) -> None:
    _, done = steered
    assert "  arm: as recorded" in done.lines()
    assert any(line.startswith("    at rest: inside holds") for line in done.explained())
    assert done.to_json()["start"]["arm"] == "as recorded"


def test_an_episode_of_an_empty_run_is_not_looked_up_in_an_empty_list(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    run = RunFolder.create(tmp_path_factory.mktemp("empty") / "run")
    with pytest.raises(UsageError, match=r"no episodes in .*\. Record some"):
        start_of(run, FILE.task(), PlanConfig(episode="trial_0001"))


def test_where_nothing_is_accepted_only_refused_plans_are_kept(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    run = RunFolder.create(tmp_path_factory.mktemp("refused") / "run")
    done = planned(run, [False])
    assert done.path is None
    assert "nothing was sent" in done.lines()[-1]
    assert [path.name for path in run.plans_dir.glob("*.json")] == [
        f"{done.last.candidate.plan.id}.refused.json"
    ]
