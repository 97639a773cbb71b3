"""Policies behind a websocket, in openpi's protocol: also RoboArena, PolaRiS, Isaac Lab-Arena.

One msgpack frame of metadata when the connection stands, then a map for a map; a text frame is the
server's error. NumPy arrays are maps of ``__ndarray__``, ``data``, ``dtype``, ``shape``.
"""

import importlib
import os
from contextlib import ExitStack
from operator import index
from typing import Any

import msgspec
import numpy as np

from bridge.errors import MissingDependencyError
from twin.policies.errors import PolicyError

KEY_VARIABLE = "ROBOT_GST_POLICY_KEY"
"""Of the environment: what goes into the header ``Authorization: Api-Key``."""
MAX_BYTES = 64 << 20
MAX_DEPTH = 32
PLAIN = "biuf"
"""Kinds of numbers that are read; objects, records and complex numbers are not."""


def encode(value: object) -> bytes:
    """Pack an observation."""
    return msgspec.msgpack.encode(value, enc_hook=_packed)


def _packed(value: object) -> object:
    if isinstance(value, np.ndarray) and value.dtype.kind in PLAIN:
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": value.shape,
        }
    if isinstance(value, np.generic) and value.dtype.kind in PLAIN:
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"{type(value).__name__} cannot be sent to a policy")


def decode(data: bytes) -> Any:
    """Unpack an answer.

    Raises:
        PolicyError: It is no msgpack, or an array in it is not what it says.
    """
    try:
        return _unpacked(msgspec.msgpack.decode(data), 0)
    except (msgspec.DecodeError, RecursionError) as error:
        raise PolicyError(
            f"the policy answered {len(data)} bytes that are no msgpack: {error}"
        ) from error


def _unpacked(value: Any, depth: int) -> Any:
    if depth > MAX_DEPTH:
        raise PolicyError(f"the policy's answer is nested more than {MAX_DEPTH} deep")
    if isinstance(value, list):
        return [_unpacked(item, depth + 1) for item in value]
    if not isinstance(value, dict):
        return value
    found = {_text(key): item for key, item in value.items()}
    if "__ndarray__" in found:
        return _array(found)
    if "__npgeneric__" in found:
        return found.get("data")
    return {key: _unpacked(item, depth + 1) for key, item in found.items()}


def _text(key: object) -> str:
    return key.decode(errors="replace") if isinstance(key, bytes) else str(key)


def _array(found: dict[str, Any]) -> np.ndarray:
    try:
        dtype = np.dtype(_text(found["dtype"]))
        if dtype.kind not in PLAIN:
            raise PolicyError(f"the policy's array has the type {dtype}, which is not read")
        flat = np.frombuffer(found["data"], dtype=dtype)
        return flat.reshape([index(length) for length in found["shape"]])
    except (KeyError, TypeError, ValueError) as error:
        raise PolicyError(f"the policy's array is not what it says: {error}") from error


class ServedPolicy:
    """A policy at the other end of a websocket."""

    def __init__(self, address: str, timeout_s: float) -> None:
        """Connect, and take the server's metadata."""
        try:
            client = importlib.import_module("websockets.sync.client")
        except ImportError as error:
            raise MissingDependencyError(
                package="websockets", extra="policies", purpose=f"--policy {address}"
            ) from error
        self._address, self._timeout_s = address, timeout_s
        key = os.environ.get(KEY_VARIABLE)
        self._opened = ExitStack()
        try:
            self._socket = self._opened.enter_context(
                client.connect(
                    address,
                    additional_headers={"Authorization": f"Api-Key {key}"} if key else None,
                    compression=None,
                    max_size=MAX_BYTES,
                    open_timeout=timeout_s,
                    close_timeout=1.0,
                    ping_interval=None,
                    proxy=None,
                )
            )
        except (OSError, TimeoutError, ValueError, _refusals()) as error:
            raise PolicyError(f"no policy answers at {address}: {error}") from error
        try:
            metadata = self._receive()
        except PolicyError:
            self.close()
            raise
        self.metadata: dict[str, Any] = metadata if isinstance(metadata, dict) else {}

    def infer(self, observation: dict[str, Any]) -> Any:
        """Send an observation and return the answer."""
        try:
            self._socket.send(encode(observation))
        except (OSError, _refusals()) as error:
            raise self._gone(error) from error
        return self._receive()

    def _receive(self) -> Any:
        try:
            data = self._socket.recv(timeout=self._timeout_s)
        except TimeoutError as error:
            raise PolicyError(
                f"the policy at {self._address} said nothing for {self._timeout_s:g} s"
            ) from error
        except (OSError, _refusals()) as error:
            raise self._gone(error) from error
        if isinstance(data, str):
            last = data.strip().splitlines()[-1:] or ["nothing"]
            raise PolicyError(f"the policy at {self._address} failed: {last[0][:300]}")
        return decode(data)

    def _gone(self, error: Exception) -> PolicyError:
        return PolicyError(f"the policy at {self._address} closed the connection: {error}")

    def reset(self, seed: int) -> None:
        """Servers of this protocol keep no state between requests."""

    def refused(self, text: str) -> bool:
        """The protocol has no word for it; the rollout ends there."""
        del text
        return False

    def close(self) -> None:
        """Close the connection."""
        self._opened.close()


def _refusals() -> type[Exception]:
    found: type[Exception] = importlib.import_module("websockets.exceptions").WebSocketException
    return found
