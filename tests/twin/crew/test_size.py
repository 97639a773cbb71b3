"""How many processes there are by default."""

import os

import pytest

from twin.crew.pool import MOST, default_size


@pytest.mark.parametrize(("cores", "size"), [(1, 1), (2, 2), (64, MOST)])
def test_each_core_that_may_be_used_has_a_process_up_to_a_limit(
    monkeypatch: pytest.MonkeyPatch, cores: int, size: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    assert default_size() == size
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    assert default_size() == size
