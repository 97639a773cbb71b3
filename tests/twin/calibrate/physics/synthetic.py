"""Cases without a robot: slides, squeezes and pushes by formula, with noise of known size."""

from collections.abc import Sequence

import numpy as np

from bridge.task.task_file import load_task
from twin.calibrate.physics.cases import Case, Prediction
from twin.calibrate.physics.parameters import (
    BIAS,
    FINGER_FRICTION,
    SURFACE_FRICTION,
    PhysicsParameter,
    values_of,
)

TASK = load_task("cube_into_box")
SIGMA_M, SIGMA_RAD, SIGMA_WIDTH_M = 0.001, 0.01, 0.0003
START = np.array([0.5, -0.1, 0.2])


def make_case(kind: str, number: int, *, num_holds: int = 0) -> Case:
    """A case in which nothing is seen yet."""
    covariance = np.diag([SIGMA_M**2, SIGMA_M**2, SIGMA_RAD**2])[None]
    none = np.zeros((1, 3, 3))
    return Case(
        episode=f"{kind}_{number}",
        sha256=f"{number:064x}",
        kind=kind,
        task=TASK,
        urdf="",
        joint_times_s=np.zeros(1),
        joints_rad=np.zeros((1, 6)),
        width_times_s=np.zeros(1),
        width_commands_m=np.zeros(1),
        stretches_s=np.zeros((1, 2)),
        Ts_base_start={"cube": np.eye(4)},
        objects=("cube",),
        start_covariance=none,
        settled=np.zeros((1, 3)),
        settled_covariance=covariance,
        turn_period_rad=np.array([np.pi / 2]),
        hold_times_s=np.zeros(num_holds),
        held_widths_m=np.zeros(num_holds),
    )


class Formulas:
    """Lives cases through in microseconds: a predictor as ``fit`` asks for."""

    def __init__(self, cases: Sequence[Case], parameters: Sequence[PhysicsParameter]) -> None:
        """Know the cases and what the numbers of a point mean."""
        self.cases, self._parameters = list(cases), parameters

    def predict(self, points: np.ndarray, chosen: Sequence[int]) -> list[list[Prediction]]:
        return [[self.one(self.cases[index], x) for index in chosen] for x in points]

    def one(self, case: Case, x: np.ndarray) -> Prediction:
        values = values_of(self._parameters, x)
        pose, number = START.copy(), int(case.episode.rsplit("_", 1)[1])
        direction = 0.7 + 2.1 * number
        if case.kind == "slide":
            speed = 0.6 + 0.05 * (number % 3)
            distance = speed**2 / (2 * values.get(SURFACE_FRICTION, 0.64) * 9.81)
            pose[:2] += distance * np.array([np.cos(direction), np.sin(direction)])
        pose -= [values.get(name, 0.0) for name in BIAS]
        width = 0.035 + 0.02 * np.arctan(values.get(FINGER_FRICTION, 0.8))
        return Prediction(
            settled=pose[None],
            held_widths_m=np.full(len(case.hold_times_s), width),
        )


def observe(
    kinds: Sequence[str], parameters: Sequence[PhysicsParameter], x: np.ndarray, seed: int
) -> Formulas:
    """Cases seen with noise when the truth is ``x``."""
    rng = np.random.default_rng(seed)
    cases = [
        make_case(kind, number, num_holds=int(kind == "squeeze"))
        for number, kind in enumerate(kinds)
    ]
    formulas = Formulas(cases, parameters)
    seen = []
    for case in cases:
        truth = formulas.one(case, x)
        noise = rng.standard_normal(3) * [SIGMA_M, SIGMA_M, SIGMA_RAD]
        widths = truth.held_widths_m + SIGMA_WIDTH_M * rng.standard_normal(len(case.hold_times_s))
        seen.append(
            Case(**{**vars(case), "settled": truth.settled + noise, "held_widths_m": widths})
        )
    return Formulas(seen, parameters)
