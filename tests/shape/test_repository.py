"""The shape of the repository: sizes, forbidden names, paths named in the documents."""

import re
import subprocess
from pathlib import Path
from statistics import median

ROOT = Path(__file__).parents[2]
ROOMS = ("bridge", "twin", "evaluator", "dashboards")


def sources() -> list[Path]:
    return [path for room in ROOMS for path in (ROOT / room).rglob("*.py")]


def test_files_stay_short() -> None:
    lines = {path: path.read_text().count("\n") for path in sources()}
    assert max(lines.values()) <= 400, max(lines, key=lambda path: lines[path])
    written = [count for path, count in lines.items() if path.name != "__init__.py"]
    assert median(written) <= 160


def test_there_is_no_drawer_for_everything() -> None:
    names = {"utils", "helpers", "common", "misc", "manager"}
    assert [path for path in sources() if path.stem in names] == []


def test_paths_named_in_the_documents_exist() -> None:
    missing = []
    documents = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    for document in documents:
        for quoted in re.findall(
            r"`((?:bridge|twin|evaluator|dashboards|datasets|docs|tests|benchmarks)/[\w./-]+)`",
            document.read_text(),
        ):
            if not (ROOT / quoted).exists():
                missing.append(f"{document.name}: {quoted}")
    assert missing == []


def test_nothing_large_is_tracked() -> None:
    if not (ROOT / ".git").exists():
        return
    tracked = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    large = [
        name
        for name in tracked
        if (ROOT / name).is_file() and (ROOT / name).stat().st_size > 1_000_000
    ]
    assert large == []
