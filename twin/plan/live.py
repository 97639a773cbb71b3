"""A planner on the wire: a cell asks how a task is done from here; it remembers nothing."""

import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bridge.episode.cdr.messages import string_from_cdr
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import PLAN, ROBOT_DESCRIPTION, cell_topic, refuse_bad_name
from bridge.errors import GstError
from bridge.geometry import se3
from bridge.robots.robot import read_robot
from bridge.task.find import Attached, find_task_file
from bridge.task.model_policy import MODEL_POLICY
from bridge.task.plan_request import PlanAnswer, PlanRequest
from bridge.task.task_file import Task
from bridge.terminal import Output, printable, stop_signals
from bridge.wire.config import WireConfig
from twin.plan.config import LivePlanConfig, PlanConfig
from twin.plan.loop.nominal import POLICIES, PlanProposer
from twin.plan.loop.propose import Proposer, choose
from twin.plan.model_goals import ask_for_goals
from twin.plan.problem import NoPlanError, Problem
from twin.plan.shapes import problem_of
from twin.plan.usable_start import refuse_other_robot, refuse_unusable
from twin.robot.model import load_robot

GROUNDING = "gst localisation v1 of the request"
MOST_CANDIDATES = 5
"""Plans that are made at once; a cell may ask for as many rounds."""
ALIVE = "/alive"
"""Behind the service's key: the liveliness token of the planner that answers there."""


class LivePlanner:
    """Answers the requests of one cell from one run."""

    def __init__(
        self,
        run: RunFolder,
        config: LivePlanConfig,
        urdf: Callable[[], str | None],
        proposer: Callable[[str], Proposer] = PlanProposer,
        words: PlanConfig | None = None,
    ) -> None:
        """Prepare; the robot's description is None before any, words name the model to be asked."""
        self._run, self._config, self._urdf = run, config, urdf
        self._proposer = proposer
        self._words = words if words is not None and words.model else None

    def answer(self, payload: bytes) -> PlanAnswer:
        """Plan as asked, or say why not."""
        request = PlanRequest.from_json(payload)
        try:
            return self._planned(request)
        except GstError as error:
            return PlanAnswer(reason=str(error))
        except Exception as error:  # noqa: BLE001  # a bug must not leave a cell without an answer
            traceback.print_exc()
            return PlanAnswer(reason=f"internal error: {type(error).__name__}: {error}")

    @property
    def policies(self) -> list[str]:
        """Those whose requests are answered with plans."""
        return sorted(name for name in POLICIES if self._words or name != MODEL_POLICY)

    def _planned(self, request: PlanRequest) -> PlanAnswer:
        if request.policy == MODEL_POLICY and self._words is None:
            raise NoPlanError(
                "policy 'model' keeps what a vision-language model adds, and this planner asks "
                "none. Start it with one: robot-gst plan RUN --live --model URL --model-name NAME."
            )
        if request.policy not in POLICIES:
            known = ", ".join(self.policies)
            raise NoPlanError(f"policy {request.policy!r} is unknown. There are: {known}.")
        file = find_task_file(
            request.task,
            tasks_dir=self._run.tasks_dir,
            attached=Attached(sha256=request.task_sha256),
        )
        task = file.task()
        problem = self._problem(request, task)
        asked = None
        if request.policy == MODEL_POLICY and self._words is not None:
            asked = ask_for_goals(
                self._run, task.instruction, problem, self._words, file, is_fixed=True
            )
            problem = asked.problem
        candidate = choose(
            self._proposer(request.policy),
            problem,
            plan_id=f"plan_{request.round}",
            seed=request.seed,
            round_=request.round,
            refused=request.refused,
            most=MOST_CANDIDATES,
        )
        plan = replace(
            candidate.plan,
            task_sha256=request.task_sha256,
            start_id=request.start_id,
            round=request.round,
            entities={name: se3.pose_record(T) for name, T in request.Ts_base_object().items()},
            grounding_source=GROUNDING if asked is None else f"{GROUNDING}; {asked.source}",
        )
        return PlanAnswer(plan=plan, remarks=() if asked is None else tuple(asked.lines()))

    def _problem(self, request: PlanRequest, task: Task) -> Problem:
        urdf = self._urdf()
        if urdf is None:
            raise NoPlanError(f"no robot description has arrived on {ROBOT_DESCRIPTION}.")
        robot = load_robot(urdf)
        if (robot.record.name, robot.joints) != (request.robot, request.joint_names):
            raise NoPlanError(
                f"the request is for robot {request.robot!r}; the cell describes "
                f"{robot.record.name!r}."
            )
        covariances = {
            str(record["object"]): np.array(record["covariance"], dtype=np.float64).reshape(6, 6)
            for record in request.objects
            if record.get("covariance") is not None
        }
        poses = request.Ts_base_object()
        if unknown := sorted(poses.keys() ^ task.objects.keys()):
            raise NoPlanError(
                f"the request and task {task.name} differ in objects: {', '.join(unknown)}."
            )
        start_rad = np.array(request.joints_rad, dtype=np.float64)
        problem = problem_of(self._run, task, urdf, poses, covariances, start_rad)
        if not self._config.robot:
            refuse_other_robot(self._run, robot.record)
        refuse_unusable(problem)
        return problem


def claim_planner(session: Any, cell: str) -> None:
    """Let other planners of this cell see that there is one."""
    key = cell_topic(cell, PLAN)[1:] + ALIVE
    if session.query_alive(key):
        raise NoPlanError(
            f"a planner answers on {cell}{PLAN} already, and of two only one would be heard. "
            "Stop it first; one whose machine is gone is forgotten after ten seconds."
        )
    session.declare_alive(key)


def serve_planner(session: Any, planner: LivePlanner, cell: str, output: Output) -> None:
    """Answer on ``<cell>/plan``."""

    def answer(payload: bytes) -> bytes:
        found = planner.answer(payload)
        data = found.to_json()
        if found.plan is None:
            output.say(printable(f"no plan: {found.reason}"))
        else:
            plan, by = found.plan, found.plan.steered_by
            changed = f", steered by {by.clause}" if by is not None else ""
            output.say(
                printable(f"{plan.start_id}: plan of round {plan.round} by {plan.policy}{changed}")
            )
            for line in found.remarks:
                output.say(printable(f"  {line}"))
        return data

    session.serve(cell_topic(cell, PLAN)[1:], answer)


def run_planner(
    path: Path, config: LivePlanConfig, output: Output, words: PlanConfig | None = None
) -> int:
    """Answer a cell's requests until SIGINT or SIGTERM; both end with exit code 0."""
    from bridge.wire.session import open_session  # noqa: PLC0415  # zenoh only when live

    refuse_bad_name("cell", config.cell)
    run = RunFolder.open(path)
    heard: dict[str, str] = {}
    if config.robot:
        heard["urdf"] = read_robot(config.robot).description()

    def hear(sample: Any) -> None:
        if not config.robot:
            heard["urdf"] = string_from_cdr(sample.data)

    planner = LivePlanner(run, config, lambda: heard.get("urdf"), words=words)
    wire = WireConfig(connect=config.connect, config=config.zenoh_config)
    with stop_signals() as stopped, open_session(wire) as session:
        claim_planner(session, config.cell)
        session.subscribe(ROBOT_DESCRIPTION[1:], hear)
        serve_planner(session, planner, config.cell, output)
        output.say(
            f"planner ready: cell {config.cell}, service {config.cell}{PLAN}, policies "
            f"{', '.join(planner.policies)}. Stop with Ctrl-C."
        )
        while not stopped.wait(0.2):
            pass
    output.say("planner stopped")
    return 0
