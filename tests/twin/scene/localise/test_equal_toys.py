"""Several equal toys: told apart, cut apart, and not mistaken for what is not there."""

from collections.abc import Callable
from typing import Any

import pytest
from toy_frames import DUCK, DUCKS, ducks_at, off, only, shoot, table_with

from twin.scene.localise import soft
from twin.scene.localise.objects import localise_objects

PLACES = ducks_at((0.39, -0.27, 0.2), (0.55, -0.27, -0.8), (0.39, -0.13, 1.0))


def test_equal_toys_are_told_apart_by_where_they_start(stage: Callable[..., Any]) -> None:
    task = only(DUCKS, "duck_3", "duck_1", "duck_2")
    found = localise_objects(shoot(table_with(stage, *[(DUCK, T) for T in PLACES])), task)
    for name, T in zip(("duck_1", "duck_2", "duck_3"), PLACES, strict=True):
        assert found[name].found, found[name].reason
        distance_mm, angle_deg = off(found[name].T_base_object, T)
        assert distance_mm < 2.5
        assert angle_deg < 4.0


@pytest.mark.slow
def test_toys_that_stayed_keep_their_names_when_another_one_was_moved(
    stage: Callable[..., Any],
) -> None:
    task = only(DUCKS, "duck_1", "duck_2", "duck_3")
    now = [PLACES[0], PLACES[2], *ducks_at((0.50, 0.0, 0.4))]
    last = {f"duck_{index + 1}": T[:3, 3] for index, T in enumerate(PLACES)}
    found = localise_objects(shoot(table_with(stage, *[(DUCK, T) for T in now])), task, last)
    for name, T in (("duck_1", now[0]), ("duck_3", now[1]), ("duck_2", now[2])):
        assert off(found[name].T_base_object, T)[0] < 2.5


@pytest.mark.slow
@pytest.mark.parametrize("growth", [soft.GROWTH, 3.0])
def test_toys_that_touch_are_cut_apart(
    stage: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, growth: float
) -> None:
    """Also where they do not look too large, as behind a rim: no single toy explains them."""
    monkeypatch.setattr(soft, "GROWTH", growth)
    task = only(DUCKS, "duck_1", "duck_3")
    places = ducks_at((0.45, -0.20, 0.0), (0.45, -0.148, 0.0))
    found = localise_objects(shoot(table_with(stage, *[(DUCK, T) for T in places])), task)
    for name, T in zip(("duck_1", "duck_3"), places, strict=True):
        assert found[name].found, found[name].reason
        assert off(found[name].T_base_object, T)[0] < 6.0
