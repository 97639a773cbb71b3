"""The derived episodes of a run, found by what they say of themselves and not by file name."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bridge.episode.metadata import Derived
from bridge.episode.reader import Episode
from bridge.episode.run import RunFolder
from bridge.episode.streams import verdicts
from bridge.errors import BridgeError
from bridge.task.verdict import Verdict
from evaluator.result import Exclusion


@dataclass(frozen=True, kw_only=True)
class DerivedFile:
    """One derived episode and what it was made from."""

    path: Path
    episode: Episode
    derived: Derived


@dataclass(frozen=True, kw_only=True)
class Replay:
    """A dynamic replay of one plan with its verdict, or the reason there is none."""

    file: DerivedFile | None
    verdict: Verdict | None
    reason: str | None

    @property
    def accepted(self) -> bool | None:
        """What the twin said; None without a decided verdict."""
        return None if self.verdict is None else self.verdict.accepted


def read_derived(run: RunFolder) -> tuple[list[DerivedFile], list[Exclusion]]:
    """Open every derived episode; a broken one is left out and named."""
    files, left_out = [], []
    for path in run.derived():
        try:
            episode = Episode.open(path)
            derived = episode.derived
        except (BridgeError, TypeError) as error:
            left_out.append(Exclusion(episode=path.name, scope="everything", reason=str(error)))
            continue
        if derived is None:
            reason = "no 'derived' metadata: it does not say what it was made from"
            left_out.append(Exclusion(episode=path.name, scope="everything", reason=reason))
            continue
        files.append(DerivedFile(path=path, episode=episode, derived=derived))
    return files, left_out


def find_replay(
    files: Sequence[DerivedFile], *, source: str, source_sha256: str, plan_id: str, trajectory: str
) -> Replay:
    """Find the dynamic replay of a recorded episode's plan, planned or executed.

    The newest file wins where several settings were tried.
    """
    made = [
        file
        for file in files
        if file.derived.kind == "replay"
        and file.derived.source_episode == source
        and file.derived.plan_id == plan_id
        and file.derived.trajectory == trajectory
        and file.derived.mode == "dynamic"
    ]
    if not made:
        reason = f"no dynamic replay of the {trajectory} trajectory of plan {plan_id}"
        return Replay(file=None, verdict=None, reason=reason)
    current = [file for file in made if file.derived.source_sha256 in ("", source_sha256)]
    if not current:
        reason = (
            f"{made[0].path.name} was made from another version of the episode (its hash "
            "differs); replay it again"
        )
        return Replay(file=None, verdict=None, reason=reason)
    file = max(current, key=_age)
    try:
        said = verdicts(file.episode)
    except BridgeError as error:
        return Replay(file=file, verdict=None, reason=f"{file.path.name}: {error}")
    mine = [verdict for _, verdict in said if verdict.plan_id == plan_id]
    if not mine:
        return Replay(file=file, verdict=None, reason=f"{file.path.name} holds no verdict")
    undecided: str | None = None
    if mine[-1].accepted is None:
        why = mine[-1].reason or _undecided(mine[-1])
        undecided = f"the twin could not decide the {trajectory} replay: {why}"
    return Replay(file=file, verdict=mine[-1], reason=undecided)


def localised_of(files: Sequence[DerivedFile], *, source: str, source_sha256: str) -> list[Episode]:
    """The newest localisation of a recorded episode, in a list; empty when there is none."""
    made = [
        file
        for file in files
        if file.derived.kind == "localised"
        and file.derived.source_episode == source
        and file.derived.source_sha256 in ("", source_sha256)
    ]
    return [max(made, key=_age).episode] if made else []


def _age(file: DerivedFile) -> tuple[int, str]:
    return file.path.stat().st_mtime_ns, file.path.name


def _undecided(verdict: Verdict) -> str:
    names = [n for n in ("ik", "clearance", "terminal") if getattr(verdict, n).value is None]
    return f"{' and '.join(names)} undecided"
