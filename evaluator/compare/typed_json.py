"""Nested records as JSON text, read back with the types their hints name.

Tuples stay tuples and dataclasses stay dataclasses. Nothing but JSON is read: no names, no code.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

Reader = Callable[[Any], Any]
_AS_IT_IS = (str, int, float, bool, NoneType, Any, object)


def to_text(value: object) -> str:
    """Write a value as compact JSON; a dataclass becomes an object of its fields."""
    return json.dumps(value, default=vars, separators=(",", ":"))


def without_none(hint: Any) -> tuple[Any, bool]:
    """Split a hint into what a value is when it is there, and whether it may be missing."""
    if get_origin(hint) not in (Union, UnionType):
        return hint, False
    inner = tuple(option for option in get_args(hint) if option is not NoneType)
    return (inner[0] if len(inner) == 1 else Union[inner]), len(inner) < len(get_args(hint))  # noqa: UP007  # built at run time


@cache
def reader(hint: Any) -> Reader:
    """Return what turns parsed JSON back into a value of this type.

    Raises:
        TypeError: For a type that JSON cannot say.
    """
    inner, is_optional = without_none(hint)
    read = _reader(inner)
    if is_optional and read is not as_it_is:
        return lambda value: None if value is None else read(value)
    return read


def _reader(hint: Any) -> Reader:
    origin, args = get_origin(hint), get_args(hint)
    if hint in _AS_IT_IS or (origin is Union and all(option in _AS_IT_IS for option in args)):
        return as_it_is
    if origin is tuple and len(args) == 2 and args[1] is Ellipsis:
        each = reader(args[0])
        return lambda value: tuple(map(each, value))
    if origin is tuple:
        readers = tuple(map(reader, args))
        return lambda value: tuple(read(x) for read, x in zip(readers, value, strict=True))
    if origin in (dict, Mapping):
        of = reader(args[1])
        return lambda value: {name: of(x) for name, x in value.items()}
    if isinstance(hint, type) and is_dataclass(hint):
        return _record_reader(hint)
    message = f"{hint} cannot be kept as JSON"
    raise TypeError(message)


def as_it_is(value: Any) -> Any:
    """Return a value that needs no turning back."""
    return value


def _record_reader(kind: Any) -> Reader:
    hints = get_type_hints(kind)
    found = {item.name: reader(hints[item.name]) for item in fields(kind)}
    readers = [(name, read) for name, read in found.items() if read is not as_it_is]

    def read(value: Any) -> Any:
        for name, turn_back in readers:
            if name in value:
                value[name] = turn_back(value[name])  # fresh from the text, and ours
        return kind(**value)

    return read
