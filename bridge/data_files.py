"""Find the files of ``datasets/``: beside the packages in a checkout, else inside the wheel."""

from pathlib import Path

from bridge.errors import UsageError

_CHECKOUT = Path(__file__).resolve().parents[1] / "datasets"
_INSTALLED = Path(__file__).resolve().parent / "_datasets"


def datasets_folder() -> Path:
    """Return the folder that holds ``tasks/``, ``cells/`` and ``robots/``."""
    return _CHECKOUT if (_CHECKOUT / "tasks").is_dir() else _INSTALLED


def dataset_file(folder: str, name: str, suffix: str = ".toml") -> Path:
    """Return a file by name (``tasks``, ``cube_into_box``); a path to a file passes through."""
    if name.endswith(suffix) and Path(name).is_file():
        return Path(name)
    path = datasets_folder() / folder / f"{name}{suffix}"
    if not path.is_file() or path.parent != datasets_folder() / folder:
        names = sorted(item.stem for item in (datasets_folder() / folder).glob(f"*{suffix}"))
        raise UsageError(f"no {folder[:-1]} named {name!r}. There are: {', '.join(names)}.")
    return path
