"""JSON records checked against their schema: plan, verdict, localisation, outcome, event, drops."""

import json
import math
from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from bridge.errors import InvalidRecordError

if TYPE_CHECKING:
    import jsonschema_rs
    from jsonschema import Draft202012Validator
    from jsonschema.exceptions import ValidationError


Record = TypeVar("Record")


@cache
def _schema(package: str, path: str) -> Any:
    """Load one of our JSON Schemas, once."""
    return json.loads(resources.files(package).joinpath(path).read_text())


@cache
def _quick(package: str, path: str) -> "jsonschema_rs.Draft202012Validator":
    import jsonschema_rs  # noqa: PLC0415  # most commands check no record

    return jsonschema_rs.Draft202012Validator(_schema(package, path))


def _is_sure(record: Mapping[str, Any], package: str, path: str) -> bool:
    """Whether a record surely fits.

    ``jsonschema`` takes a quarter of a millisecond for a record of twenty fields, so that it is
    asked only where this says no: it alone says what does not fit and where.
    """
    try:
        return _quick(package, path).is_valid(record)
    except ValueError:  # text that is no Unicode, NumPy's own numbers, or too deep
        return False


@cache
def _validator(package: str, path: str) -> "Draft202012Validator":
    from jsonschema import Draft202012Validator  # noqa: PLC0415  # only what does not fit needs it

    return Draft202012Validator(_schema(package, path))


def check_record(
    record: Mapping[str, Any], *, name: str, package: str = "bridge.task"
) -> Mapping[str, Any]:
    """Return the record if it fits ``schemas/<name>.schema.json``."""
    path = f"schemas/{name}.schema.json"
    version = record.get("schema_version")
    known = _schema(package, path)["version"]
    if isinstance(version, int) and version > known:
        raise InvalidRecordError(
            name=name,
            where="schema_version",
            found=f"version {version} is newer than the {known} this reader knows; upgrade",
        )
    if _is_sure(record, package, path):
        return record
    error = next(iter(_validator(package, path).iter_errors(record)), None)
    if error is not None:
        where = "/".join(str(part) for part in error.absolute_path)
        raise InvalidRecordError(name=name, where=where, found=error.message[:300])
    return record


def find_problems(
    record: Mapping[str, Any], *, name: str, package: str = "bridge.task"
) -> list["ValidationError"]:
    """List everything in a record that does not fit ``schemas/<name>.schema.json``, by place."""
    path = f"schemas/{name}.schema.json"
    if _is_sure(record, package, path):
        return []
    errors = _validator(package, path).iter_errors(record)
    return sorted(errors, key=lambda error: [str(part) for part in error.absolute_path])


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


def parse_record(data: bytes, *, name: str, package: str = "bridge.task") -> dict[str, Any]:
    """Parse JSON bytes and check them."""
    return dict(check_record(load_record(data, name=name), name=name, package=package))


def load_record(data: bytes, *, name: str) -> dict[str, Any]:
    """Parse JSON bytes that hold one object of finite numbers, and check no more than that."""
    try:
        record = json.loads(data, parse_constant=_refuse, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        raise InvalidRecordError(name=name, where="", found=f"not JSON ({error})") from error
    if not isinstance(record, dict):
        raise InvalidRecordError(name=name, where="", found="not a JSON object")
    return record
