"""JSON records checked against their schema: plan, verdict, localisation, outcome, event, drops."""

import json
import math
from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

from bridge.errors import InvalidRecordError

if TYPE_CHECKING:
    from jsonschema import Draft202012Validator
    from jsonschema.exceptions import ValidationError
import operator
import re
from collections.abc import Callable, Sequence, Sized

# ``jsonschema`` takes a quarter of a millisecond for a record of twenty fields, which is most of
# the time an episode's outcome takes to read. What is compiled here from the same schema says yes
# only where jsonschema finds nothing wrong (``test_quick_check`` compares the two); who hears no
# asks jsonschema, which alone says what does not fit and where.

Check = Callable[[Any], bool]
Comparison = Callable[[Any, Any], bool]
Keyword = Callable[["_Compiler", Any, Mapping[str, Any]], Check | None]
"""Makes the check of one keyword from what it asks for and the schema it stands in."""

_TYPES: dict[str, frozenset[type]] = {
    "string": frozenset({str}),
    "integer": frozenset({int}),
    "number": frozenset({int, float}),
    "boolean": frozenset({bool}),
    "null": frozenset({type(None)}),
    "array": frozenset({list}),
    "object": frozenset({dict}),
}
"""Exactly these: 1.0 counts as an integer too, and is left to jsonschema as subclasses are."""
_PLAIN = frozenset[type]().union(*_TYPES.values())
_SCALARS = _PLAIN - {list, dict}
_SAYING_NOTHING = frozenset(
    {"$schema", "$defs", "title", "description", "version", "type", "then", "else"}
)
"""``then`` and ``else`` are read where their ``if`` is, and mean nothing without it."""


def compile_check(schema: Mapping[str, Any]) -> Check:
    """Return what says yes to records that surely fit a schema of JSON Schema's 2020-12 draft.

    Nothing is sure under a keyword that is not known here, and of values that ``json.loads`` does
    not make.
    """
    return _Compiler(schema).compile(schema)


def _never(value: Any) -> bool:
    return False


class _Compiler:
    """Makes a check of each part of one schema; ``$ref`` reaches its ``$defs``."""

    def __init__(self, root: Mapping[str, Any]) -> None:
        self._root = root
        self._defined: dict[str, Check] = {}

    def compile(self, schema: Any) -> Check:
        if isinstance(schema, bool):
            return (lambda value: type(value) in _PLAIN) if schema else _never
        names = [schema["type"]] if isinstance(schema.get("type"), str) else schema.get("type")
        allowed = _PLAIN if names is None else frozenset[type]().union(*(_TYPES[n] for n in names))
        checks: list[Check] = []
        for keyword, wanted in schema.items():
            if keyword in _SAYING_NOTHING:
                continue
            if keyword not in _KEYWORDS:
                return _never
            check = _KEYWORDS[keyword](self, wanted, schema)
            if check is not None:
                checks.append(check)
        return _all_of(allowed, checks)

    def reference(self, wanted: str, _: Mapping[str, Any]) -> Check:
        prefix, name = wanted[: wanted.rfind("/")], wanted[wanted.rfind("/") + 1 :]
        found = self._root.get("$defs", {}).get(name)
        if prefix != "#/$defs" or found is None:
            return _never
        if name not in self._defined:
            self._defined[name] = _never  # while it is compiled: what holds itself is never sure
            self._defined[name] = self.compile(found)
        return self._defined[name]

    def properties(self, wanted: Mapping[str, Any], schema: Mapping[str, Any]) -> Check:
        checks = [(name, self.compile(inner)) for name, inner in wanted.items()]

        def check(value: Any) -> bool:
            if type(value) is dict:
                for name, fits in checks:
                    if name in value and not fits(value[name]):
                        return False
            return True

        return check

    def additional(self, wanted: Any, schema: Mapping[str, Any]) -> Check | None:
        if wanted is True:
            return None
        known = frozenset(schema.get("properties", ()))
        fits = self.compile(wanted)

        def check(value: Any) -> bool:
            if type(value) is not dict or value.keys() <= known:
                return True
            return all(fits(value[name]) for name in value.keys() - known)

        return check

    def items(self, wanted: Any, _: Mapping[str, Any]) -> Check:
        if (
            isinstance(wanted, dict)
            and wanted.keys() == {"type"}
            and isinstance(wanted["type"], str)
        ):
            allowed = _TYPES[wanted["type"]]
            return lambda value: type(value) is not list or allowed.issuperset(map(type, value))
        fits = self.compile(wanted)
        return lambda value: type(value) is not list or all(map(fits, value))

    def any_of(self, wanted: Sequence[Any], _: Mapping[str, Any]) -> Check:
        checks = [self.compile(inner) for inner in wanted]
        return lambda value: any(fits(value) for fits in checks)

    def all_of(self, wanted: Sequence[Any], _: Mapping[str, Any]) -> Check:
        checks = [self.compile(inner) for inner in wanted]
        return lambda value: all(fits(value) for fits in checks)

    def one_of(self, wanted: Sequence[Any], _: Mapping[str, Any]) -> Check:
        """Sure where no value can fit two of the options, because their types differ."""
        types: list[frozenset[type]] = []
        for inner in wanted:
            named = inner
            if "$ref" in inner:
                named = self._root.get("$defs", {}).get(inner["$ref"].rpartition("/")[2], {})
            if not isinstance(named.get("type"), str):
                return _never
            types.append(_TYPES[named["type"]])
        if len(frozenset[type]().union(*types)) != sum(map(len, types)):
            return _never
        return self.any_of(wanted, {})

    def condition(self, wanted: Any, schema: Mapping[str, Any]) -> Check:
        """Sure where the side that applies is, or both are; a side left out takes everything."""
        fits, refused = self.compile(wanted), _refusal(wanted)
        then, otherwise = (self.compile(schema.get(side, True)) for side in ("then", "else"))
        return lambda value: (refused(value) or then(value)) and (fits(value) or otherwise(value))


def _refusal(schema: Any) -> Check:
    """Return what says yes to values in which jsonschema surely finds something wrong.

    That no check was sure of a value does not say so. One keyword that refuses is enough, so what
    is not known here is passed over.
    """
    if isinstance(schema, bool):
        return _never if schema else (lambda value: True)
    checks = [
        _REFUSALS[keyword](wanted) for keyword, wanted in schema.items() if keyword in _REFUSALS
    ]
    return lambda value: any(refused(value) for refused in checks)


def _type_refused(wanted: str | Sequence[str]) -> Check:
    names = [wanted] if isinstance(wanted, str) else wanted
    fitting = frozenset[type]().union(*(_TYPES[name] for name in names))
    if int in fitting:
        fitting |= {float}  # 1.0 is an integer
    others = _PLAIN - fitting
    return lambda value: type(value) in others


def _options_refused(wanted: Sequence[Any]) -> Check:
    """Python holds more for equal than JSON does: what it tells apart is not equal in JSON."""
    return lambda value: type(value) in _SCALARS and value not in wanted


def _required_refused(wanted: Sequence[str]) -> Check:
    names = frozenset(wanted)
    return lambda value: type(value) is dict and not names <= value.keys()


def _properties_refused(wanted: Mapping[str, Any]) -> Check:
    checks = [(name, _refusal(inner)) for name, inner in wanted.items()]
    return lambda value: (
        type(value) is dict
        and any(name in value and refused(value[name]) for name, refused in checks)
    )


_REFUSALS: dict[str, Callable[[Any], Check]] = {
    "type": _type_refused,
    "const": lambda wanted: _options_refused([wanted]),
    "enum": _options_refused,
    "required": _required_refused,
    "properties": _properties_refused,
}


def _all_of(allowed: frozenset[type], checks: Sequence[Check]) -> Check:
    if not checks:
        return lambda value: type(value) in allowed
    if len(checks) == 1:
        (only,) = checks
        return lambda value: type(value) in allowed and only(value)
    every = tuple(checks)

    def check(value: Any) -> bool:
        if type(value) not in allowed:
            return False
        for fits in every:  # noqa: SIM110  # a generator takes twice as long
            if not fits(value):
                return False
        return True

    return check


def _const(_: _Compiler, wanted: Any, schema: Mapping[str, Any]) -> Check:
    return _enum(_, [wanted], schema)


def _enum(_: _Compiler, wanted: Sequence[Any], __: Mapping[str, Any]) -> Check:
    """1 and true are two things in JSON, and one key of a Python set."""
    options = frozenset((type(option), option) for option in wanted if type(option) in _SCALARS)
    return lambda value: type(value) in _SCALARS and (type(value), value) in options


def _required(_: _Compiler, wanted: Sequence[str], __: Mapping[str, Any]) -> Check:
    names = frozenset(wanted)
    return lambda value: type(value) is not dict or names <= value.keys()


def _sized(kind: type[Sized], holds: Comparison) -> Keyword:
    return lambda _, wanted, __: lambda value: type(value) is not kind or holds(len(value), wanted)


def _pattern(_: _Compiler, wanted: str, __: Mapping[str, Any]) -> Check:
    found = re.compile(wanted).search
    return lambda value: type(value) is not str or found(value) is not None


def _bound(holds: Comparison) -> Keyword:
    return lambda _, wanted, __: (
        lambda value: type(value) not in (int, float) or holds(value, wanted)
    )


_KEYWORDS: dict[str, Keyword] = {
    "$ref": _Compiler.reference,
    "properties": _Compiler.properties,
    "additionalProperties": _Compiler.additional,
    "items": _Compiler.items,
    "allOf": _Compiler.all_of,
    "anyOf": _Compiler.any_of,
    "oneOf": _Compiler.one_of,
    "if": _Compiler.condition,
    "const": _const,
    "enum": _enum,
    "required": _required,
    "minItems": _sized(list, operator.ge),
    "maxItems": _sized(list, operator.le),
    "minLength": _sized(str, operator.ge),
    "pattern": _pattern,
    "minimum": _bound(operator.ge),
    "maximum": _bound(operator.le),
    "exclusiveMinimum": _bound(operator.gt),
    "exclusiveMaximum": _bound(operator.lt),
}


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

    Args:
        record: As parsed from JSON.
        name: Of the schema, such as ``plan``.
        package: Where its folder ``schemas`` is.

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


def find_problems(
    record: Mapping[str, Any], *, name: str, package: str = "bridge.task"
) -> list["ValidationError"]:
    """List everything in a record that does not fit ``schemas/<name>.schema.json``, by place."""
    path = f"schemas/{name}.schema.json"
    if _quick_check(package, path)(record):
        return []
    errors = _validator(package, path).iter_errors(record)
    return sorted(errors, key=lambda error: [str(part) for part in error.absolute_path])


def _refuse(text: str) -> float:
    message = f"{text} is not a number in JSON"
    raise ValueError(message)


def _finite(text: str) -> float:
    number = float(text)
    return number if math.isfinite(number) else _refuse(text)


def parse_record(data: bytes, *, name: str, package: str = "bridge.task") -> dict[str, Any]:
    """Parse JSON bytes and check them.

    Args:
        data: UTF-8 text.
        name: Of the schema, such as ``plan``.
        package: Where its folder ``schemas`` is.
    """
    return dict(check_record(load_record(data, name=name), name=name, package=package))


def load_record(data: bytes, *, name: str) -> dict[str, Any]:
    """Parse JSON bytes that hold one object of finite numbers, and check no more than that.

    Args:
        data: UTF-8 text.
        name: What the record is, for the error.
    """
    try:
        record = json.loads(data, parse_constant=_refuse, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        raise InvalidRecordError(name=name, where="", found=f"not JSON ({error})") from error
    if not isinstance(record, dict):
        raise InvalidRecordError(name=name, where="", found="not a JSON object")
    return record
