"""What a vision-language model says of a task: goals of an instruction, constraints of stages.

Of an instruction in words a model is asked first; where it says an object ends becomes the goals,
which are checked and made into a task by the same rules as those of the grammar. Of a task that
exists, what counts as success and what may touch what stay those of its file. A model cuts a task
into stages of its own; what it asks joins the stage of the task in which the same object is
grasped, carried or released.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.task.plan import Stage
from bridge.task.task_file import Task, TaskFile
from twin.plan.config import PlanConfig
from twin.plan.constrain.kinds import compile_constraint
from twin.plan.constrain.relations import PLACES, predicate_of
from twin.plan.constrain.schema import Vocabulary
from twin.plan.ground.derive import derive_task
from twin.plan.ground.goals import Goals, Grounding, ordered
from twin.plan.ground.model_client import (
    BY_GRAMMAR,
    READ_INSTEAD,
    Answer,
    ModelConfig,
    Question,
    ask_model,
)
from twin.plan.ground.run_tasks import UnderstoodTask
from twin.plan.ground.vocabulary import GroundingError, vocabulary_of
from twin.plan.ground.vocabulary import Vocabulary as Things
from twin.plan.loop.tau import stages_of
from twin.plan.problem import Problem
from twin.plan.usable_start import refuse_unusable
from twin.scene.store.folder import read_record

REPLIES = "model_replies"
"""Folder of the run's ``derived/`` with replies that were taken."""


@dataclass(frozen=True, kw_only=True)
class Asked:
    """What came of asking a model."""

    problem: Problem
    """Its task has the constraints that were added; as it was where the grammar answered."""
    config: PlanConfig
    answered_by: str
    remarks: tuple[str, ...]
    understood: UnderstoodTask | None = None
    """The task that a model made of an instruction; None: it is a file's, or the grammar's."""

    def lines(self) -> list[str]:
        """For a person: who answered, whom was asked, what was sent."""
        head = f"stages: answered by {self.answered_by}; asked {self.config.model}"
        return [head, *(f"  {remark}" for remark in self.remarks)]

    @property
    def source(self) -> str:
        """Who answered and who was asked, for a plan."""
        config = self.config
        return (
            f"stages: answered by {self.answered_by}; asked {config.model_name} at {config.model}"
        )

    def left_out(self, problem: Problem, why: Exception) -> "Asked":
        """The same without what the model added."""
        remark = f"no plan keeps what the model added, so its constraints were left out: {why}"
        who = BY_GRAMMAR if self.understood is None else self.answered_by
        return replace(self, problem=problem, answered_by=who, remarks=(*self.remarks, remark))

    def to_json(self) -> dict[str, Any]:
        """The same as data."""
        return {
            "answered_by": self.answered_by,
            "address": self.config.model,
            "remarks": list(self.remarks),
        }


def ask_about(
    run: RunFolder, problem: Problem, config: PlanConfig, *, keep_refused: bool = False
) -> Asked:
    """Ask the model of the settings for constraints; without an answer the task stays as it is."""
    task = problem.scene.task
    vocabulary = Vocabulary.of_task(task)
    question = _question(run, problem, vocabulary, task.instruction)
    client = replace(client_of(run, config), keep_refused=keep_refused)
    answer = ask_model(question, client)
    asked = _asked(answer, config, problem)
    if answer.answered_by == BY_GRAMMAR:
        return asked
    added, left_out = with_added(problem, answer.stages)
    return replace(asked, problem=added, remarks=(*asked.remarks, *left_out))


def ask_for_goals(
    run: RunFolder, words: str, base: TaskFile, problem: Problem, config: PlanConfig
) -> Asked:
    """Ask the model of the settings what an instruction wants; ``understood`` is the task of it."""
    vocabulary = Vocabulary.of_task(problem.scene.task, objects_alone=True)
    question = _question(run, problem, vocabulary, words)
    answer = ask_model(question, client_of(run, config))
    asked = _asked(answer, config, problem)
    if answer.answered_by == BY_GRAMMAR:
        return asked
    try:
        things = vocabulary_of(base.task(), _instances(run))
        grounding = goals_in(answer.stages, words, things, f"{config.model_name} said so")
        file = derive_task(grounding, [base], by="model")
        derived = retasked(problem, file.task())
        refuse_unusable(derived)
    except GstError as error:
        remarks = (*asked.remarks, f"its goals cannot be used: {error}", READ_INSTEAD)
        return replace(asked, answered_by=BY_GRAMMAR, remarks=remarks)
    added, left_out = with_added(derived, answer.stages)
    return replace(
        asked,
        problem=added,
        understood=UnderstoodTask(file=file, grounding=grounding),
        remarks=(*asked.remarks, *left_out),
    )


def retasked(problem: Problem, task: Task) -> Problem:
    """The same start with another task about the same objects; their calibrated masses stay."""
    task = replace(task, objects=problem.scene.task.objects)
    return replace(problem, scene=replace(problem.scene, task=task))


def goals_in(
    stages: Sequence[Stage], words: str, vocabulary: Things, explanation: str
) -> Grounding:
    """The goals in a model's stages: where each object ends that is let go, in that order."""
    goals = Goals(vocabulary)
    for stage in stages:
        if stage.release is None:
            continue
        mine = [goal for record in stage.subgoal if (goal := predicate_of(record)) is not None]
        mine = [goal for goal in mine if goal["object"] == stage.release]
        if not mine:
            message = f"no subgoal says where {stage.release} is to end"
            raise GroundingError("unknown_clause", message, candidates=PLACES)
        goals.add_clause(mine)
    goals.edges += [(number, number + 1) for number in range(len(goals.steps) - 1)]
    goals.is_order_given = len(goals.steps) > 1
    if not goals.steps:
        raise GroundingError("empty", "no stage lets anything go.")
    found = goals.checked()
    return Grounding(
        text=words,
        goals=tuple(found),
        order=ordered(goals, found),
        is_order_given=goals.is_order_given,
        explanation=(explanation,),
    )


def _instances(run: RunFolder) -> Sequence[Mapping[str, Any]]:
    """What the run's scene says its objects look like."""
    semantics: Mapping[str, Any] = (read_record(run) or {}).get("semantics") or {}
    return list(semantics.get("instances", ()))


def _question(run: RunFolder, problem: Problem, vocabulary: Vocabulary, words: str) -> Question:
    things = vocabulary_of(problem.scene.task, _instances(run)).things
    return Question(
        task=words,
        vocabulary=vocabulary,
        labels={key: thing.describe() for key, thing in things.items()},
    )


def _asked(answer: Answer, config: PlanConfig, problem: Problem) -> Asked:
    who, remarks = answer.answered_by, answer.remarks
    return Asked(problem=problem, config=config, answered_by=who, remarks=remarks)


def client_of(run: RunFolder, config: PlanConfig) -> ModelConfig:
    """Whom the settings ask."""
    return ModelConfig(
        url=config.model,
        model=config.model_name,
        cache=run.derived_dir / REPLIES,
    )


def with_added(problem: Problem, stages: tuple[Stage, ...]) -> tuple[Problem, tuple[str, ...]]:
    """Add the constraints of a model's stages to those of the task's."""
    task, remarks = problem.scene.task, list[str]()
    added: dict[str, list[dict[str, Any]]] = {}
    held: str | None = None
    for stage in stages:
        held = stage.grasp or held
        if held is None:
            if stage.subgoal or stage.path:
                remarks.append(f"left out stage {stage.id}: nothing is held in it")
            continue
        ids, verbs = stages_of(task, held), _verbs(stage, held, stages)
        for kind, names in (("subgoal", verbs[-1:]), ("path", verbs)):
            for record in getattr(stage, kind):
                if kind == "subgoal" and predicate_of(record) in task.success:
                    continue  # asked already
                why = _misfit(problem, record, kind)
                if kind == "subgoal" and verbs[-1] not in ids:
                    why = f"the task has no stage of its own to {verbs[-1]} {held}"
                if why:
                    remarks.append(f"left out {record['kind']} of stage {stage.id}: {why}")
                    continue
                for verb in names:
                    stage_id = ids.get(verb, ids.get("release", ""))
                    added.setdefault(f"{stage_id} {kind}", []).append(dict(record))
        held = None if stage.release is not None else held
    tables = tuple(_joined(table, added) for table in task.stages)
    changed = replace(task, stages=tables)
    return replace(problem, scene=replace(problem.scene, task=changed)), tuple(remarks)


def _verbs(stage: Stage, held: str, stages: tuple[Stage, ...]) -> tuple[str, ...]:
    """What a model's stage is about; a release with no stage before it carries, too."""
    if stage.grasp is not None:
        return ("grasp",)
    if stage.release is None:
        return ("carry",)
    return ("release",) if _carried(stages, held) else ("carry", "release")


def _misfit(problem: Problem, record: Mapping[str, Any], kind: str) -> str:
    """Why a constraint cannot be added; empty: it can."""
    if kind == "subgoal" and record["kind"] in PLACES:
        return "where objects end is the task file's to say"
    try:
        compile_constraint(record, problem)
    except GstError as error:
        return str(error)
    return ""


def _carried(stages: tuple[Stage, ...], key: str) -> bool:
    """Whether a model has a stage between the grasp and the release of an object."""
    held = False
    for stage in stages:
        if held and stage.grasp is None and stage.release is None:
            return True
        held = stage.grasp == key or (held and stage.release is None)
    return False


def _joined(
    table: Mapping[str, Any], added: Mapping[str, Sequence[dict[str, Any]]]
) -> dict[str, Any]:
    """A stage's table with more constraints, none twice; contacts as they were."""
    joined = dict(table)
    for kind in ("subgoal", "path"):
        for record in added.get(f"{table['id']} {kind}", ()):
            before = joined.get(kind, [])
            if record not in before:
                joined[kind] = [*before, record]
    return joined
