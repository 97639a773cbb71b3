"""JSON records checked against their schema: plan, verdict, localisation, outcome, event, drops."""

import json
import math
from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

from bridge.errors import InvalidRecordError
from bridge.task.quick_check import Check, compile_check

if TYPE_CHECKING:
    from jsonschema import Draft202012Validator


@cache
def _schema(package: str, path: str) -> Any:
    """Load one of our JSON Schemas, once."""
    return json.loads(resources.files(package).joinpath(path).read_text())


@cache
def _quick_check(package: str, path: str) -> Check:
    return compile_check(_schema(package, path))


@cache
def _validator(package: str, path: str) -> "Draft202012Validator":
    from jsonschema import Draft202012Validator  # noqa: PLC0415  # only what does not fit needs it

    return Draft202012Validator(_schema(package, path))


def check_record(
    record: Mapping[str, Any], *, name: str, package: str = "bridge.task"
) -> Mapping[str, Any]:
    """Return the record if it fits ``schemas/<name>.schema.json``.

    Raises:
        InvalidRecordError: With the place and the value that does not fit.
    """
    path = f"schemas/{name}.schema.json"
    version = record.get("schema_version")
    known = _schema(package, path)["version"]
    if isinstance(version, int) and version > known:
        raise InvalidRecordError(
            name=name,
            where="schema_version",
            found=f"version {version} is newer than the {known} this reader knows; upgrade",
        )
    if _quick_check(package, path)(record):
        return record
    error = next(iter(_validator(package, path).iter_errors(record)), None)
    if error is not None:
        where = "/".join(str(part) for part in error.absolute_path)
        raise InvalidRecordError(name=name, where=where, found=error.message[:300])
    return record


def _refuse(text: str) -> float:
    message = f"{text} is not a number in JSON"
    raise ValueError(message)


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
