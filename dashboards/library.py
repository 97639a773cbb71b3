"""The runs being shown, and safe ways from a name in an address to a file inside a run."""

from collections.abc import Sequence
from dataclasses import dataclass
from glob import escape
from pathlib import Path

from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from dashboards.errors import NotHereError

RESULTS = "results.json"
Stamps = tuple[tuple[str, int, int], ...]
"""Name, time of writing [ns] and size of files."""


@dataclass(frozen=True)
class Library:
    """Run folders by short name, the first one shown by default."""

    runs: dict[str, RunFolder]

    @staticmethod
    def open(paths: Sequence[Path]) -> "Library":
        """Open every run folder; folders of the same name get a number."""
        runs: dict[str, RunFolder] = {}
        for path in paths:
            run = RunFolder.open(path)
            if (path / RESULTS).is_file() and not run.results_dir.is_dir():
                message = (
                    f"{path} holds the results of an evaluation and no run. Give them a folder for "
                    f"the pages: robot-gst evaluate ... --out {path}/results; then open {path}."
                )
                raise UsageError(message)
            base = path.resolve().name or "run"
            name, number = base, 2
            while name in runs:
                name, number = f"{base}-{number}", number + 1
            runs[name] = run
        return Library(runs)

    def pick(self, name: str | None) -> RunFolder:
        """Return the named run, or the first one without a name."""
        if not name:
            return next(iter(self.runs.values()))
        if name not in self.runs:
            message = f"no run is named {name!r}. Runs shown: {', '.join(self.runs)}."
            raise NotHereError(message)
        return self.runs[name]


def episode_path(run: RunFolder, episode_id: str) -> Path:
    """Return the file of a recorded episode; nothing outside the run folder is ever reached."""
    what = f"episode {episode_id!r}"
    for path in run.episodes():
        if path.stem == episode_id:
            return _inside(run, path, what)
    message = f"no {what} in this run."
    raise NotHereError(message)


def derived_paths(run: RunFolder, episode_id: str, kind: str) -> list[Path]:
    """Return the derived episodes of one kind (replay, localised, views) of one episode."""
    found = run.derived(f"{escape(episode_id)}.{kind}.*")
    return [path for path in found if _is_inside(run, path)]


def scene_stamps(run: RunFolder, path: Path) -> Stamps:
    """Names, times of writing and sizes of what the 3D scene of a recorded episode is made of."""
    files = [path, run.scene_dir / "scene.json", run.scene_dir / "calibration.json"]
    for kind in ("replay", "localised"):
        files += derived_paths(run, path.stem, kind)
    found = [(file.name, file.stat()) for file in files if file.is_file()]
    return tuple((name, status.st_mtime_ns, status.st_size) for name, status in found)


def derived_path(run: RunFolder, name: str) -> Path:
    """Return one derived episode by file name, among those that exist in the run."""
    for path in run.derived():
        if path.name == name:
            return _inside(run, path, f"derived episode {name!r}")
    message = f"no derived episode {name!r} in this run."
    raise NotHereError(message)


def _is_inside(run: RunFolder, path: Path) -> bool:
    return path.resolve().is_relative_to(run.path.resolve())


def _inside(run: RunFolder, path: Path, what: str) -> Path:
    if not path.is_file():
        message = f"no {what} in this run."
        raise NotHereError(message)
    if not _is_inside(run, path):
        message = f"{what} points outside the run folder; it is not served."
        raise NotHereError(message)
    return path
