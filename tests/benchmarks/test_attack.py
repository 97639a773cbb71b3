"""The attack on the gate in small, and the oracle that judges it against other kinematics."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bridge.episode.run_folder import RunFolder
from bridge.errors import BridgeError
from bridge.geometry import se3
from bridge.robots.default import ARM_JOINTS, MAX_WIDTH_M, ROBOT, ROBOT_NAME
from bridge.robots.robot import resolve_mesh
from bridge.task.plan import Plan
from bridge.task.task_file import load_task
from twin.errors import TwinError
from twin.gate.twin_process import Question, answer
from twin.replay.config import ReplayConfig
from twin.replay.scene import ReplayScene

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "benchmarks"))
from attack_gate import Kinematics, payload_of, plans_from, robot_file  # noqa: E402
from plan_mutations import FAMILIES  # noqa: E402
from plan_oracle import BAND, Cell, Oracle  # noqa: E402

HOME_RAD = np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308])
TASK = load_task("cube_into_box")
POSES = {
    "cube": se3.transform_from(np.array([0.92, 0, 0, 0.39]), np.array([0.5, -0.15, 0.02])),
    "box": se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([0.5, 0.19, 0.0])),
}


QUICK = ("valid", "shifted_start", "deeper_contact", "faster", "more_contacts", "other_stages",
         "not_a_number", "swapped_objects", "joint_jump", "velocity_step", "blip", "sudden_end",
         "chatter_3_to_7_hz", "chatter_30_to_60_hz")  # fmt: skip
"""Of these most are refused before physics."""


@pytest.fixture(scope="module")
def oracle() -> Oracle:
    return Oracle(
        Cell(
            urdf=ROBOT.urdf_text(),
            resolve=resolve_mesh,
            task=TASK,
            Ts_base_object=POSES,
            start=dict(zip(ARM_JOINTS, HOME_RAD.tolist(), strict=True)),
            robot=ROBOT_NAME,
            file=robot_file(),
            max_width_m=MAX_WIDTH_M,
        )
    )


@pytest.fixture(scope="module")
def bases() -> list[dict[str, Any]]:
    return plans_from(TASK, POSES, HOME_RAD)[:2]


def judged(payload: bytes, run: Path) -> bool | None:
    """What the gate's process says of a plan; None where it refuses to read or judge it."""
    try:
        plan = Plan.from_json(payload)
        if (plan.task, plan.robot, plan.frame) != (TASK.name, ROBOT_NAME, "base_link"):
            return None  # as twin.gate.gate does before it asks
        question = Question(
            run_path=run,
            plan=plan,
            seen=ReplayScene(
                task=TASK, Ts_base_object=POSES, urdf=ROBOT.urdf_text(), start_rad=HOME_RAD
            ),
            config=ReplayConfig(),
            max_steps=100_000,
        )
        return answer(question).accepted
    except (BridgeError, TwinError):
        return None


def test_no_family_of_mutations_gets_a_yes_for_a_plan_that_is_unsafe(
    oracle: Oracle, bases: list[dict[str, Any]], tmp_path: Path
) -> None:
    run = RunFolder.create(tmp_path / "run").path
    solve, unsafe = Kinematics(), []
    for number, name in enumerate(FAMILIES):
        if name not in QUICK:
            continue
        family, payload = payload_of(7, number, bases, solve)
        said, why = judged(payload, run), oracle.unsafe(json.loads(payload))
        assert not (said is True and why), (family, why)
        assert said is True or family != "valid"
        unsafe += [family] if why else []
    assert len(unsafe) >= len(QUICK) // 2, unsafe


@pytest.mark.parametrize(("share", "refused"), [(0.9, False), (1.2, True)])
def test_the_oracle_sees_what_is_a_little_beyond_the_file_of_the_arm(
    oracle: Oracle, share: float, refused: bool
) -> None:
    """From rest to rest over d in h no joint needs less than 4 d / h^2; as a sine A w^2."""
    times = np.arange(0, 1.0001, 0.004)
    size = share * 15.0 / (14 * np.pi) ** 2
    for t, rows in (
        (np.array([0, 0.5]), np.array([0, share * 15.0 * 0.25 / 4])),
        (times, size * np.sin(np.pi * times) ** 2 * np.sin(14 * np.pi * times)),
    ):
        joints = np.tile(HOME_RAD, (len(t), 1))
        joints[:, 2] += rows
        tau = [{"t_ns": round(a * 1e9), "joints_rad": q.tolist(), "g": 0}
               for a, q in zip(t, joints, strict=True)]  # fmt: skip
        assert (oracle.least_acceleration({"tau": tau}) > BAND) is refused
        assert oracle.least_acceleration({"tau": tau}) == pytest.approx(share, rel=0.08)
