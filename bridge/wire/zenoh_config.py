"""Turns our few settings, and a file of zenoh's own, into what zenoh opens a session with."""

import json
import os
import re
from typing import Any

from bridge.wire.config import WireConfig
from bridge.wire.errors import WireConfigError, cause_of, public

NETWORK_THREADS = "(rx: (worker_threads: 1), acc: (handover: rx))"
"""One thread both waits for the network and reads it (zenoh's ``ZENOH_RUNTIME``).

As zenoh comes, every message wakes one thread that waits and two that read. Our callbacks take
turns in Python anyway, so more readers bring nothing: one costs a tenth of a core less while
recording (``docs/decisions/0005-recorder.md``)."""

os.environ.setdefault("ZENOH_RUNTIME", NETWORK_THREADS)  # read when the first session opens

import zenoh as zenoh  # noqa: E402
from zenoh import shm as zenoh_shm  # noqa: E402

__all__ = ["zenoh", "zenoh_shm"]


_WRONG_VALUE = re.compile(
    r'msg: "(?P<message>.*)", location: .*?line: (?P<line>\d+)', flags=re.DOTALL
)
_QUOTED_VALUE = re.compile(r"(invalid (?:type|value): [a-z ]+?) (?:\".*\"|`[^`]*`)", re.DOTALL)
_WRONG_SYNTAX = re.compile(
    r"--> (?P<line>\d+):(?P<column>\d+).*\n\s*= (?P<message>.*?)(?: at /|$)", re.DOTALL
)
_QUEUES, _QUEUE_SIZE = "transport/link/tx/queue/size", 16
"""Room for 1 MB: 5 s of joints at 500 Hz, or a whole image while zenoh's own thread is asleep."""


def zenoh_config(config: WireConfig) -> Any:
    """Start from the file where given; mode, endpoints and scouting are ours in any case."""
    settings: dict[str, Any] = {
        "mode": config.mode,
        "connect/endpoints": list(config.connect),
        "listen/endpoints": list(config.listen),
        "connect/timeout_ms": round(config.connect_timeout_s * 1e3),
        "connect/exit_on_failure": True,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,  # there is nobody to wait for without scouting
    }
    made = zenoh.Config() if config.config is None else _config_from_file(config)
    if made.get_json(_QUEUES) == zenoh.Config().get_json(_QUEUES):  # the file is silent
        settings |= {f"{_QUEUES}/{name}": _QUEUE_SIZE for name in ("real_time", "data_low")}
    for key, value in settings.items():
        try:
            made.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise WireConfigError(
                f"{key} = {public(repr(value))} is not usable: {cause_of(error)}. "
                "An endpoint looks like tcp/127.0.0.1:7447."
            ) from error
    return made


def _config_from_file(config: WireConfig) -> Any:
    try:
        return zenoh.Config.from_file(str(config.config))
    except zenoh.ZError as error:
        raise WireConfigError(
            f"zenoh configuration {config.config} cannot be read: {_complaint(error)}. "
            "It must be a JSON5 file as zenoh documents it."
        ) from None  # zenoh's own words quote the file, and passwords stand in it


def _complaint(error: Exception) -> str:
    """Say what zenoh has against a file, and where, but not what stands there."""
    text = str(error)
    if found := _WRONG_VALUE.search(text):
        complaint = _QUOTED_VALUE.sub(r"\1", found["message"].replace('\\"', '"'))
        return f"line {found['line']}: {complaint}"
    if found := _WRONG_SYNTAX.search(text):
        return f"line {found['line']}, column {found['column']}: {found['message'].strip()}"
    return cause_of(error)
