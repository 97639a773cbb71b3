"""Leaves: what the core works without. Each is named here once and loaded when it is needed."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from bridge.errors import MissingDependencyError


@dataclass(frozen=True, kw_only=True)
class Leaf:
    """Where a leaf begins, and how to get it."""

    entry: str
    """``module:function``."""
    extra: str
    """Brings the leaf and what it needs."""
    purpose: str
    """What the core wants it for, as a message ends."""


LEAVES = {
    "check_models": Leaf(
        entry="twin.scene.foundation.stage:check_models",
        extra="foundation",
        purpose="asking large models about a scene",
    ),
    "name_things": Leaf(
        entry="twin.scene.foundation.things:write_scene_semantics",
        extra="foundation",
        purpose="naming the things of a scene",
    ),
}


def has_leaf(name: str) -> bool:
    """Whether a leaf is installed; what it needs may still be missing."""
    module, _, _ = LEAVES[name].entry.partition(":")
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # a package above it is gone, too
        return False


def load_leaf(name: str) -> Callable[..., Any]:
    """Return the function that a leaf begins with.

    Raises:
        MissingDependencyError: When the leaf is not installed; names the extra that brings it.
    """
    leaf = LEAVES[name]
    module, _, function = leaf.entry.partition(":")
    if not has_leaf(name):
        raise MissingDependencyError(package=module, extra=leaf.extra, purpose=leaf.purpose)
    entry: Callable[..., Any] = getattr(importlib.import_module(module), function)
    return entry
