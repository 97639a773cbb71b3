"""What ``--jaxtyping-packages`` checks, for a fraction of its price.

jaxtyping's own decorator binds the arguments of every call to a signature and checks parameters
twice, about 50 us a call, and makes two checking functions of each function at import: rooms of
tests took two to four times as long as their code. Here beartype checks a call once, within one
scope of axis names where a hint has any, and a checking function is made at the first call.
"""

import functools
import inspect
import types
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from typing import Any, get_args, get_type_hints

import jaxtyping
from beartype import BeartypeConf, beartype
from jaxtyping._storage import pop_shape_memo, push_shape_memo

CHECK_ALL_OF, THEN_ONE_OF = 100, 10
"""Of the calls of a function in a test the first are all checked, after them one in ten. What is
called a thousand times is called alike; which calls are checked does not depend on other tests."""
CHECK_MADE = 10
"""Of a function inside a function, which every call of the outer one makes anew, so many are
checked in a test: the check of one is compiled in a millisecond."""
CHECKED = "_checked_by_the_tests"
CONF = BeartypeConf(violation_type=jaxtyping.TypeCheckError)
"""A ``TypeError``, as the code itself would raise a moment later."""


_tests = types.SimpleNamespace(begun=0)
_made: Counter[types.CodeType] = Counter()


def begin_test() -> None:
    """Count calls from zero again."""
    _tests.begun += 1
    _made.clear()


def install() -> None:
    """Take the place of the decorator that jaxtyping's import hook writes into each module."""
    jaxtyping.jaxtyped = lambda *, typechecker: checked  # type: ignore[assignment]


@contextmanager
def unchecked() -> Iterator[None]:
    """Leave the checks out of a long run: in a whole trial they cost four times the physics.

    Only where short tests make the same calls with the checks.
    """
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", before)


def checked(thing: Any) -> Any:
    """Check every call of a function, or of a dataclass's constructor."""
    match thing:
        case type():
            make = thing.__init__
            if is_dataclass(thing) and inspect.isfunction(make) and not hasattr(make, CHECKED):
                thing.__init__ = checked(make)
            return thing
        case classmethod() | staticmethod():
            return type(thing)(checked(thing.__func__))
        case property():
            parts = (thing.fget, thing.fset, thing.fdel)
            return property(*(part and checked(part) for part in parts))
    if not thing.__annotations__:
        return thing
    if "<locals>" in thing.__qualname__:
        _made[thing.__code__] += 1
        if _made[thing.__code__] > CHECK_MADE:
            return thing
    checking: Callable[..., Any] | None = None
    number = of_test = 0

    @functools.wraps(thing)
    def call(*arguments: Any, **options: Any) -> Any:
        nonlocal checking, number, of_test
        __tracebackhide__ = True
        if of_test != _tests.begun:
            number, of_test = 0, _tests.begun
        number += 1
        if (number > CHECK_ALL_OF and number % THEN_ONE_OF) or (jaxtyping.config.jaxtyping_disable):
            return thing(*arguments, **options)
        if checking is None:
            checking = _checking(thing)
        return checking(*arguments, **options)

    setattr(call, CHECKED, True)
    return call


def _checking(function: Any) -> Callable[..., Any]:
    hints = {name: _resolved(hint, function) for name, hint in function.__annotations__.items()}
    if inspect.isgeneratorfunction(function) or inspect.isasyncgenfunction(function):
        hints.pop("return", None)  # jaxtyping does not look at what is yielded either
    bare = types.FunctionType(
        function.__code__,
        function.__globals__,
        function.__name__,
        function.__defaults__,
        function.__closure__,
    )
    bare.__kwdefaults__, bare.__annotations__ = function.__kwdefaults__, hints
    bare.__module__, bare.__qualname__ = function.__module__, function.__qualname__
    checking: Callable[..., Any] = beartype(conf=CONF)(bare)
    return _scoped(checking) if any(_has_axes(hint) for hint in hints.values()) else checking


def _scoped(checking: Callable[..., Any]) -> Callable[..., Any]:
    """Let an axis name mean one size in all parameters and the returned value of a call."""

    def call(*arguments: Any, **options: Any) -> Any:
        __tracebackhide__ = True
        push_shape_memo({})
        try:
            return checking(*arguments, **options)
        finally:
            pop_shape_memo()

    return call


def _resolved(hint: Any, function: Any) -> Any:
    """A hint written as text, read; ``Any`` where its names are not there when the code runs."""
    if not _has_text(hint):
        return hint
    holder = types.SimpleNamespace(__annotations__={"hint": hint})
    try:
        return get_type_hints(holder, function.__globals__, include_extras=True)["hint"]
    except Exception:  # noqa: BLE001 - whatever an unreadable hint raises
        return Any


def _has_text(hint: Any) -> bool:
    return isinstance(hint, str) or any(_has_text(part) for part in get_args(hint))


def _has_axes(hint: Any) -> bool:
    if isinstance(hint, list):  # the parameters of a Callable
        return any(_has_axes(part) for part in hint)
    if isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray):
        return True
    return any(_has_axes(part) for part in get_args(hint))
