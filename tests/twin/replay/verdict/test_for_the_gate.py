"""The gate's process with the real replay behind it."""

import math
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bridge.episode.run_folder import RunFolder
from bridge.terminal import Output
from twin.gate.config import GateConfig
from twin.gate.gate import UndecidedError
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
    scene = script.scene()
    plan, found = script.plan(scene), as_localised(scene)
    config = GateConfig(samples=1, replay=ReplayConfig())
    run = RunFolder.create(tmp_path / "run")
    with TwinProcess(run.path, config, Output(quiet=True)) as twin:
        start_rad = good.joints_rad[0]
        first = twin.replay(plan, scene.task, found, scene.urdf, start_rad, soon(120))
        assert first.p_success is not None
        assert (first.p_success["k"], first.p_success["n"]) == (1, 1)
        # Beside what a replay checks, the gate knows where the arm is, and audits its yes.
        more = {name: first.checks[name].value for name in ("start", "audit")}
        assert more == {"start": True, "audit": True}
        same = replace(first, p_success=None, reason=None, checks=good.verdict.checks)
        assert same == good.verdict
        assert "within the cavity of box" in str(first.reason)
        assert first.checks.items() >= good.verdict.checks.items()
        nowhere = replace(plan.tau[3], p_m=(math.nan, 0.0, 0.2))
        lost = replace(plan, tau=(*plan.tau[:3], nowhere, *plan.tau[4:]))
        with pytest.raises(UndecidedError, match="not finite"):
            twin.replay(lost, scene.task, found, scene.urdf, start_rad, soon(60))
