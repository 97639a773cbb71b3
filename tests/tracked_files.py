"""The files of the repository, as git knows them."""

import subprocess
from functools import cache

from own_process import ROOT


@cache
def tracked() -> tuple[str, ...]:
    """Names of all files that git knows and that are there; without git, all there are."""
    if not (ROOT / ".git").exists():
        return tuple(str(path.relative_to(ROOT)) for path in ROOT.rglob("*") if path.is_file())
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return tuple(name for name in listed.stdout.splitlines() if (ROOT / name).is_file())
