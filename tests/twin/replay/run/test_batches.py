"""Pieces put together into tasks: each once, the longest first, short ones together."""

from hypothesis import given
from hypothesis import strategies as st

from twin.replay.workers import SHARE, TASK_S, Batches


def one(cost: float) -> float:
    return cost


def sizes_of(todo: Batches[float], seconds_per_cost: float) -> list[int]:
    sizes = []
    while todo:
        batch = todo.take()
        todo.learn(batch, seconds_per_cost * sum(batch))
        sizes.append(len(batch))
    return sizes


@given(
    costs=st.lists(st.floats(0.01, 100)),
    seconds_per_cost=st.floats(1e-3, 10),
    processors=st.integers(1, 64),
)
def test_each_piece_is_taken_once_the_longest_first_and_no_task_is_too_long(
    costs: list[float], seconds_per_cost: float, processors: int
) -> None:
    todo = Batches(costs, one, processors)
    taken: list[float] = []
    while todo:
        batch = todo.take()
        assert batch
        assert len(batch) == 1 or seconds_per_cost * sum(batch) <= TASK_S * (1 + 1e-9)
        todo.learn(batch, seconds_per_cost * sum(batch))
        taken += batch
    assert taken == sorted(costs, reverse=True)


def test_short_pieces_are_put_together_and_the_last_ones_are_alone() -> None:
    sizes = sizes_of(Batches([1.0] * 500, one, 2), 0.2)
    assert sizes[0] == 1, "how long one takes is not known yet"
    assert max(sizes) == TASK_S / 0.2
    assert sizes[1:] == sorted(sizes[1:], reverse=True)
    assert sizes[-2 * SHARE :] == [1] * (2 * SHARE)
    assert len(sizes) < 500 / 4


def test_long_pieces_stay_alone() -> None:
    assert sizes_of(Batches([1.0] * 50, one, 2), 60.0) == [1] * 50


def test_pieces_of_a_lost_task_are_taken_alone_before_all_others() -> None:
    todo = Batches([1.0] * 100, one, 1)
    todo.learn(todo.take(), 0.01)
    batch = todo.take()
    assert len(batch) > 1
    todo.again(batch)
    assert [todo.take() for _ in batch] == [[1.0]] * len(batch)
    assert len(todo.take()) > 1
