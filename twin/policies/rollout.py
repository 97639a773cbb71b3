"""Let a policy act in the twin from one start, judge what it did, and keep it as an episode."""

import re
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bridge.episode import streams
from bridge.episode.cdr.messages import CompressedColor
from bridge.episode.metadata import ROLLOUT, Derived, EpisodeInfo
from bridge.episode.provenance import hash_file, hash_settings
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.media.color import encode_jpeg
from bridge.task.plan import Plan
from twin.policies.cell import TwinCell
from twin.policies.colours import gains_of
from twin.policies.config import is_driven
from twin.policies.errors import PolicyError, RefusedError, StoppedError
from twin.policies.mapping import Interpreter, PolicyMap, is_end
from twin.policies.policy import Policy, open_policy, who_acts
from twin.policies.starts import Start, drawn_starts, open_start
from twin.policies.variation import Quantity, draw, varied_start
from twin.policies.views import Pictures, TwinCameras
from twin.replay.output import ReplayOrigin, write_replay
from twin.replay.result import ReplayResult
from twin.replay.run_job import cell_of

ROLLOUT_VERSION = 4
"""Raise it when the same inputs give another rollout, so that old files are redone."""
LOOK_S = 0.5
"""How often it is asked whether the task is done."""


@dataclass(frozen=True, kw_only=True)
class RolloutJob:
    """Everything that decides one rollout; its content names the file."""

    run_path: Path
    episode_path: Path
    """Whose start it is, or whose cell."""
    drawn: int | None
    """Number of the drawn start; None: the recorded one."""
    seed: int
    number: int
    """Of the rollouts from this start, from 0."""
    policy: str
    """How it is opened."""
    name: str
    """What it is called in tables."""
    mapping: PolicyMap
    vary: tuple[Quantity, ...]
    max_s: float
    latency_s: float
    timeout_s: float

    def settings(self) -> dict[str, Any]:
        """What the name of the file covers; of a file of keys what it holds, not its place."""
        keys = Path(self.policy.removeprefix("keys:"))
        held = is_driven(self.policy) and keys.is_file()
        varied = {item.name: item.spread for item in self.vary}
        return {
            **({"vary": varied} if varied else {}),
            "rollout_version": ROLLOUT_VERSION,
            "policy": f"keys:{hash_file(keys)}" if held else self.policy,
            "name": self.name,
            "mapping_sha256": self.mapping.sha256(),
            "drawn": self.drawn,
            "seed": self.seed,
            "number": self.number,
            "max_s": self.max_s,
            "latency_s": self.latency_s,
        }

    def path(self) -> Path:
        """Where the derived episode goes."""
        name = re.sub(r"[^A-Za-z0-9_-]", "-", self.name)[:40]
        parts = (self.episode_path.stem, ROLLOUT, name, hash_settings(self.settings()), "mcap")
        return RunFolder(self.run_path).derived_dir.resolve() / ".".join(parts)

    def cost(self) -> float:
        """How long it takes, compared with others."""
        return self.max_s

    def needed_paths(self) -> tuple[Path, ...]:
        """What a process on another machine must see."""
        return (self.run_path, self.episode_path)


@dataclass
class Acted:
    """What a policy did, and why it ended."""

    stopped: str = ""
    """The limit at which the cell stopped it; empty: none."""
    problem: str = ""
    """Why its rollout says nothing of it; empty: it does."""
    asked: int = 0
    answer_s: float = 0.0
    """Time that the policy took, over all answers."""
    pictures: list[tuple[int, Pictures]] = field(default_factory=list)
    """What it saw, and when."""


def roll_out(job: RolloutJob) -> dict[str, Any]:
    """Do one rollout and write it; what a user can act on becomes a row, not an exception."""
    info = EpisodeInfo(id=job.episode_path.stem, kind="trial")
    try:
        run = RunFolder.open(job.run_path)
        episode = Episode.open(job.episode_path)
        info = episode.info
        start = open_start(run, episode)
        if job.drawn is not None:
            *_, start = drawn_starts(start, job.drawn + 1, job.seed)
        policy = open_policy(job.policy, job.timeout_s)
        try:
            return _roll_out(job, run, episode, start, policy)
        finally:
            policy.close()
    except GstError as error:
        return _row(job, info, info.start_id or info.id, Acted(problem=str(error)), None)


def _roll_out(
    job: RolloutJob, run: RunFolder, episode: Episode, start: Start, policy: Policy
) -> dict[str, Any]:
    drawn = draw(job.vary, job.seed, start.id, job.number)
    start = varied_start(start, drawn) if drawn else start
    cell = TwinCell(start)
    try:
        speak = Interpreter(job.mapping, cell.robot, start.task.instruction)
        names = speak.cameras() or tuple(streams.camera_ids(episode))
        gains = gains_of(run, episode, names)
        live = is_driven(job.policy)
        cameras = TwinCameras(run, start, names, speak.sizes(), drawn, gains, live=live)
        policy.reset(job.seed + job.number)
        acted = act(cell, cameras, policy, speak, max_s=job.max_s, latency_s=job.latency_s)
        cell.rest(start.config.settle_after_s)
        info = replace(episode.info, policy=job.name, task=start.task.name)
        result, plan = cell.judged(info)
        row = _row(job, info, start.id, acted, result)
        row["varied"] = {q.name: round(q.amount(drawn[q.name]), 6) for q in job.vary}
        row["gains"] = dict(gains)
        row["response"] = start.response.to_record()
        row["shutters"] = {name: asdict(each) for name, each in cameras.shutters.items()}
        row["checkpoint"] = who_acts(job.policy, job.mapping, policy.metadata)
        _write(job, episode, start, (result, plan), acted, row, policy.metadata)
        return row
    finally:
        cell.close()


@dataclass
class _Follower:
    """Brings the cell where rows of answers say."""

    cell: TwinCell
    policy: Policy
    speak: Interpreter
    max_s: float
    steps: int = 0

    @property
    def period_s(self) -> float:
        """Time that one row has."""
        return 1.0 / self.speak.mapping.rate_hz

    def follow(self, rows: np.ndarray) -> bool:
        """Whether to go on: the task is not done, and there is time."""
        look = max(1, round(LOOK_S / self.period_s))
        for row in rows:
            allowed = self._go(row)
            self.steps += 1
            if self.cell.burst or self.cell.t_ns >= self.max_s * 1e9:
                return False
            if self.steps % look == 0 and self.cell.succeeds():
                return False
            if not allowed:
                break  # it is asked again
        return True

    def _go(self, row: np.ndarray) -> bool:
        """Whether the limits let it; a policy that takes their words goes on all the same."""
        cell = self.cell
        try:
            target = self.speak.target(row, cell.target_rad, cell.target_width_m)
            cell.go(*target, self.period_s)
        except RefusedError as error:
            if not self.policy.refused(str(error)):
                raise
            cell.slow_down(self.period_s)
            return False
        return True


def act(
    cell: TwinCell,
    cameras: TwinCameras,
    policy: Policy,
    speak: Interpreter,
    *,
    max_s: float,
    latency_s: float,
) -> Acted:
    """Ask and follow until the task is done, a limit stops the cell, or time is up.

    The cell's clock runs on while the policy thinks: the rest of its last answer goes on, or the
    arm holds.

    Args:
        latency_s: From a picture to the first action that answers it.
    """
    does = _Follower(cell=cell, policy=policy, speak=speak, max_s=max_s)
    late = round(latency_s / does.period_s)
    acted, rest = Acted(), np.zeros((0, speak.num_values()))
    try:
        going = True
        while going:
            pictures = cameras.draw(cell)
            if not acted.pictures:
                _refuse_blind(pictures)
            acted.pictures.append((cell.t_ns, pictures))
            began = time.monotonic()
            found = policy.infer(speak.observation(pictures, *cell.posture()))
            acted.answer_s += time.monotonic() - began
            if is_end(found):
                break
            answer = speak.rows(found)
            acted.asked += 1
            going = does.follow(rest[:late])
            for _ in range(late - len(rest) if going else 0):
                cell.hold(does.period_s)
            horizon = speak.mapping.horizon or len(answer)
            rest = answer[horizon:]
            going = going and does.follow(answer[:horizon])
    except StoppedError as error:
        acted.stopped = str(error)
    except PolicyError as error:
        acted.problem = str(error)
    return acted


def _refuse_blind(pictures: Pictures) -> None:
    """Refuse cameras in whose view there is nothing of the scene."""
    blind = [name for name, picture in pictures.items() if not picture.any()]
    if blind:
        raise PolicyError(
            f"camera {', '.join(blind)} sees nothing of the scene: scan what it looks at"
        )


def _row(
    job: RolloutJob, info: EpisodeInfo, start_id: str, acted: Acted, result: ReplayResult | None
) -> dict[str, Any]:
    """One line of the table. Success is None where the rollout says nothing of the policy."""
    success = None
    if result is not None and not acted.problem:
        done = result.verdict.terminal.value
        success = False if acted.stopped else done
    detail = None if result is None else result.verdict.terminal.detail
    return {
        "policy": job.name,
        "task": info.task,
        "stand_in": info.stand_in,
        "start_id": start_id,
        "number": job.number,
        "success": success,
        "stopped": acted.stopped,
        "problem": acted.problem,
        "detail": acted.problem or acted.stopped or detail or "",
        "seconds": 0.0 if result is None else float(result.stamps_ns[-1]) * 1e-9,
        "asked": acted.asked,
        "answer_s": round(acted.answer_s, 3),
        "file": job.path().name,
    }


def _write(
    job: RolloutJob,
    episode: Episode,
    start: Start,
    judged: tuple[ReplayResult, Plan],
    acted: Acted,
    row: Mapping[str, Any],
    metadata: Mapping[str, Any],
) -> None:
    result, plan = judged
    derived = Derived(
        kind=ROLLOUT,
        source_episode=episode.info.id,
        source_sha256=episode.sha256(),
        plan_id=plan.id,
        trajectory=ROLLOUT,
        mode="dynamic",
        scene_hash=start.scene.scene_hash,
        engine=result.verdict.engine,
        seed=job.seed,
        calibration_id=start.scene.calibration_id,
        settings={
            **job.settings(),
            "prompt": job.mapping.prompt or start.task.instruction,
            "server_sha256": hash_settings(dict(metadata)),
            ROLLOUT: dict(row),
        },
    )
    origin = ReplayOrigin(
        info=replace(episode.info, policy=job.name),
        derived=derived,
        cell=cell_of(episode),
        start_ns=start.stamp_ns,
        urdf=start.scene.urdf,
        stages=plan.stages,
        end_ns=plan.tau[-1].t_ns,
        images=tuple(
            (
                camera_id,
                CompressedColor(
                    stamp_ns=start.stamp_ns + t_ns,
                    frame_id=camera_id,
                    format="jpeg",
                    data=encode_jpeg(picture),
                ),
            )
            for t_ns, pictures in acted.pictures
            for camera_id, picture in pictures.items()
        ),
    )
    path = job.path()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    write_replay(path, result, plan, origin)


def row_of_file(path: Path) -> dict[str, Any] | None:
    """The row of a rollout that was made before; None where there is none."""
    try:
        episode = Episode.open(path)
        made, info = episode.derived, episode.info
    except GstError:
        return None
    row = None if made is None else made.settings.get(ROLLOUT)
    return {**row, "stand_in": info.stand_in} if isinstance(row, dict) else None
