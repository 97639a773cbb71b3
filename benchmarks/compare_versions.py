"""Compare two versions of this project on the same input: same bytes, same numbers.

    python benchmarks/compare_versions.py --before BEFORE --after AFTER --run RUN
        [--kitchen DIR] [--kinova DIR] [--out FOLDER] [--ids ids.json]

BEFORE and AFTER are the commands of the two versions, for example ``old/.venv/bin/robot-gst``.
RUN is a run folder with recorded episodes; only these are taken from it. Each version rebuilds
(by iterations, not by time), replays and evaluates in folders of its own. Compared are the vertices
of every PLY, the payload of every message of every derived episode, and every number of
``results.json``. Hashes of settings and of code differ between versions by design and are left out;
the report counts what was compared, and exits with 3 where anything differs.
"""

import argparse
import json
import math
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

IGNORED_KEYS = {"scene_hash", "settings_hash", "config_hash", "task_sha256", "software"}
"""Fields of JSON payloads that name the code or the settings by their digest."""
RENAMED_KEYS = {"partings": "quantities"}
"""Keys of JSON payloads before, and as they are called since."""
ITERATIONS = "400"


@dataclass
class Differences:
    """What was compared and what differs."""

    compared: dict[str, int] = field(default_factory=dict)
    found: list[str] = field(default_factory=list)

    def count(self, what: str, number: int = 1) -> None:
        """Note that so many things of a kind were compared."""
        self.compared[what] = self.compared.get(what, 0) + number

    def add(self, text: str) -> None:
        """Note one difference."""
        self.found.append(text)


def run(command: str, *arguments: str) -> None:
    """Run one command of one version; its output is kept for the case that it fails."""
    line = [*shlex.split(command), *arguments]
    print("  ", " ".join(arguments), flush=True)
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 3):
        sys.exit(f"{shlex.join(line)} ended with {done.returncode}:\n{done.stdout}{done.stderr}")


def demo_stages(command: str, source: Path, folder: Path) -> None:
    """Rebuild, replay and evaluate the recorded episodes of a run."""
    shutil.copytree(source / "episodes", folder / "episodes")
    run(command, "rebuild", str(folder), "--iterations", ITERATIONS)
    run(command, "replay", str(folder), "--samples", "4")
    run(command, "evaluate", str(folder))


def kitchen_stages(command: str, source: Path, folder: Path) -> None:
    """Import an RGB-D folder, rebuild it and score the held-out views."""
    run(command, "import", "rgbd", str(source), str(folder))
    run(command, "rebuild", str(folder), "--iterations", ITERATIONS)
    run(command, "evaluate", str(folder))


def kinova_stages(command: str, source: Path, folder: Path) -> None:
    """Import the runs of a real arm and of its simulators, and compare them."""
    script = Path(__file__).parents[1] / "datasets" / "kinova" / "make_episodes.py"
    subprocess.run([sys.executable, script, source, folder], check=True)
    run(command, "evaluate", str(folder))


def compare(before: Path, after: Path, ids: dict[str, str], into: Differences) -> None:
    """Compare everything two versions made of the same input."""
    compare_ply(before, after, into)
    compare_episodes(before, after, into)
    compare_results(before, after, ids, into)


def compare_ply(before: Path, after: Path, into: Differences) -> None:
    """Vertices of every PLY, byte by byte; headers may carry a comment."""
    for path in sorted(before.rglob("*.ply")):
        name = path.relative_to(before)
        other = after / name
        if not other.is_file():
            into.add(f"{name}: missing afterwards")
            continue
        into.count("PLY files")
        if _vertices(path) != _vertices(other):
            into.add(f"{name}: vertices differ")


def _vertices(path: Path) -> bytes:
    head, mark, body = path.read_bytes().partition(b"end_header\n")
    return body if mark else head


def compare_episodes(before: Path, after: Path, into: Differences) -> None:
    """Topic and payload of every message, episode by episode, whatever settings hash it carries."""
    ours = {path.name: path for path in sorted((before / "derived").glob("*.mcap"))}
    theirs = {path.name: path for path in sorted((after / "derived").glob("*.mcap"))}
    by_hash = {_without_hash(name): path for name, path in theirs.items() if name not in ours}
    for name, path in ours.items():
        # where settings are hashed otherwise, the rest of the name says which replay it is
        other = theirs.pop(name, None) or by_hash.pop(_without_hash(name), None)
        if other is None:
            into.add(f"derived/{name}: missing afterwards")
            continue
        theirs.pop(other.name, None)
        into.count("derived episodes")
        _compare_messages(_without_hash(name), path, other, into)
    for name in theirs:
        into.add(f"derived/{name}: only afterwards")


def _without_hash(name: str) -> str:
    return re.sub(r"\.[0-9a-f]{8,12}(?=\.mcap$)", "", name)


def _messages(path: Path) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages(log_time_order=True):
            data = message.data
            if channel.message_encoding == "json":
                data = json.dumps(_without_ignored(json.loads(data)), sort_keys=True).encode()
            found.setdefault(channel.topic, []).append(data)
    return found


def _without_ignored(value: Any) -> Any:
    if isinstance(value, dict):
        kept = ((k, _without_ignored(v)) for k, v in value.items() if k not in IGNORED_KEYS)
        return {RENAMED_KEYS.get(k, k): v for k, v in kept}
    return [_without_ignored(item) for item in value] if isinstance(value, list) else value


def _compare_messages(key: str, path: Path, other: Path, into: Differences) -> None:
    ours, theirs = _messages(path), _messages(other)
    for topic in sorted(ours.keys() | theirs.keys()):
        first, second = ours.get(topic, []), theirs.get(topic, [])
        into.count("messages of derived episodes", len(first))
        if len(first) != len(second):
            into.add(f"{key} {topic}: {len(first)} messages before, {len(second)} after")
            continue
        unequal = [
            i for i, pair in enumerate(zip(first, second, strict=True)) if pair[0] != pair[1]
        ]
        if unequal:
            into.add(f"{key} {topic}: {len(unequal)} of {len(first)} differ, first {unequal[0]}")


def compare_results(before: Path, after: Path, ids: dict[str, str], into: Differences) -> None:
    """Value, interval and n of every measurement; ``ids`` maps old names to new ones."""
    first = before / "results" / "results.json"
    if not first.is_file():
        return
    old = {m["id"]: m for m in json.loads(first.read_text())["measurements"]}
    text = (after / "results" / "results.json").read_text()
    new = {m["id"]: m for m in json.loads(text)["measurements"]}
    for name, measurement in old.items():
        other = new.pop(ids.get(name, name), None)
        if other is None:
            into.add(f"results {name}: missing afterwards")
            continue
        into.count("measurements")
        numbers, others = dict(_numbers(measurement)), dict(_numbers(other))
        for key in sorted(numbers.keys() | others.keys()):
            into.count("numbers of results.json")
            if not _equal(numbers.get(key), others.get(key)):
                into.add(f"results {name} {key}: {numbers.get(key)} -> {others.get(key)}")
    for name in new:
        into.add(f"results {name}: only afterwards")


def _numbers(value: Any, name: str = "") -> Iterator[tuple[str, float]]:
    if isinstance(value, bool | int | float):
        yield name, float(value)
    elif isinstance(value, dict):
        for key, item in value.items():
            if key not in ("provenance", "episodes"):
                yield from _numbers(item, f"{name}.{key}" if name else key)
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from _numbers(item, f"{name}[{index}]")


def _equal(first: float | None, second: float | None) -> bool:
    if first is None or second is None:
        return first is second
    return first == second or (math.isnan(first) and math.isnan(second))


def main() -> None:
    """Run both versions, compare, print the report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--before", required=True)
    parser.add_argument("--after", required=True)
    parser.add_argument("--run", type=Path)
    parser.add_argument("--kitchen", type=Path)
    parser.add_argument("--kinova", type=Path)
    parser.add_argument("--out", type=Path, default=Path("runs/compare"))
    parser.add_argument("--ids", type=Path)
    parser.add_argument("--keep-before", action="store_true", help="use what is there of BEFORE")
    chosen = parser.parse_args()
    ids = json.loads(chosen.ids.read_text()) if chosen.ids else {}
    into = Differences()
    for name, source, stages in (
        ("demo", chosen.run, demo_stages),
        ("kitchen", chosen.kitchen, kitchen_stages),
        ("kinova", chosen.kinova, kinova_stages),
    ):
        if source is None:
            continue
        sides = chosen.out / "before" / name, chosen.out / "after" / name
        for side, command in zip(sides, (chosen.before, chosen.after), strict=True):
            if side is sides[0] and chosen.keep_before and side.is_dir():
                continue
            shutil.rmtree(side, ignore_errors=True)
            side.mkdir(parents=True)
            print(side, flush=True)
            stages(command, source, side)
        compare(*sides, ids, into)
    for what, number in into.compared.items():
        print(f"compared: {number} {what}")
    print(f"different: {len(into.found)}")
    for line in into.found:
        print(" ", line)
    sys.exit(3 if into.found else 0)


if __name__ == "__main__":
    main()
