"""Records against their schemas: what the library of the product judges, another one does too."""

import json
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from verdicts import verdict_of

import bridge.task
from bridge.errors import InvalidRecordError
from bridge.task.record import check_record

SCHEMAS = Path(str(bridge.task.__file__)).parent / "schemas"
OUTCOME = Draft202012Validator(json.loads((SCHEMAS / "outcome.schema.json").read_text()))


@pytest.mark.parametrize(
    ("field", "value"),
    [("result", "\ud800"), ("k", True), ("k", np.float64(1.5)), ("n", float("inf"))],
)
def test_what_json_cannot_hold_is_judged_as_another_library_does(field: str, value: Any) -> None:
    record = {"schema_version": 1, "result": "success", "unit": "trial", "by": "twin"}
    record |= {"k": 1, "n": 1, field: value}
    if OUTCOME.is_valid(record):
        assert check_record(record, name="outcome") is record
        return
    with pytest.raises(InvalidRecordError, match=f"^.*{field}|surrogates not allowed"):
        check_record(record, name="outcome")


def test_what_is_no_json_and_what_is_too_deep_is_refused() -> None:
    deep: Any = []
    for _ in range(600):
        deep = [deep]
    for odd in (date(2026, 1, 2), deep):
        with pytest.raises(InvalidRecordError, match="outcome"):
            check_record({"schema_version": 1, "result": "success", "k": odd}, name="outcome")


def test_what_does_not_fit_is_named_with_its_place() -> None:
    record = json.loads(verdict_of().to_json())
    assert check_record(record, name="verdict") is record
    record["ik"]["bodies"] = ["arm", 7]
    with pytest.raises(InvalidRecordError, match=r'ik/bodies/1.*7 is not of type "string"'):
        check_record(record, name="verdict")
