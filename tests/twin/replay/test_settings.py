"""Settings of replays, gate and physics: no number may make every comparison come out well."""

import math
from dataclasses import fields
from typing import Any

import pytest

from bridge.errors import OptionError
from twin.gate.config import GateConfig
from twin.physics.config import PhysicsConfig
from twin.replay.config import ReplayConfig, ReplayRunConfig

CONFIGS = (GateConfig, ReplayConfig, PhysicsConfig)
NUMBERS = [
    (config, item.name)
    for config in CONFIGS
    for item in fields(config)
    if item.type in (float, float | None) or isinstance(item.default, float)
]


@pytest.mark.parametrize(
    ("config", "name"), NUMBERS, ids=lambda item: getattr(item, "__name__", item)
)
@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0])
def test_what_is_no_number_or_less_than_nothing_is_refused_by_its_name(
    config: Any, name: str, value: float
) -> None:
    """A distance is never below NaN: with it as a limit everything would be accepted."""
    with pytest.raises(OptionError, match=f"--{name.replace('_', '-')} "):
        config(**{name: value})


def test_there_are_numbers_to_try_in_every_settings_record() -> None:
    assert {config for config, _ in NUMBERS} == set(CONFIGS)
    assert len(NUMBERS) > 12


NOTHING = [(PhysicsConfig, n) for n in ("rate_hz", "solver_iterations", "grip_force_N")]


@pytest.mark.parametrize(("config", "name"), [*NOTHING, (ReplayRunConfig, "workers")])
def test_a_number_or_a_force_of_nothing_is_refused(config: Any, name: str) -> None:
    with pytest.raises(OptionError, match=f"--{name.replace('_', '-')} .*makes no sense"):
        config(**{name: 0.0 if name.endswith("_N") else 0})
