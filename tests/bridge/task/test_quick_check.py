"""The quick look at a record says yes only where jsonschema finds nothing wrong."""

import copy
import json
import re
from pathlib import Path
from typing import Any

import jsonschema_rs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

import bridge
import evaluator
from bridge.errors import InvalidRecordError
from bridge.task.record import check_record
from bridge.task.verdict import Factor, Verdict
from evaluator.result import Exclusion, Interval, Measurement, Results, Table

SCHEMAS = {
    path.name.removesuffix(".schema.json"): json.loads(path.read_text())
    for package in (bridge, evaluator)
    for path in sorted(Path(str(package.__file__)).parent.rglob("*.schema.json"))
    if path.name != "constraint.schema.json"  # never read by check_record: tests/twin/plan has it
}
CHECKS = {
    name: jsonschema_rs.Draft202012Validator(schema).is_valid for name, schema in SCHEMAS.items()
}
VALIDATORS = {name: Draft202012Validator(schema) for name, schema in SCHEMAS.items()}

scalars = (
    st.none()
    | st.booleans()
    | st.integers(-1, 40)
    | st.sampled_from([0.0, 1.0, 2.5, -3.0])
    | st.sampled_from(["", "a", "success", "planned"])
)
anything = st.recursive(
    scalars,
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from("abc"), inner, max_size=2)
    ),
    max_leaves=6,
)


def _ways(schema: Any) -> list[Any]:
    """The schemas of which one has to fit, where there are several."""
    if "oneOf" in schema:
        return list(schema["oneOf"])
    if "if" in schema and "type" not in schema:  # a name, or numbers
        return [schema["then"], schema["else"]]
    # What an object may be, by its kind: a closed record for each.
    return [part["then"] for part in schema.get("allOf", ()) if "$ref" in part["then"]]


@st.composite
def like(draw: st.DrawFn, schema: Any, root: Any, *, odd: bool) -> Any:
    """Draw a value that fits a schema; with ``odd``, one that here and there may not."""
    if odd and draw(st.integers(0, 14)) == 0:
        return draw(anything)
    if isinstance(schema, bool):
        return draw(anything)
    if "$ref" in schema:
        return draw(like(root["$defs"][schema["$ref"].rpartition("/")[2]], root, odd=odd))
    if "const" in schema:
        return schema["const"]
    if "enum" in schema:
        return draw(st.sampled_from(schema["enum"]))
    if ways := _ways(schema):
        return draw(like(draw(st.sampled_from(ways)), root, odd=odd))
    kinds = schema.get("type", "null")
    kind = draw(st.sampled_from([kinds] if isinstance(kinds, str) else kinds))
    if kind == "object":
        return draw(_object(schema, root, odd=odd))
    if kind == "array":
        least = schema.get("minItems", 0)
        size = draw(st.integers(least, schema.get("maxItems", least + 2)))
        size = max(0, size + draw(st.sampled_from([0] * 9 + [-1, 1]))) if odd else size
        return [draw(like(schema.get("items", True), root, odd=odd)) for _ in range(size)]
    if kind == "string":
        return draw(_text(schema.get("pattern")))
    if kind == "number":
        most, below = schema.get("maximum", 9), schema.get("exclusiveMaximum", 10)
        fitting = [n for n in (0.05, 0.25, 0.5, *range(1, 10)) if n <= most and n < below]
        return draw(st.sampled_from(fitting))
    return draw({"integer": st.integers(1, 9), "boolean": st.booleans(), "null": st.none()}[kind])


def _text(pattern: str | None) -> st.SearchStrategy[str]:
    if pattern is None:
        return st.text("ab", min_size=1)
    return st.sampled_from([t for t in ("ab", "c_1", "0a" * 32) if re.search(pattern, t)])


@st.composite
def _object(draw: st.DrawFn, schema: Any, root: Any, *, odd: bool) -> dict[str, Any]:
    needed = set(schema.get("required", ()))
    if "anyOf" in schema:
        needed |= set(draw(st.sampled_from(schema["anyOf"]))["required"])
    found = {
        name: draw(like(inner, root, odd=odd))
        for name, inner in schema.get("properties", {}).items()
        if name in needed or draw(st.booleans())
    }
    if isinstance(schema.get("additionalProperties"), dict):
        found["other"] = draw(like(schema["additionalProperties"], root, odd=odd))
    if "if" in schema:
        side = "then" if Draft202012Validator(schema["if"]).is_valid(found) else "else"
        for name, inner in schema[side]["properties"].items():
            if name in found and not (odd and draw(st.booleans())):
                both = {**schema["properties"][name], **inner}
                found[name] = draw(like(both, root, odd=odd))
    if odd and found and draw(st.integers(0, 9)) == 0:
        found.pop(draw(st.sampled_from(sorted(found))))
    if odd and draw(st.integers(0, 9)) == 0:
        found["unheard_of"] = draw(anything)
    return found


@given(st.sampled_from(sorted(SCHEMAS)), st.data())
def test_yes_is_never_said_to_what_jsonschema_refuses(name: str, data: st.DataObject) -> None:
    record = data.draw(like(SCHEMAS[name], SCHEMAS[name], odd=True))
    assert not CHECKS[name](record) or VALIDATORS[name].is_valid(record)


@given(st.sampled_from(sorted(SCHEMAS)), st.data())
def test_yes_is_said_to_what_fits(name: str, data: st.DataObject) -> None:
    record = data.draw(like(SCHEMAS[name], SCHEMAS[name], odd=False))
    assert VALIDATORS[name].is_valid(record)
    assert CHECKS[name](record)


def places(record: Any) -> list[tuple[Any, Any]]:
    """Return each container inside a record with each of its keys or indexes."""
    if not isinstance(record, dict | list):
        return []
    keys = sorted(record) if isinstance(record, dict) else range(len(record))
    return [(record, key) for key in keys] + [p for key in keys for p in places(record[key])]


RESULTS = Results(
    run="r",
    source="run",
    stand_in=None,
    measurements=(
        Measurement(
            id="a", value=0.5, unit="1", definition="d", k=1, n=2,
            interval=Interval(low=0.1, high=0.9, level=0.95, method="wilson"), episodes=("a", "b"),
        ),
        Measurement(id="b", value=None, unit="m", definition="d", reason_if_undefined="none"),
    ),
    tables=(Table(id="t", title="t", columns=("a", "b"), rows=(("x", 1),)),),
    exclusions=(Exclusion(episode="c", scope="views", reason="none"),),
).to_record()  # fmt: skip


@settings(max_examples=200)
@given(st.data())
def test_one_change_to_results_that_fit_is_judged_as_jsonschema_does(data: st.DataObject) -> None:
    assert CHECKS["results"](RESULTS)
    spoiled = copy.deepcopy(RESULTS)
    where = places(spoiled["measurements"]) if data.draw(st.integers(0, 4)) else places(spoiled)
    holder, key = data.draw(st.sampled_from(where))
    if data.draw(st.integers(0, 3)):
        holder[key] = data.draw(anything)
    else:
        del holder[key]
    assert CHECKS["results"](spoiled) == VALIDATORS["results"].is_valid(spoiled)


@pytest.mark.parametrize(
    ("field", "value"),
    [("result", "\ud800"), ("k", True), ("k", np.float64(1.5)), ("n", float("inf"))],
)
def test_what_cannot_be_judged_quickly_is_left_to_jsonschema(field: str, value: Any) -> None:
    record = {"schema_version": 1, "result": "success", "k": 1, "n": 1, field: value}
    if VALIDATORS["outcome"].is_valid(record):
        assert check_record(record, name="outcome") is record
        return
    with pytest.raises(InvalidRecordError, match=f"^.*{field}"):
        check_record(record, name="outcome")


def test_what_does_not_fit_is_still_named_by_jsonschema() -> None:
    fine = Factor(value=True)
    verdict = Verdict(
        plan_id="p", trajectory="planned", mode="dynamic", ik=fine, clearance=fine, terminal=fine,
        engine="e", seed=1,
    )  # fmt: skip
    record = json.loads(verdict.to_json())
    assert check_record(record, name="verdict") is record
    record["ik"]["bodies"] = ["arm", 7]
    with pytest.raises(InvalidRecordError, match=r"ik/bodies/1.*7 is not of type 'string'"):
        check_record(record, name="verdict")
