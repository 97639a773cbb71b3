"""Steps of the system clock are noticed in both directions, each once."""

import pytest

from bridge.clock import StepWatch

S = 1_000_000_000


@pytest.mark.parametrize("step_ns", [S, -S, 51_000_000, -51_000_000])
def test_a_step_is_said_once_with_its_sign(step_ns: int) -> None:
    now_ns, wall_ns = [0], [100 * S]
    watch = StepWatch(lambda: now_ns[0], wall_ns=lambda: wall_ns[0])
    for step in (0, step_ns, 0, -step_ns):
        now_ns[0] += S
        wall_ns[0] += S + step
        assert watch.step_ns() == step
