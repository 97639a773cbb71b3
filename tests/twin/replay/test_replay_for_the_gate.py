"""The gate's process with the real replay behind it, and plans it must not say yes to."""

import math
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bridge.episode.run import RunFolder
from bridge.task.verdict import Verdict
from bridge.terminal import Output
from twin.gate.config import GateConfig
from twin.gate.judge import Gate, UndecidedError
from twin.gate.twin_process import TwinProcess
from twin.replay.config import ReplayConfig
from twin.replay.result import ReplayResult


def soon(seconds: float) -> float:
    return time.monotonic() + seconds


def as_localised(scene: Any) -> dict[str, Any]:
    unsure = np.diag([1e-8, 1e-8, 0.0, 0.0, 0.0, 1e-8])
    return {
        name: SimpleNamespace(found=True, reason=None, T_base_object=T, covariance=unsure)
        for name, T in scene.Ts_base_object.items()
    }


@pytest.mark.slow
def test_the_gates_process_says_what_the_replay_says_and_adds_samples(
    tmp_path: Path, script: SimpleNamespace, good: ReplayResult
) -> None:
    """Also: a process that was stopped comes back, and too little time for a sample gives none."""
    scene = script.scene()
    plan, found = script.plan(scene), as_localised(scene)
    config = GateConfig(samples=2, replay=ReplayConfig())
    run = RunFolder.create(tmp_path / "run")
    with TwinProcess(run.path, scene.task, config, Output(quiet=True)) as twin:
        first = twin.replay(plan, found, scene.urdf, soon(120))
        assert first.p_success is not None
        assert (first.p_success["k"], first.p_success["n"]) == (2, 2)
        assert replace(first, p_success=None) == good.verdict
        nowhere = replace(plan.tau[3], p_m=(math.nan, 0.0, 0.2))
        lost = replace(plan, tau=(*plan.tau[:3], nowhere, *plan.tau[4:]))
        with pytest.raises(UndecidedError, match="not finite"):
            twin.replay(lost, found, scene.urdf, soon(60))
        with pytest.raises(UndecidedError, match="was not done before the deadline"):
            twin.replay(plan, found, scene.urdf, soon(0.05))
        gate = Gate(
            task=scene.task,
            config=config,
            eyes=_Eyes(scene.urdf),
            localise=lambda *_: found,
            replay=twin.replay,
            now_ns=lambda: 0,
        )
        beside = script.plan(scene, place_m=(0.5, -0.4, 0.12))
        verdict: Verdict = gate.judge(beside.to_json())
        assert verdict.accepted is not True


class _Eyes:
    def __init__(self, urdf: str) -> None:
        self._urdf = urdf

    def urdf(self) -> str:
        return self._urdf

    def executing(self) -> None:
        return None

    def newest_ns(self) -> int:
        return 1

    def heard_ns(self) -> int:
        return 0

    def frames(self, **_: Any) -> Any:
        return SimpleNamespace(frames=[SimpleNamespace(stamp_ns=1)], reasons=[])
