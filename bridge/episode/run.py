"""The run folder: one run is one cell."""

import re
from dataclasses import dataclass
from pathlib import Path

from bridge.errors import PathNotFoundError, UsageError

EPISODE_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,120}")


def check_episode_id(episode_id: str) -> str:
    """Return the id if it is safe as a file name; remote requests cannot leave the run folder."""
    if not EPISODE_ID.fullmatch(episode_id):
        message = (
            f"episode id {episode_id!r} is not usable as a file name. "
            "Use letters, digits, '_' and '-', at most 121 characters."
        )
        raise UsageError(message)
    return episode_id


@dataclass(frozen=True)
class RunFolder:
    """``episodes/``, ``scene/``, ``derived/``, ``results/`` and ``notes/`` of one cell."""

    path: Path

    @staticmethod
    def open(path: Path) -> "RunFolder":
        """Open an existing run folder."""
        if not path.is_dir():
            raise PathNotFoundError(
                path=path, what="run folder", hint="Record into it first: robot-gst record RUN."
            )
        return RunFolder(path)

    @staticmethod
    def create(path: Path) -> "RunFolder":
        """Open a run folder, making it where needed."""
        run = RunFolder(path)
        try:
            run.episodes_dir.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            message = f"cannot write the run folder {path}: {error.strerror}. Choose another place."
            raise UsageError(message) from error
        return run

    @property
    def episodes_dir(self) -> Path:
        """Recorded episodes."""
        return self.path / "episodes"

    @property
    def scene_dir(self) -> Path:
        """The rebuilt place."""
        return self.path / "scene"

    @property
    def derived_dir(self) -> Path:
        """Replays, localisations and views made by the twin."""
        return self.path / "derived"

    @property
    def results_dir(self) -> Path:
        """What the evaluator computed."""
        return self.path / "results"

    @property
    def notes_dir(self) -> Path:
        """Labels and remarks given after the fact."""
        return self.path / "notes"

    def episodes(self) -> list[Path]:
        """Recorded episode files, in name order."""
        return sorted(self.episodes_dir.glob("*.mcap"))

    def derived(self, pattern: str = "*") -> list[Path]:
        """Derived episode files, in name order."""
        return sorted(self.derived_dir.glob(f"{pattern}.mcap"))
