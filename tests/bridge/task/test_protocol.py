"""What a study will do is written before its first trial, and cannot change afterwards."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from bridge.errors import InvalidRecordError, UsageError
from bridge.task import protocol
from dashboards.trials import keep_protocol

STUDY = protocol.Protocol(
    tasks=(protocol.StudyTask(task="stack", task_sha256="a" * 64, session_seed=3, starts=20),),
    policies=(
        protocol.PolicyArms(policy="nominal", arms=("without", "with", "control")),
        protocol.PolicyArms(policy="single", arms=("without",)),
    ),
    rounds=5,
    study_seed=1,
)


def test_a_protocol_survives_the_round_trip() -> None:
    coined = protocol.with_coins(STUDY, {"stack": 0.4}, "40 of 100")
    assert protocol.Protocol.from_json(coined.to_json()) == coined
    assert coined.tasks[0].coin == 0.4


def test_it_is_written_once_and_then_has_to_be_the_same(tmp_path: Path) -> None:
    assert protocol.read_protocol(tmp_path) is None
    keep_protocol(tmp_path, STUDY, has_trials=False)
    written = (tmp_path / protocol.FILE_NAME).read_bytes()
    keep_protocol(tmp_path, STUDY, has_trials=True)
    assert (tmp_path / protocol.FILE_NAME).read_bytes() == written
    with pytest.raises(UsageError, match="says something else about: rounds, study_seed"):
        keep_protocol(tmp_path, replace(STUDY, rounds=6, study_seed=2), has_trials=True)
    assert protocol.read_protocol(tmp_path) == STUDY


def test_no_protocol_is_written_after_the_first_trial(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"holds trials and no protocol\.json"):
        keep_protocol(tmp_path, STUDY, has_trials=True)
    assert protocol.read_protocol(tmp_path) is None


@pytest.mark.parametrize(
    ("name", "value"),
    [("policies", []), ("rounds", 0), ("stopping", "when it looks good"), ("tasks", [{}])],
)
def test_what_is_no_protocol_is_refused(name: str, value: object) -> None:
    record = {**json.loads(STUDY.to_json()), name: value}
    with pytest.raises(InvalidRecordError, match=name):
        protocol.Protocol.from_json(json.dumps(record).encode())


DESIGN = replace(
    STUDY,
    primary=protocol.Endpoint(
        kind="difference",
        policy="nominal",
        arm="with",
        against_policy="nominal",
        against_arm="without",
    ),
    secondary=(protocol.Endpoint(kind="agreement", policy="nominal", arm="without", limit=0.7),),
    codes=protocol.blinding_codes(STUDY.policies, 1),
    reasons=("because",),
)


def test_a_design_survives_the_round_trip_with_its_hash() -> None:
    read = protocol.Protocol.from_json(DESIGN.to_json())
    assert read == DESIGN
    assert len(read.sha256) == 64
    assert not read.edited


def test_an_edited_file_is_noticed_and_not_carried_out(tmp_path: Path) -> None:
    keep_protocol(tmp_path, DESIGN, has_trials=False)
    path = tmp_path / protocol.FILE_NAME
    laid_out = json.dumps(json.loads(path.read_bytes()))
    path.write_text(laid_out)  # another layout is no other content
    keep_protocol(tmp_path, STUDY, has_trials=True)
    path.write_text(laid_out.replace('"starts": 20', '"starts": 9'))
    there = protocol.read_protocol(tmp_path)
    assert there is not None
    assert there.edited
    with pytest.raises(UsageError, match="was edited after it was written"):
        keep_protocol(tmp_path, STUDY, has_trials=True)


def test_a_file_older_than_the_hash_is_read(tmp_path: Path) -> None:
    record = json.loads(STUDY.to_json())
    for name in ("sha256", "primary", "secondary", "interval", "alpha", "codes", "reasons"):
        del record[name]
    (tmp_path / protocol.FILE_NAME).write_text(json.dumps(record))
    old = protocol.read_protocol(tmp_path)
    assert old == STUDY
    assert not old.sha256
    assert not old.edited


def test_trials_carry_a_design_out_only_as_it_is(tmp_path: Path) -> None:
    keep_protocol(tmp_path, DESIGN, has_trials=False)
    written = (tmp_path / protocol.FILE_NAME).read_bytes()
    keep_protocol(tmp_path, STUDY, has_trials=False)
    assert (tmp_path / protocol.FILE_NAME).read_bytes() == written
    with pytest.raises(UsageError, match="says something else about: rounds"):
        keep_protocol(tmp_path, replace(STUDY, rounds=6), has_trials=False)


def test_every_start_is_tried_in_all_arms_at_once_and_tasks_are_interleaved() -> None:
    tasks = tuple(replace(STUDY.tasks[0], task=name) for name in ("stack", "push"))
    study = replace(STUDY, tasks=tasks)
    order = study.order()
    assert [trial.number for trial in order] == list(range(1, 2 * 20 * 4 + 1))
    blocks = [order[at : at + 4] for at in range(0, len(order), 4)]
    for block in blocks:
        assert len({(trial.task, trial.start_id) for trial in block}) == 1
        assert {(t.policy, t.arm) for t in block} == {
            *(("nominal", arm) for arm in ("without", "with", "control")),
            ("single", "without"),
        }
    changes = sum(a[0].task != b[0].task for a, b in pairwise(blocks))
    assert changes > 10
    assert order == study.order()
    assert order != replace(study, study_seed=2).order()


def test_no_arm_comes_first_more_often_than_chance_allows() -> None:
    firsts = [protocol.arms_in_order(("without", "with"), 0, seed)[0] for seed in range(2000)]
    assert 900 < firsts.count("with") < 1100


def test_codes_tell_arms_apart_and_do_not_follow_their_order() -> None:
    made = [protocol.blinding_codes(STUDY.policies, seed) for seed in range(20)]
    drawn = {tuple(codes[name] for name in sorted(codes)) for codes in made}
    assert all(len(set(codes)) == 4 for codes in drawn)
    assert len(drawn) > 5
