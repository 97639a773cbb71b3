"""JSON records checked against their schema: plan, verdict, localisation, outcome, event, drops."""

import json
import math
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from bridge.errors import InvalidRecordError

if TYPE_CHECKING:
    import jsonschema_rs


Record = TypeVar("Record")


@cache
def schema_of(name: str, package: str = "bridge.task") -> Any:
    """Load one of our JSON Schemas, once."""
    return json.loads(resources.files(package).joinpath(f"schemas/{name}.schema.json").read_text())


@cache
def _validator(name: str, package: str) -> "jsonschema_rs.Draft202012Validator":
    import jsonschema_rs  # noqa: PLC0415  # most commands check no record

    return jsonschema_rs.Draft202012Validator(schema_of(name, package))


def check_record(
    record: Mapping[str, Any], *, name: str, package: str = "bridge.task"
) -> Mapping[str, Any]:
    """Return the record if it fits ``schemas/<name>.schema.json``."""
    version, known = record.get("schema_version"), schema_of(name, package)["version"]
    if isinstance(version, int) and version > known:
        raise InvalidRecordError(
            name=name,
            where="schema_version",
            found=f"version {version} is newer than the {known} this reader knows; upgrade",
        )
    for error in find_problems(record, name=name, package=package):
        where = "/".join(str(part) for part in error.instance_path)
        raise InvalidRecordError(name=name, where=where, found=error.message[:300])
    return record


def find_problems(
    record: Mapping[str, Any], *, name: str, package: str = "bridge.task"
) -> list["jsonschema_rs.ValidationError"]:
    """List everything in a record that does not fit ``schemas/<name>.schema.json``."""
    validator = _validator(name, package)
    with suppress(ValueError):  # NumPy's own numbers, text that is no Unicode, or too deep
        if validator.is_valid(record):
            return []
    try:  # numbers that are none are for those to refuse who read and write them
        plain = json.loads(json.dumps(record), parse_constant=lambda _: 0.5)
        return list(validator.iter_errors(plain))
    except (ValueError, TypeError, RecursionError) as error:
        raise InvalidRecordError(name=name, where="", found=str(error)[:300]) from error


def made_of(kind: type[Record], record: Mapping[str, Any], *, name: str) -> Record:
    """Make a dataclass of parsed JSON; fields of later versions are left out."""
    try:
        return msgspec.convert(record, kind)
    except msgspec.ValidationError as error:
        raise InvalidRecordError(name=name, where="", found=str(error)[:300]) from error


def _refuse(text: str) -> float:
    raise ValueError(f"{text} is not a number in JSON")


def _finite(text: str) -> float:
    number = float(text)
    return number if math.isfinite(number) else _refuse(text)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Refuse an object that says something twice: readers differ in which they believe."""
    record = dict(pairs)
    if len(record) < len(pairs):
        twice = Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"{twice[:40]!r} is there twice")
    return record


def parse_record(data: bytes, *, name: str, package: str = "bridge.task") -> dict[str, Any]:
    """Parse JSON bytes and check them."""
    return dict(check_record(load_record(data, name=name), name=name, package=package))


def load_record(data: bytes, *, name: str) -> dict[str, Any]:
    """Parse JSON bytes that hold one object of finite numbers, and check no more than that."""
    try:
        record = json.loads(
            data, parse_constant=_refuse, parse_float=_finite, object_pairs_hook=_once
        )
    except (ValueError, RecursionError) as error:
        raise InvalidRecordError(name=name, where="", found=f"not JSON ({error})") from error
    if not isinstance(record, dict):
        raise InvalidRecordError(name=name, where="", found="not a JSON object")
    return record
