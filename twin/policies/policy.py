"""Open a policy by what it is called: ``ws://HOST:PORT``, or ``module:function`` in this Python."""

import importlib
import inspect
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from bridge.episode.provenance import hash_settings
from twin.policies.config import is_driven
from twin.policies.drive import KeyFile, KeyPage, KeyPolicy
from twin.policies.errors import PolicyError
from twin.policies.mapping import PolicyMap
from twin.policies.openpi import ServedPolicy

WORDS = ("ws://", "wss://")
HASHES = ("server=", "code=", "map=")
"""How it begins who acted, where no checkpoint is named."""


@runtime_checkable
class Policy(Protocol):
    """What acts in the cell."""

    metadata: dict[str, Any]
    """What it says of itself."""

    def infer(self, observation: dict[str, Any]) -> Any:
        """Answer an observation with rows of actions, or a map that holds them."""

    def reset(self, seed: int) -> None:
        """A new rollout begins."""

    def refused(self, text: str) -> bool:
        """Told which limit refused its target; whether it goes on, with the arm slowing down."""

    def close(self) -> None:
        """Nothing more is asked."""


@dataclass
class ImportedPolicy:
    """A function of this Python, or what it made."""

    act: Callable[[dict[str, Any]], Any]
    again: Callable[..., Any] | None = None
    told: Callable[[str], Any] | None = None
    """Its ``refused``, where it has one."""
    metadata: dict[str, Any] = field(default_factory=dict)

    def infer(self, observation: dict[str, Any]) -> Any:
        """Call it; whatever it raises is the policy's failure."""
        try:
            return self.act(observation)
        except Exception as error:  # whatever another's code raises
            raise PolicyError(f"the policy failed: {type(error).__name__}: {error}") from error

    def reset(self, seed: int) -> None:
        """Tell it, where it has a ``reset``; the seed, where that takes one."""
        if self.again is None:
            return
        if "seed" in inspect.signature(self.again).parameters:
            self.again(seed=seed)
        else:
            self.again()

    def refused(self, text: str) -> bool:
        """It goes on where it takes such words."""
        if self.told is not None:
            self.told(text)
        return self.told is not None

    def close(self) -> None:
        """Nothing is open."""


def open_policy(address: str, timeout_s: float) -> Policy:
    """Open a policy.

    Args:
        address: ``ws://HOST:PORT``, or ``module:name``: a factory without arguments, a function of
            an observation, or an object with ``infer`` or ``select_action``; or ``keys``, which
            somebody holds in the browser, or ``keys:FILE``.
    """
    if is_driven(address):
        _, colon, path = address.partition(":")
        return KeyPolicy(KeyFile(Path(path)) if colon else KeyPage())
    if address.startswith(WORDS):
        return ServedPolicy(address, timeout_s)
    module, colon, name = address.partition(":")
    if not colon or not name or "/" in address:
        raise PolicyError(
            f"--policy {address!r} is neither ws://HOST:PORT nor module:function of this Python"
        )
    if not any(Path(place or ".").resolve() == Path.cwd() for place in sys.path):
        sys.path.append(str(Path.cwd()))  # a file beside the run, after all that is installed
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise PolicyError(f"--policy {address}: {error}") from error
    if callable(found) and not _takes_one(found):
        found = found()
    for method in ("infer", "select_action"):
        if callable(getattr(found, method, None)):
            about = getattr(found, "metadata", {})
            return ImportedPolicy(
                act=getattr(found, method),
                again=getattr(found, "reset", None),
                told=getattr(found, "refused", None),
                metadata=dict(about) if isinstance(about, dict) else {},
            )
    if not callable(found):
        raise PolicyError(f"--policy {address}: {type(found).__name__} cannot be asked for actions")
    return ImportedPolicy(act=found)


def _takes_one(found: Callable[..., Any]) -> bool:
    if inspect.isclass(found):
        return False
    needed = [p for p in inspect.signature(found).parameters.values() if p.default is p.empty]
    return len(needed) == 1


def who_acts(address: str, mapping: PolicyMap, metadata: Mapping[str, Any]) -> str:
    """Say who acts: the checkpoint that a server names, else a hash of what it says; the mapping.

    Code of this Python is what it is called.
    """
    who = str(metadata.get("checkpoint") or "")
    if not who and metadata:
        who = f"server={hash_settings(dict(metadata))}"
    elif not who and not address.startswith(WORDS):
        who = f"code={address}"
    return f"{who} map={mapping.sha256()[:12]}".strip()
