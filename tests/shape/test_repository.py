"""The shape of the repository: sizes, forbidden names, paths named in the documents."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("bridge", "twin", "evaluator", "dashboards")


def sources() -> list[Path]:
    return [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]


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
