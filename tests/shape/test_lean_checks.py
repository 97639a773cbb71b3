"""Calls of the rooms are checked in tests: types, shapes, and axes that must agree."""

import importlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from jaxtyping import Float, TypeCheckError
from lean_checks import CHECK_ALL_OF, CHECK_MADE, THEN_ONE_OF, begin_test, checked

from bridge.clock import ns_from_s
from bridge.geometry.se3 import invert, split

Rows = Float[np.ndarray, "num_rows 3"]


@checked
def add(first: Rows, second: Rows, *, scale: float = 1.0) -> Float[np.ndarray, " num_rows"]:
    return (first + scale * second).sum(axis=1) if scale else np.zeros(len(first) + 1)


@checked
def plain(number: int, text: "str" = "") -> str:
    return text * number if number else number  # type: ignore[return-value]


@checked
def rows(number: int, of: "list[Rows]") -> Iterator[Rows]:
    yield from of[:number]


@checked
@dataclass(frozen=True, kw_only=True)
class Cloud:
    points: Rows
    weights: Float[np.ndarray, " num_rows"]
    after: "Cloud | None" = None


class Room:
    factor = 2

    @checked
    def grown(self, cloud: Cloud) -> "Cloud":
        return Cloud(points=cloud.points * self.factor, weights=cloud.weights, after=cloud)

    @property
    @checked
    def doors(self) -> int:
        return self.factor

    @classmethod
    @checked
    def made(cls, factor: int) -> "Room":
        return cls() if factor else None  # type: ignore[return-value]


def refused(call: Any, *arguments: Any, **options: Any) -> None:
    with pytest.raises(TypeCheckError):
        call(*arguments, **options)


def test_right_calls_pass_with_their_results() -> None:
    two = np.ones((2, 3))
    np.testing.assert_array_equal(add(two, two, scale=2.0), [9.0, 9.0])
    assert plain(2, text="a") == "aa"
    assert len(list(rows(1, [two]))) == 1
    cloud = Room().grown(Cloud(points=two, weights=np.ones(2)))
    assert cloud.after is not None
    assert Room().doors == 2
    assert isinstance(Room.made(1), Room)
    np.testing.assert_array_equal(add(np.ones((4, 3)), np.ones((4, 3))), np.full(4, 6.0))


def test_wrong_types_shapes_and_results_are_refused() -> None:
    two = np.ones((2, 3))
    refused(plain, "2")
    refused(plain, 0)
    refused(plain, 1, text=1)
    refused(add, two, two.tolist())
    refused(add, two, np.ones((2, 4)))
    refused(add, two.astype(int), two)
    refused(lambda: list(rows("1", [two])))
    refused(lambda: list(rows(1, [np.ones((2, 4))])))
    refused(Room.made, 0)
    refused(Room().grown, None)


def test_an_axis_has_one_size_in_a_call_its_result_and_an_object() -> None:
    two, three = np.ones((2, 3)), np.ones((3, 3))
    refused(add, two, three)
    refused(add, two, two, scale=0.0)
    refused(Cloud, points=two, weights=np.ones(3))
    Cloud(points=three, weights=np.ones(3))


def test_the_rooms_are_checked_like_this() -> None:
    refused(ns_from_s, "1")
    refused(invert, np.eye(3))
    refused(split, np.eye(4).tolist())
    for room in ("bridge.geometry.se3", "twin.errors", "evaluator.result"):
        module = sys.modules.get(room) or importlib.import_module(room)
        assert "jaxtyping" in vars(module), f"the import hook did not see {room}"


def test_of_many_calls_in_a_test_the_first_and_every_tenth_are_checked() -> None:
    begin_test()
    for _ in range(CHECK_ALL_OF - 1):
        plain(1)
    refused(plain, 0)
    wrong = [number for number in range(40) if not passes(plain, 0)]
    assert len(wrong) == 40 / THEN_ONE_OF
    begin_test()
    refused(plain, 0)


def passes(call: Any, *arguments: Any) -> bool:
    try:
        call(*arguments)
    except TypeCheckError:
        return False
    return True


def test_of_a_function_made_at_each_call_the_first_are_checked() -> None:
    begin_test()

    def made() -> Any:
        @checked
        def inner(number: int) -> int:
            return number

        return inner

    makings = [made() for _ in range(CHECK_MADE + 1)]
    for each in makings[:-1]:
        with pytest.raises(TypeCheckError):
            each("one")
    assert makings[-1]("one") == "one"
