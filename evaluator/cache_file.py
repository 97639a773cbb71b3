"""One Parquet file of summaries: frozen dataclasses in columns, read back as they were.

Text, numbers and answers are columns of their own, tuples and arrays of them are lists, a record
that is always there has a column for each of its fields, and what else is nested is JSON text
(nothing else is read: no names, no code). Texts are read as dictionaries, so that what ten thousand
rows have in common is decoded once. Importing this module loads pyarrow; ``cache`` does so only
when a cache is asked for.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

import pyarrow as pa
import pyarrow.parquet as pq

from bridge.whole_file import write_whole
from evaluator.arrow_columns import (
    ANSWER,
    NUMBER,
    SHARED_TEXT,
    TEXT,
    WHOLE,
    arrays_of,
    column_of,
    values_of,
)
from evaluator.memory import Packed, without_collecting

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


Summary = TypeVar("Summary")
Rows = Mapping[str, tuple[Any, ...]]
"""Summaries by the key they are kept under; there may be none or several under one."""

_KEY, _PLACE = "_key", "_place"
NOTHING = -1
"""Place of the one row of a key under which there is no summary."""
_KIND, _VERSION = b"gst.kind", b"gst.version"
_SCALARS = {str: TEXT, int: WHOLE, float: NUMBER, bool: ANSWER}
_REFUSALS = (pa.ArrowException, OverflowError, ValueError, TypeError)
"""What packing raises: a number beyond 64 bits, text that is no Unicode, another type."""


class UnusableFileError(Exception):
    """A file of the cache holds nothing that can be used; the message says why."""


class _Column(NamedTuple):
    name: str
    """Of the field; of a field of a record, both with a point between."""
    type: pa.DataType
    is_optional: bool
    pack: Callable[[Any], Any]
    unpack: Reader


class _Record(NamedTuple):
    """A record that is always there: its fields are columns, or records in turn."""

    name: str
    kind: type[Any]
    parts: "_Parts"


_Parts = tuple[_Column | _Record, ...]


def write_summaries(path: Path, kind: type[Any], rows: Rows, version: str) -> int:
    """Write all rows, whole or not at all, and return how many keys could not be packed.

    Args:
        path: Where the file goes; its folder is made.
        kind: The dataclass of the summaries.
        rows: Summaries by key.
        version: Of the code that made them; another one does not read them.

    Raises:
        OSError: When the disk refuses.
    """
    try:
        table, refused = _packed(kind, rows, version), 0
    except _REFUSALS:  # one odd number must not cost the others their place
        good = {key: found for key, found in rows.items() if _fits(kind, key, found, version)}
        table, refused = _packed(kind, good, version), len(rows) - len(good)
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", write_page_checksum=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, sink.getvalue().to_pybytes())
    return refused


def read_summaries(path: Path, kind: type[Summary], version: str) -> dict[str, tuple[Summary, ...]]:
    """Read all rows of a file.

    Args:
        path: A file of ``write_summaries``.
        kind: The dataclass that it must hold.
        version: Of the code that must have made it.

    Raises:
        UnusableFileError: When it is damaged, foreign, or made by other code.
        FileNotFoundError: When it is gone.
    """
    try:
        texts = [one.name for one in _schema(kind) if one.type == TEXT]
        with pq.ParquetFile(path, read_dictionary=texts, page_checksum_verification=True) as file:
            stamp = dict(file.schema_arrow.metadata or {})
            if stamp.get(_KIND) != kind.__name__.encode():
                message = "another program wrote it"
                raise UnusableFileError(message)
            if stamp.get(_VERSION) != version.encode():
                message = "another version of this program wrote it"
                raise UnusableFileError(message)
            with without_collecting():
                return _unpacked(kind, file.read())
    except FileNotFoundError:
        raise
    except (*_REFUSALS, OSError, KeyError, AttributeError) as error:
        message = f"it is damaged ({type(error).__name__})"
        raise UnusableFileError(message) from error


def _packed(kind: type[Any], rows: Rows, version: str) -> pa.Table:
    keys: list[str] = []
    places: list[int] = []
    items: list[Any] = []
    for key, found in rows.items():
        for place, item in enumerate(found) if found else ((NOTHING, None),):
            keys.append(key)
            places.append(place)
            items.append(item)
    arrays = [column_of(keys, TEXT), column_of(places, pa.int32()), *_arrays(_parts(kind), items)]
    about = {_KIND: kind.__name__.encode(), _VERSION: version.encode()}
    return pa.Table.from_arrays(arrays, schema=_schema(kind).with_metadata(about))


def _arrays(parts: _Parts, items: list[Any]) -> list[pa.Array | pa.ChunkedArray]:
    found: list[pa.Array | pa.ChunkedArray] = []
    for part in parts:
        name = part.name.rpartition(".")[2]
        values = [None if item is None else getattr(item, name) for item in items]
        if isinstance(part, _Record):
            found += _arrays(part.parts, values)
        else:
            packed = [None if value is None else part.pack(value) for value in values]
            found.append(column_of(packed, part.type))
    return found


def _fits(kind: type[Any], key: str, found: tuple[Any, ...], version: str) -> bool:
    try:
        _packed(kind, {key: found}, version)
    except _REFUSALS:
        return False
    return True


def _unpacked(kind: type[Summary], table: pa.Table) -> dict[str, tuple[Summary, ...]]:
    if not table.schema.equals(_as_read(_schema(kind))):
        message = "its columns are others"
        raise UnusableFileError(message)
    places = values_of(table.column(_PLACE))
    items = _items(kind, _parts(kind), table, places.count(NOTHING))
    rows: dict[str, tuple[Summary, ...]] = {}
    for key, place, item in zip(values_of(table.column(_KEY)), places, items, strict=True):
        if place == NOTHING:
            rows[key] = ()
        else:
            rows[key] = (*rows[key], item) if place else (item,)
    return rows


def _items(kind: type[Any], parts: _Parts, table: pa.Table, nothing: int) -> list[Any]:
    """Make one item of each row; ``nothing`` rows are empty, and what is made of them is not used.

    Args:
        kind: Of the items.
        parts: Its columns.
        table: All columns.
        nothing: Rows that may lack what every item has.
    """
    names = [part.name.rpartition(".")[2] for part in parts]
    columns = [
        _items(part.kind, part.parts, table, nothing)
        if isinstance(part, _Record)
        else _values(part, table.column(part.name), nothing)
        for part in parts
    ]
    make = _maker(kind)
    return [make(zip(names, values, strict=True)) for values in zip(*columns, strict=True)]


def _values(part: _Column, column: pa.ChunkedArray, nothing: int) -> list[Any]:
    if not part.is_optional and column.null_count != nothing:
        message = f"{part.name} is missing"
        raise UnusableFileError(message)
    if part.unpack is Packed:
        return arrays_of(column)
    values = values_of(column)
    return values if part.unpack is as_it_is else _from_texts(values, part.unpack)


def _maker(kind: type[Summary]) -> Callable[[Iterable[tuple[str, Any]]], Summary]:
    """Return what makes a summary of all its fields.

    A frozen dataclass sets each field by a call of its own, which takes three times as long as
    filling its dictionary; one that does more when it is made is made as usual.
    """
    if hasattr(kind, "__post_init__") or hasattr(kind, "__slots__"):
        return lambda values: kind(**dict(values))

    def make(values: Iterable[tuple[str, Any]]) -> Summary:
        item = object.__new__(kind)
        vars(item).update(values)
        return item

    return make


def _schema(kind: type[Any]) -> pa.Schema:
    columns = [(column.name, column.type) for column in _columns(_parts(kind))]
    return pa.schema([(_KEY, TEXT), (_PLACE, pa.int32()), *columns])


def _as_read(schema: pa.Schema) -> pa.Schema:
    """What a schema becomes when texts are read as dictionaries."""
    kinds = ((one.name, SHARED_TEXT if one.type == TEXT else one.type) for one in schema)
    return pa.schema(list(kinds))


def _columns(parts: _Parts) -> Iterator[_Column]:
    for part in parts:
        if isinstance(part, _Record):
            yield from _columns(part.parts)
        else:
            yield part


def _parts(kind: type[Any], before: str = "") -> _Parts:
    hints = get_type_hints(kind)
    return tuple(_part(f"{before}{item.name}", hints[item.name]) for item in fields(kind))


def _part(name: str, hint: Any) -> _Column | _Record:
    inner, is_optional = without_none(hint)
    if inner in _SCALARS:
        return _Column(name, _SCALARS[inner], is_optional, as_it_is, as_it_is)
    args = get_args(inner)
    if inner is Packed:
        return _Column(name, pa.list_(NUMBER), is_optional, as_it_is, Packed)
    if get_origin(inner) is tuple and args[1:] == (Ellipsis,) and args[0] in _SCALARS:
        return _Column(name, pa.list_(_SCALARS[args[0]]), is_optional, list, as_it_is)
    if isinstance(inner, type) and is_dataclass(inner) and not is_optional:
        return _Record(name, inner, _parts(inner, f"{name}."))
    return _Column(name, TEXT, is_optional, to_text, reader(inner))


def _from_texts(texts: list[str | None], read: Reader) -> list[Any]:
    """Parse JSON texts: each of the different ones once, all of them together."""
    different = [text for text in dict.fromkeys(texts) if text is not None]
    values = json.loads(f"[{','.join(different)}]")
    known = {text: read(value) for text, value in zip(different, values, strict=True)}
    return [None if text is None else known[text] for text in texts]
