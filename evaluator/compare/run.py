"""Read a run folder into a ``Comparison``."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bridge.episode.provenance import hash_file, software
from bridge.episode.reader import Episode
from bridge.episode.run import RunFolder
from bridge.errors import BridgeError, GstError
from bridge.exchange.trials_import import trials_path
from evaluator.compare.bands import compare_bands
from evaluator.compare.from_rows import compare_rows
from evaluator.compare.imported import imported_rows
from evaluator.compare.pairing import START_LIMIT_M
from evaluator.compare.replays import DerivedFile, read_derived
from evaluator.compare.rows import Comparison, TrialRow
from evaluator.compare.trial import read_trial
from evaluator.compare.views import compare_views
from evaluator.result import Exclusion


def compare_run(run: RunFolder, *, method: str = "wilson", goal: float | None = None) -> Comparison:
    """Pair every recorded trial of a run with its replays and measure the agreement.

    A broken episode is left out and named; a missing part is listed, never guessed.

    Raises:
        PathNotFoundError: When the run folder is not there.
    """
    run = RunFolder.open(run.path)
    recorded, left_out = _read_recorded(run)
    files, broken = read_derived(run)
    left_out += broken
    hashes = {episode.path: episode.sha256() for episode in recorded}
    rows = []
    for episode in recorded:
        if episode.info.kind != "trial":
            continue
        try:
            row, lacking = read_trial(run, episode, files, sha256=hashes[episode.path])
        except GstError as error:
            left_out.append(_broken(episode.info.id, error))
            continue
        rows.append(row)
        left_out += lacking
    imported, doubled = imported_rows(run, {episode.info.id for episode in recorded})
    rows += imported
    left_out += doubled
    views = compare_views(files, recorded, hashes)
    bands = compare_bands(recorded, files)
    base = compare_rows(
        rows,
        run=run.path.resolve().name,
        source="run",
        stand_in=_stand_in(recorded, files, imported),
        method=method,
        goal=goal,
    )
    missing = [] if rows else ["trials: the run holds no recorded trial"]
    return replace(
        base,
        measurements=(*base.measurements, *views.measurements, *bands.measurements),
        tables=(*base.tables, *views.tables, *bands.tables),
        exclusions=(*left_out, *base.exclusions, *views.exclusions, *bands.exclusions),
        missing=(*missing, *base.missing, *views.missing, *bands.missing),
        provenance={
            "software": software(),
            "start_limit_m": START_LIMIT_M,
            "imported_trials": hash_file(trials_path(run)) if imported or doubled else None,
            "episodes": {_name_of(path, run): sha256 for path, sha256 in hashes.items()},
            "derived": {
                _name_of(file.path, run): {
                    "sha256": hash_file(file.path),
                    "source_sha256": file.derived.source_sha256,
                    "scene_hash": file.derived.scene_hash,
                    "engine": file.derived.engine,
                    "seed": file.derived.seed,
                }
                for file in files
            },
        },
    )


def _read_recorded(run: RunFolder) -> tuple[list[Episode], list[Exclusion]]:
    episodes, left_out = [], []
    for path in run.episodes():
        try:
            episode = Episode.open(path)
            _ = episode.info, episode.outcome  # both are needed; another program may have erred
            episodes.append(episode)
        except BridgeError as error:
            left_out.append(_broken(path.name, error))
    return episodes, left_out


def _broken(name: str, error: GstError) -> Exclusion:
    return Exclusion(episode=name, scope="everything", reason=str(error))


def _stand_in(
    recorded: Sequence[Episode], files: Sequence[DerivedFile], imported: Sequence[TrialRow]
) -> bool | None:
    """True as soon as one episode is a stand-in's: mixed results are not called real."""
    marks = [episode.info.stand_in for episode in recorded]
    marks += [file.episode.info.stand_in for file in files]
    marks += [row.stand_in for row in imported]
    return any(marks) if marks else None


def _name_of(path: Path, run: RunFolder) -> str:
    return path.relative_to(run.path).as_posix()
