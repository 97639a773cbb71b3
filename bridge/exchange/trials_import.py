"""Trials kept in a spreadsheet become part of a run: ``notes/trials.csv``, which evaluate reads."""

from pathlib import Path

from bridge.episode.run import RunFolder
from bridge.errors import UsageError
from bridge.exchange.trials_csv import TrialRecord, read_trials, trials_text
from bridge.whole_file import write_whole


def trials_path(run: RunFolder) -> Path:
    """Where a run keeps its imported trials."""
    return run.notes_dir / "trials.csv"


def import_trials(table: Path, run: RunFolder, *, force: bool) -> list[TrialRecord]:
    """Check a trials CSV and keep it in the run, with all columns and in one spelling.

    Args:
        table: The CSV file.
        run: The run.
        force: Replace trials imported earlier.

    Raises:
        TableError: Naming the row that cannot be believed; nothing is written then.
        UsageError: When the run has imported trials already.
    """
    trials = read_trials(table)
    path = trials_path(run)
    if path.exists() and not force:
        message = f"{path} exists already. Replace it with --force, or use another run."
        raise UsageError(message)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, trials_text(trials).encode())
    return trials
