"""The study command: jobs, their order and numbers, what is kept, and what is begun anew."""

import json
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bridge.episode.metadata import EpisodeInfo, Outcome, to_strings
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError
from bridge.task.protocol import read_protocol
from bridge.terminal import Output
from dashboards import demo, trials
from dashboards.standin_settings import TrialsConfig
from dashboards.trials import (
    Job,
    acting_command,
    command_of,
    jobs_of,
    keep_protocol,
    protocol_of,
    run_trials,
)

QUIET = Output(quiet=True)
ARMS = ("without", "with", "control")
STUDY = TrialsConfig(trials=2, policies=("nominal", "single"), arms=ARMS, coin=0.4, seed=9000)


def jobs() -> list[Job]:
    return jobs_of(*protocol_of(STUDY))


def test_every_start_is_a_job_of_each_policy_with_numbers_of_its_own() -> None:
    made = jobs()
    assert len({job.key for job in made}) == len(made) == 4
    assert {job.arms for job in made if job.policy == "nominal"} == {ARMS}
    assert {job.arms for job in made if job.policy == "single"} == {("without",)}
    taken = [job.first_trial + k for job in made for k in range(len(job.arms))]
    assert len(set(taken)) == len(taken)
    assert [job.number for job in made] != sorted(job.number for job in made)
    assert made == jobs()
    others = [jobs_of(*protocol_of(replace(STUDY, study_seed=seed))) for seed in range(1, 5)]
    assert any([job.number for job in each] != [job.number for job in made] for each in others)


def test_all_means_every_task_that_ships() -> None:
    protocol, _ = protocol_of(replace(STUDY, task=("all",)))
    names = [each.task for each in protocol.tasks]
    assert {"cube_into_box", "stack_two_cubes", "sloth_into_basket"} <= set(names)
    assert {"sort_by_colour", "cube_beside_cube", "clear_then_place"} <= set(names)
    assert all(each.coin == 0.4 for each in protocol.tasks)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"coin": None}, "--coin, or --development RUN"),
        ({"arms": ("both",)}, "There are: without, with, control"),
        ({"task": ("fold_towel",)}, "no task named 'fold_towel'"),
    ],
)
def test_what_no_study_can_be_is_refused_before_anything_is_made(
    tmp_path: Path, change: dict[str, Any], words: str
) -> None:
    with pytest.raises(UsageError, match=words):
        run_trials(tmp_path / "run", replace(STUDY, **change), QUIET)
    assert not (tmp_path / "run").exists()


def test_the_command_of_a_job_names_its_start_policy_and_arms() -> None:
    job = next(job for job in jobs() if job.policy == "nominal" and job.start == 1)
    words = command_of(job, STUDY, "tcp/127.0.0.1:7447")
    options = dict(zip(words[3::2], words[4::2], strict=False))
    assert options["--first-start"] == "1"
    assert options["--planner"] == "wire"
    assert options["--coin"] == "0.4"
    assert [words[k + 1] for k, word in enumerate(words) if word == "--study-arms"] == list(ARMS)
    built_in = replace(job, policy="perturbed", arms=("without",), coin=None)
    words = command_of(built_in, STUDY, "tcp/127.0.0.1:7447")
    assert words[words.index("--planner") + 1] == "built_in"
    assert "--coin" not in words
    assert "--retry" not in words
    assert "--retry" in command_of(built_in, replace(STUDY, retry=True), "tcp/127.0.0.1:7447")


def record(
    run: RunFolder,
    job: Job,
    arm: str,
    detail: str | None = None,
    *,
    kind: str = "trial",
    failed: bool = False,
) -> Path:
    number = job.first_trial + job.arms.index(arm)
    follows = (f"retry_of:trial_{number:04d}",) if kind == "retry" else ()
    info = EpisodeInfo(
        id=f"{kind}_{number:04d}",
        kind=kind,
        task=job.task,
        condition="without_replanning",
        policy=job.policy,
        start_id=f"{job.task}/{job.start_seed}",
        start_seed=job.start_seed,
        tags=(f"study_arm:{arm}", *follows),
        stand_in=True,
    )
    path = run.episodes_dir / f"{info.id}.mcap"
    result = "unknown" if detail else "failure" if failed else "success"
    stages = ({"id": "grasp", "result": "failure"},) if failed else ()
    with EpisodeWriter(path) as writer:
        writer.describe(info)
        writer.add_metadata("recorder", {"stopped_by": json.dumps("command")})
        outcome = Outcome(result=result, k=1, detail=detail, stages=stages)
        writer.add_metadata("outcome", to_strings(outcome))
    return path


def test_a_failed_start_is_whole_with_its_retry_and_goes_with_it(run: RunFolder) -> None:
    job, other = (job for job in jobs() if job.policy == "single")
    record(run, job, "without", failed=True)
    assert trials._clear(run, [job], QUIET) == [], "nobody asked for a retry"
    retry = record(run, job, "without", kind="retry")
    assert trials._clear(run, [job], QUIET, retry=True) == []
    alone = record(run, other, "without", failed=True)
    assert trials._clear(run, [job, other], QUIET, retry=True) == [other]
    assert not alone.exists()
    record(run, other, "without", "interrupted")
    unfinished = record(run, other, "without", kind="retry")
    assert trials._clear(run, [job, other], QUIET, retry=True) == [other]
    assert retry.exists()
    assert not unfinished.exists()


def test_only_whole_starts_are_kept_and_the_others_are_begun_anew(run: RunFolder) -> None:
    nominal = [job for job in jobs() if job.policy == "nominal"]
    single = [job for job in jobs() if job.policy == "single"]
    whole = [record(run, nominal[0], arm) for arm in ARMS]
    part = [record(run, nominal[1], "without")]
    cut = [record(run, single[0], "without", "interrupted")]
    left = trials._clear(run, jobs(), QUIET)
    assert {job.key for job in left} == {nominal[1].key, single[0].key, single[1].key}
    assert all(path.exists() for path in whole)
    assert not any(path.exists() for path in [*part, *cut])
    assert {path.name for path in run.notes_dir.rglob("*.mcap")} == {
        path.name for path in [*part, *cut]
    }
    assert trials._clear(run, left, QUIET) == left


URL = "http://127.0.0.1:9/v1"
MODEL = replace(STUDY, policies=("perturbed", "model"), model=URL, model_name="stub")


class Started:
    """A command that seems to run."""

    def wait_until(self, _: Any) -> None:
        """It is ready at once."""


@pytest.mark.parametrize("config", [MODEL, STUDY])
def test_a_model_is_named_to_the_planner_and_to_nothing_else(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch, config: TrialsConfig
) -> None:
    made = jobs_of(*protocol_of(config))
    started: list[list[str]] = []

    @contextmanager
    def running(arguments: list[str], *_: object) -> Iterator[Started]:
        started.append(arguments)
        yield Started()

    monkeypatch.setattr(demo, "running", running)
    with trials._laboratory(run, config, made, 0) as (endpoint, _):
        commands = [*started, *(command_of(job, config, endpoint) for job in made)]
    named = [words[0] for words in commands if "--model" in words or "stub" in " ".join(words)]
    assert named == (["plan"] if config.model else [])
    (plan,) = (words for words in commands if words[0] == "plan")
    asked = ["--model", URL, "--model-name", "stub"] if config.model else []
    assert plan[-len(asked) or len(plan) :] == asked


def test_the_protocol_names_the_model_and_holds_to_it(tmp_path: Path) -> None:
    protocol, _ = protocol_of(MODEL)
    keep_protocol(tmp_path, protocol, has_trials=False)
    there = read_protocol(tmp_path)
    assert there is not None
    assert (there.model_name, there.model_address) == ("stub", URL)
    assert not there.edited
    keep_protocol(tmp_path, protocol, has_trials=True)
    for name, change in (("model_name", {"model_name": "other"}), ("address", {"model": URL[:-3]})):
        other, _ = protocol_of(replace(MODEL, **change))
        with pytest.raises(UsageError, match=name):
            keep_protocol(tmp_path, other, has_trials=True)


@pytest.mark.parametrize("url", ["http://user:secret@host/v1", "http://host/v1?key=secret", "host"])
def test_a_models_address_with_a_secret_gets_into_no_protocol(tmp_path: Path, url: str) -> None:
    with pytest.raises(UsageError, match="address must") as caught:
        run_trials(tmp_path / "run", replace(MODEL, model=url), QUIET)
    assert "secret" not in str(caught.value)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("change", [{"policies": ("nominal",)}, {"model": ""}, {"model_name": ""}])
def test_half_a_model_is_no_study(change: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="--policies model --model URL --model-name NAME"):
        replace(MODEL, **change)


def test_each_task_is_scanned_once_before_its_first_trial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, asked = RunFolder.create(tmp_path / "run"), list[str]()
    monkeypatch.setattr(demo, "running", lambda *_: nullcontext())
    monkeypatch.setattr(demo, "scan_task", lambda task, *_: asked.append(task))
    both = jobs_of(*protocol_of(replace(STUDY, task=("cube_into_box", "stack_two_cubes"))))
    with EpisodeWriter(run.episodes_dir / "scan_0001.mcap") as writer:
        writer.describe(EpisodeInfo(id="scan_0001", kind="scan", task="cube_into_box"))
    trials._scan(run, STUDY, both, QUIET)
    assert asked == ["stack_two_cubes"]


def test_who_acts_is_tried_without_replanning_and_rolled_out(tmp_path: Path) -> None:
    mapping = tmp_path / "droid.toml"
    config = replace(STUDY, policies=("pi0=ws://127.0.0.1:8000", "single"), map=mapping)
    protocol, chosen = protocol_of(config)
    assert [(each.policy, each.arms) for each in protocol.policies] == [
        ("pi0", ("without",)),
        ("single", ("without",)),
    ]
    job = next(job for job in jobs_of(protocol, chosen) if job.policy == "pi0")
    words = command_of(job, config, "tcp/127.0.0.1:7447")
    assert words[words.index("--planner") + 1] == "policy"
    assert words[words.index("--policy") + 1] == "pi0"
    acting = ["rollout", "runs/x", "--policy", "ws://127.0.0.1:8000", "--name", "pi0"]
    assert acting_command(Path("runs/x"), config, "pi0") == [*acting, "--map", str(mapping)]
    assert acting_command(Path("runs/x"), replace(config, map=None), "pi0") == acting
    with pytest.raises(UsageError, match="two that act have the same name"):
        replace(STUDY, policies=("a=m:f", "a=m:g"))
