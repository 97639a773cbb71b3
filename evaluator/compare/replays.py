"""The derived episodes of a run, found by what they say of themselves and not by file name."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from bridge.episode import schema
from bridge.episode.metadata import Derived, EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.streams import verdicts
from bridge.errors import GstError
from evaluator.compare.inventory import RunFile
from evaluator.compare.recorded import Place, places_in
from evaluator.compare.said import Said, said_by
from evaluator.errors import EvaluatorError


@dataclass(frozen=True, kw_only=True)
class DerivedFacts:
    """What one derived episode says of itself."""

    info: EpisodeInfo
    derived: Derived
    verdict: Said | None = None
    """Of a dynamic replay: the last verdict on the plan it replays."""
    places: tuple[Place, ...] = ()
    """Of a localisation: where objects were found."""
    broken: str = ""
    """Why verdict or places cannot be read, empty where they can."""


@dataclass(frozen=True, kw_only=True)
class DerivedFile:
    """One derived episode and what it was made from."""

    file: RunFile
    facts: DerivedFacts

    @property
    def path(self) -> Path:
        """Of its first part."""
        return self.file.path

    @property
    def name(self) -> str:
        """Relative to the run folder."""
        return self.file.name

    @property
    def sha256(self) -> str:
        """Of its bytes."""
        return self.file.sha256

    @property
    def info(self) -> EpisodeInfo:
        """Who, what and when."""
        return self.facts.info

    @property
    def derived(self) -> Derived:
        """What it was made from."""
        return self.facts.derived

    @property
    def episode(self) -> Episode:
        """Open it; nothing is held open, so whoever asks twice opens it twice.

        Raises:
            BridgeError: When it has gone or changed since.
        """
        return Episode.open(self.path)

    @property
    def age(self) -> tuple[int, str]:
        """What the newest file has the largest of."""
        return self.path.stat().st_mtime_ns, self.path.name


@dataclass(frozen=True, kw_only=True)
class Replay:
    """A dynamic replay of one plan with its verdict, or the reason there is none."""

    file: DerivedFile | None = None
    verdict: Said | None = None
    reason: str | None = None

    @property
    def accepted(self) -> bool | None:
        """What the twin said; None without a decided verdict."""
        return None if self.verdict is None else self.verdict.accepted


def read_derived(path: Path) -> DerivedFacts:
    """Sum up a derived episode from its metadata and its few messages about verdicts or places.

    Raises:
        GstError: When it cannot be opened, or does not say what it was made from.
    """
    episode = Episode.open(path)
    derived = episode.derived
    if derived is None:
        raise EvaluatorError("no 'derived' metadata: it does not say what it was made from")
    info = episode.info
    try:
        if _is_dynamic(derived):
            mine = [said for _, said in verdicts(episode) if said.plan_id == derived.plan_id]
            last = said_by(mine[-1]) if mine else None
            return DerivedFacts(info=info, derived=derived, verdict=last)
        if derived.kind == "localised":
            topics = episode.topics_of_type(schema.LOCALISATION)
            places = places_in(message.data for message in episode.messages(topics))
            return DerivedFacts(info=info, derived=derived, places=tuple(places))
    except GstError as error:
        return DerivedFacts(info=info, derived=derived, broken=str(error))
    return DerivedFacts(info=info, derived=derived)


def _is_dynamic(derived: Derived) -> bool:
    return derived.kind == "replay" and derived.mode == "dynamic"


class DerivedIndex:
    """Derived episodes by what they were made from, so that none is looked for twice."""

    def __init__(self, files: Iterable[DerivedFile]) -> None:
        """Sort the derived episodes of a run."""
        self._replays: dict[tuple[str, str | None, str | None], list[DerivedFile]] = {}
        self._localised: dict[str, list[DerivedFile]] = {}
        for file in files:
            made = file.derived
            if _is_dynamic(made):
                key = (made.source_episode, made.plan_id, made.trajectory)
                self._replays.setdefault(key, []).append(file)
            elif made.kind == "localised":
                self._localised.setdefault(made.source_episode, []).append(file)

    def replay(self, *, source: str, source_sha256: str, plan_id: str, trajectory: str) -> Replay:
        """Find the dynamic replay of a recorded episode's plan, planned or executed.

        The newest file wins where several settings were tried.
        """
        made = self._replays.get((source, plan_id, trajectory), [])
        if not made:
            reason = f"no dynamic replay of the {trajectory} trajectory of plan {plan_id}"
            return Replay(reason=reason)
        current = _current(made, source_sha256)
        if not current:
            reason = (
                f"{made[0].path.name} was made from another version of the episode (its hash "
                "differs); replay it again"
            )
            return Replay(reason=reason)
        file = _newest(current)
        said = file.facts.verdict
        if file.facts.broken:
            return Replay(file=file, reason=f"{file.path.name}: {file.facts.broken}")
        if said is None:
            return Replay(file=file, reason=f"{file.path.name} holds no verdict")
        undecided: str | None = None
        if said.accepted is None:
            why = said.why_undecided
            undecided = f"the twin could not decide the {trajectory} replay: {why}"
        return Replay(file=file, verdict=said, reason=undecided)

    def localised(self, *, source: str, source_sha256: str) -> DerivedFile | None:
        """Find the newest localisation of a recorded episode."""
        current = _current(self._localised.get(source, []), source_sha256)
        return _newest(current) if current else None


def _current(files: Iterable[DerivedFile], source_sha256: str) -> list[DerivedFile]:
    """Leave out what was made from other bytes than the recorded episode holds now."""
    return [file for file in files if file.derived.source_sha256 in ("", source_sha256)]


def _newest(files: list[DerivedFile]) -> DerivedFile:
    return files[0] if len(files) == 1 else max(files, key=lambda file: file.age)
