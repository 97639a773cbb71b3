"""Looks whether a message is what its type says. Recording never depends on the answer."""

import json
from enum import StrEnum

from bridge.episode import cdr, schema


class Finding(StrEnum):
    """What is known about one message."""

    GOOD = "good"
    UNDECODABLE = "undecodable"
    NEWER_VERSION = "newer_version"
    UNKNOWN_TYPE = "unknown_type"


def resolve_type(topic: str, type_name: str) -> str:
    """Trust the publisher's type name; without one, go by the topic."""
    return type_name or schema.type_of_topic(topic) or ""


def inspect(type_name: str, message_encoding: str, data: bytes) -> Finding:
    """Decode a message of a known type and throw the result away."""
    known = schema.schema_for(type_name) if type_name else None
    if known is None:
        return Finding.UNKNOWN_TYPE
    if message_encoding not in ("", known.message_encoding):
        return Finding.UNDECODABLE
    if known.message_encoding == "cdr":
        return _inspect_cdr(type_name, data)
    return _inspect_json(type_name, data)


def _inspect_cdr(type_name: str, data: bytes) -> Finding:
    try:
        cdr.decode(type_name, data)
    except cdr.MalformedMessageError:
        return Finding.UNDECODABLE
    return Finding.GOOD


def _inspect_json(type_name: str, data: bytes) -> Finding:
    try:
        record = json.loads(data)
    except (ValueError, RecursionError):
        return Finding.UNDECODABLE
    if not isinstance(record, dict):
        return Finding.UNDECODABLE
    version = record.get("schema_version", 1)
    if not isinstance(version, int):
        return Finding.UNDECODABLE
    if version > schema.json_schema_version(type_name):
        return Finding.NEWER_VERSION
    return Finding.GOOD
