"""Do tried starts lie where the twin's others lie: exact where it can be, else honest."""

from itertools import combinations

import numpy as np
import pytest

from evaluator.compare.prediction_powered import assisted_rates
from evaluator.compare.rows import TrialRow
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Measurement
from evaluator.statistics.prediction_powered import starts_alike


def energy(x: np.ndarray, y: np.ndarray) -> float:
    """Energy distance as Szekely and Rizzo define it, by means over pairs."""

    def mean(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.mean([[np.linalg.norm(p - q) for q in b] for p in a]))

    return 2 * mean(x, y) - mean(x, x) - mean(y, y)


def test_the_test_counts_out_every_split() -> None:
    rng = np.random.default_rng(1)
    tried, others = rng.random((3, 4)), 0.4 + rng.random((5, 4))
    both = np.concatenate([tried, others])
    values = []
    for chosen in combinations(range(8), 3):
        rest = [i for i in range(8) if i not in chosen]
        values.append(energy(both[list(chosen)], both[rest]))
    expected = np.mean(np.array(values) >= energy(tried, others) - 1e-12)
    assert starts_alike(tried, others) == pytest.approx(float(expected))


def test_starts_drawn_alike_are_seldom_refused_and_others_nearly_always() -> None:
    rng = np.random.default_rng(2)
    alike = [starts_alike(rng.random((8, 3)), rng.random((30, 3))) for _ in range(60)]
    apart = [starts_alike(0.4 * rng.random((8, 3)), rng.random((30, 3))) for _ in range(20)]
    assert sum(p < 0.05 for p in alike) <= 8  # more once in 200 000 such tests
    assert sum(p < 0.05 for p in apart) >= 18


def test_the_same_starts_give_the_same_answer_and_it_is_never_zero() -> None:
    rng = np.random.default_rng(3)
    tried, others = rng.random((40, 3)), 5 + rng.random((700, 3))
    p = starts_alike(tried, others)
    assert p == starts_alike(tried, others) == 1 / 5_000


def test_starts_that_are_all_the_same_tell_nothing() -> None:
    assert starts_alike(np.ones((4, 3)), np.ones((6, 3))) == 1.0


def test_one_start_is_too_few() -> None:
    with pytest.raises(UndefinedStatisticError, match="1 localised starts with a robot trial"):
        starts_alike(np.zeros((1, 2)), np.zeros((3, 2)))
    with pytest.raises(UndefinedStatisticError, match="0 localised starts only the twin has"):
        starts_alike(np.zeros((3, 2)), np.zeros((0, 2)))


def row(number: int, recorded: bool | None, place: tuple[float, float, float] | None) -> TrialRow:
    return TrialRow(
        episode=f"e{number}",
        task="cube",
        condition="with_replanning",
        policy="x",
        start_id=f"s{number}",
        cell="c",
        stand_in=True,
        recorded=recorded,
        sim_planned=number % 3 > 0,
        start_positions_m={} if place is None else {"cube": place, "box": (0.5, 0.0, 0.0)},
    )


def found(rows: list[TrialRow]) -> dict[str, Measurement]:
    return {m.id.split(".")[1]: m for m in assisted_rates(rows)}


def rows_at(tried_width: float, *, localised: bool = True) -> list[TrialRow]:
    rng = np.random.default_rng(5)
    rows = []
    for number in range(60):
        tried = number < 12
        x, y = rng.uniform(0, tried_width if tried else 0.4, 2)
        place = (float(x), float(y), 0.02) if localised else None
        rows.append(row(number, number % 3 > 0 if tried else None, place))
    return rows


def test_starts_spread_alike_are_estimated_and_the_overlap_stands_beside_it() -> None:
    numbers = found(rows_at(0.4))
    assert numbers["recorded_rate"].value is not None
    assert numbers["starts_alike_p"].value > 0.05  # type: ignore[operator]
    assert numbers["starts_alike_p"].n == 48
    assert "positions of box, cube" in numbers["starts_alike_p"].definition


def test_starts_tried_in_one_corner_give_no_estimate() -> None:
    numbers = found(rows_at(0.08))
    for name in ("recorded_rate", "trials_saved"):
        assert "lie elsewhere" in str(numbers[name].reason_if_undefined)
    assert numbers["starts_alike_p"].value < 0.01  # type: ignore[operator]


def test_without_localised_objects_the_overlap_says_why_and_forbids_nothing() -> None:
    numbers = found(rows_at(0.08, localised=False))
    assert numbers["recorded_rate"].value is not None
    assert "no object was localised" in str(numbers["starts_alike_p"].reason_if_undefined)


def test_starts_without_one_of_the_objects_are_left_out_and_counted() -> None:
    rows = rows_at(0.4)
    del rows[3].start_positions_m["cube"]
    rows[40].start_positions_m["stray"] = (0.0, 0.0, 0.0)
    numbers = found(rows)
    assert "1 starts without all of them left out" in numbers["starts_alike_p"].definition
    assert "stray" not in numbers["starts_alike_p"].definition
