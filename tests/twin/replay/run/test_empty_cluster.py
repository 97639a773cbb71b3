"""A cluster without processors would be waited for as long as nobody looks at the terminal."""

from types import SimpleNamespace
from typing import Any

import pytest

from twin.replay import workers
from twin.replay.workers import RayClusterError, RayRunner


def runner(monkeypatch: pytest.MonkeyPatch, cpus: list[float]) -> RayRunner:
    """One whose cluster has so many processors at each look, and is done after the last."""
    monkeypatch.setattr(workers, "code_version", lambda: "same")
    looks = iter(cpus)

    def wait(running: list[str], **_: Any) -> tuple[list[str], list[str]]:
        return (running[:1], []) if made._ray.over else ([], running)

    def resources() -> dict[str, float]:
        found = next(looks, None)
        made._ray.over = found is None
        return {"CPU": found} if found else {}

    made = RayRunner("head.lab:6379", 1)
    task = SimpleNamespace(remote=lambda _, item, __: item)
    made._ray = SimpleNamespace(
        remote=lambda **_: lambda _: task,
        wait=wait,
        get=lambda reference: reference,
        cluster_resources=resources,
        exceptions=SimpleNamespace(RayError=RuntimeError),
        over=False,
    )
    return made


def test_a_cluster_that_has_no_processor_for_minutes_ends_with_a_sentence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    empty = runner(monkeypatch, [1.0] + [0.0] * 100)
    with pytest.raises(RayClusterError, match=r"at head\.lab:6379 has had no processor for 5 min"):
        list(empty.run(eval, ["1 + 1"], len))


def test_a_cluster_whose_nodes_come_late_or_come_back_is_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slow = runner(monkeypatch, [0.0] * 4 + [2.0] * 20 + [0.0] * 4 + [2.0])
    assert [item for item, _ in slow.run(eval, ["1 + 1"], len)] == ["1 + 1"]
