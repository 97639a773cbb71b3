"""What a study will do is written before its first trial, and cannot change afterwards."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from bridge.errors import InvalidRecordError, UsageError
from bridge.task.protocol import (
    FILE_NAME,
    PolicyArms,
    Protocol,
    StudyTask,
    keep_protocol,
    read_protocol,
    with_coins,
)

STUDY = Protocol(
    tasks=(StudyTask(task="stack", task_sha256="a" * 64, session_seed=3, starts=20),),
    policies=(
        PolicyArms(policy="nominal", arms=("without", "with", "control")),
        PolicyArms(policy="single", arms=("without",)),
    ),
    rounds=5,
    study_seed=1,
)


def test_a_protocol_survives_the_round_trip() -> None:
    coined = with_coins(STUDY, {"stack": 0.4}, "40 of 100")
    assert Protocol.from_json(coined.to_json()) == coined
    assert coined.tasks[0].coin == 0.4


def test_it_is_written_once_and_then_has_to_be_the_same(tmp_path: Path) -> None:
    assert read_protocol(tmp_path) is None
    keep_protocol(tmp_path, STUDY, has_trials=False)
    written = (tmp_path / FILE_NAME).read_bytes()
    keep_protocol(tmp_path, STUDY, has_trials=True)
    assert (tmp_path / FILE_NAME).read_bytes() == written
    with pytest.raises(UsageError, match="says something else about: rounds, study_seed"):
        keep_protocol(tmp_path, replace(STUDY, rounds=6, study_seed=2), has_trials=True)
    assert read_protocol(tmp_path) == STUDY


def test_no_protocol_is_written_after_the_first_trial(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"holds trials and no protocol\.json"):
        keep_protocol(tmp_path, STUDY, has_trials=True)
    assert read_protocol(tmp_path) is None


@pytest.mark.parametrize(
    ("name", "value"),
    [("policies", []), ("rounds", 0), ("stopping", "when it looks good"), ("tasks", [{}])],
)
def test_what_is_no_protocol_is_refused(name: str, value: object) -> None:
    record = {**json.loads(STUDY.to_json()), name: value}
    with pytest.raises(InvalidRecordError, match=name):
        Protocol.from_json(json.dumps(record).encode())
