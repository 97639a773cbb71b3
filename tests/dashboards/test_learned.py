"""What a study takes over from another run: only of its own laboratory, never of its own starts."""

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.task.protocol import SEEDS_PER_SESSION, read_protocol
from bridge.terminal import Output
from dashboards.learned import Learned, learned_in
from dashboards.standin_settings import TrialsConfig
from dashboards.trials import jobs_of, keep_protocol, protocol_of, run_trials
from twin.scene.store.calibration import write_part, write_physics

SESSION = 9000
STUDY = TrialsConfig(task=("cube_into_box", "cube_on_block"), trials=3, seed=SESSION)
PROTOCOL, CHOSEN = protocol_of(STUDY)


def source(task: str, start: int, **changed: object) -> dict[str, Any]:
    known = next(each for each in PROTOCOL.tasks if each.task == task)
    return {
        "sha256": "0" * 64,
        "success": True,
        "cell": "standin",
        "task_sha256": known.task_sha256,
        "start_seed": SESSION * SEEDS_PER_SESSION + start,
        **changed,
    }


def learning(
    folder: Path, sources: Mapping[str, list[dict[str, Any]]], **others: object
) -> RunFolder:
    run = RunFolder.create(folder / "learn")
    tasks = {
        name: {
            "draws": [],
            "effective_draws": 1.0,
            "sources": {f"trial_{k:04d}": each for k, each in enumerate(some)},
        }
        for name, some in sources.items()
    }
    write_part(run, "posterior", {"tasks": tasks, "skipped": {}, **others})
    return run


def of_other_starts(**changed: object) -> dict[str, list[dict[str, Any]]]:
    names = [each.task for each in PROTOCOL.tasks]
    return {name: [source(name, start, **changed) for start in (100, 101)] for name in names}


def test_a_study_uses_what_was_learned_from_other_starts_and_says_so(tmp_path: Path) -> None:
    run = learning(tmp_path, of_other_starts())
    learned = learned_in(run, PROTOCOL)
    content = (run.scene_dir / "calibration.json").read_bytes()
    assert learned.sha256 == hashlib.sha256(content).hexdigest()
    protocol = learned.named_in(PROTOCOL)
    assert "run learn" in protocol.calibration_from
    assert "cube_into_box 2, cube_on_block 2" in protocol.calibration_from
    study = RunFolder.create(tmp_path / "study")
    keep_protocol(study.path, protocol, has_trials=False)
    assert read_protocol(study.path) == protocol
    for _ in range(2):  # as when a study goes on
        learned.put_into(study)
        assert (study.scene_dir / "calibration.json").read_bytes() == content
    other = Learned(content=content + b" ", words="")
    with pytest.raises(UsageError, match="another one"):
        other.put_into(study)
    with pytest.raises(UsageError, match="calibration_sha256"):
        keep_protocol(study.path, other.named_in(PROTOCOL), has_trials=True)
    with pytest.raises(UsageError, match="calibration_sha256"):
        keep_protocol(study.path, PROTOCOL, has_trials=True)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (
            {"start_seed": SESSION * SEEDS_PER_SESSION + 2},
            "start 2 of cube_into_box.*--first-start",
        ),
        ({"start_seed": (SESSION + 1) * SEEDS_PER_SESSION + 100}, "session 9001.*session 9000"),
        ({"start_seed": None}, "does not say from which start"),
        ({"task_sha256": "f" * 64}, "another version of task cube_into_box"),
        ({"cell": "lab"}, "cell 'lab'"),
    ],
)
def test_what_would_not_be_fair_is_refused_before_anything_is_made(
    tmp_path: Path, changed: dict[str, object], words: str
) -> None:
    sources = of_other_starts()
    sources["cube_into_box"].append(source("cube_into_box", 102, **changed))
    run = learning(tmp_path, sources)
    with pytest.raises(UsageError, match=words):
        run_trials(tmp_path / "study", replace(STUDY, calibration=run.path), Output(quiet=True))
    assert not (tmp_path / "study").exists()


def test_the_first_start_after_the_studys_last_is_not_its_own(tmp_path: Path) -> None:
    sources = of_other_starts()
    sources["cube_into_box"].append(source("cube_into_box", STUDY.trials))
    assert learned_in(learning(tmp_path, sources), PROTOCOL)


def test_what_learned_nothing_of_a_task_or_not_by_task_is_refused(tmp_path: Path) -> None:
    plain = RunFolder.create(tmp_path / "plain")
    with pytest.raises(UsageError, match="no posterior: robot-gst calibrate"):
        learned_in(plain, PROTOCOL)
    sources = of_other_starts()
    del sources["cube_on_block"]
    with pytest.raises(UsageError, match="no usable trial of cube_on_block"):
        learned_in(learning(tmp_path / "part", sources), PROTOCOL)
    old = RunFolder.create(tmp_path / "old")
    write_part(old, "posterior", {"draws": [], "sources": {}})
    with pytest.raises(UsageError, match="all tasks together"):
        learned_in(old, PROTOCOL)
    fitted = learning(tmp_path / "fitted", of_other_starts())
    write_physics(fitted, {"promoted": True, "identified": {}, "id": "0"})
    with pytest.raises(UsageError, match="identified physics"):
        learned_in(fitted, PROTOCOL)


def test_runs_of_other_first_starts_share_no_start() -> None:
    later, _ = protocol_of(replace(STUDY, first_start=100))
    seeds = [
        {job.start_seed for job in jobs_of(protocol, CHOSEN)} for protocol in (PROTOCOL, later)
    ]
    first = SESSION * SEEDS_PER_SESSION
    assert seeds == [{first, first + 1, first + 2}, {first + 100, first + 101, first + 102}]
    assert {job.start for job in jobs_of(later, CHOSEN)} == {100, 101, 102}
    with pytest.raises(UsageError, match="first"):
        replace(STUDY, first_start=SEEDS_PER_SESSION - 2)
