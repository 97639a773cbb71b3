"""Hold two folders of goldens together, and say which differences were not allowed beforehand.

    python tests/golden/house/compare_goldens.py BEFORE AFTER [--show 20] [--all]

A difference is ``gone``, ``new`` or ``changed`` at a path such as
``demo/measurements/rate.recorded.cube/value``. ``allowed_differences.txt`` beside this file lists
those that were allowed, by pattern; any other is a mistake, and the exit code is 3.
"""

import argparse
import fnmatch
import json
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).resolve().parent


class Difference(NamedTuple):
    """One place where two goldens say something else."""

    kind: str
    path: str
    text: str


class Allowed(NamedTuple):
    """A line of the list: what kind of difference, where, and why."""

    kind: str
    pattern: str
    why: str


def allowances(text: str) -> list[Allowed]:
    """Read the list: ``KIND PATTERN  # why``; KIND is gone, new, changed or any."""
    found = []
    for line in text.splitlines():
        rule, _, why = line.partition(" # ")
        if rule.strip() and not rule.startswith("#"):
            kind, pattern = rule.split(maxsplit=1)
            found.append(Allowed(kind, pattern.strip(), why.strip()))
    return found


def differences(before: Any, after: Any, path: str) -> Iterator[Difference]:
    """Everything that differs, at the deepest place where it does."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in sorted(before.keys() | after.keys()):
            below = f"{path}/{key}"
            if key not in after:
                yield Difference("gone", below, _short(before[key]))
            elif key not in before:
                yield Difference("new", below, _short(after[key]))
            else:
                yield from differences(before[key], after[key], below)
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for number, (first, second) in enumerate(zip(before, after, strict=True)):
            yield from differences(first, second, f"{path}/{number}")
    elif type(before) is not type(after) or before != after:
        yield Difference("changed", path, f"{_short(before)} -> {_short(after)}")


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 90 else f"{text[:87]}..."


def permitted(difference: Difference, allowed: list[Allowed]) -> Allowed | None:
    """The line that allows a difference, if there is one."""
    for each in allowed:
        fits = each.kind in (difference.kind, "any")
        if fits and fnmatch.fnmatchcase(difference.path, each.pattern):
            return each
    return None


def count_facts(value: Any) -> int:
    """Numbers, texts and flags in a golden."""
    if isinstance(value, dict):
        return sum(count_facts(item) for item in value.values())
    return sum(count_facts(item) for item in value) if isinstance(value, list) else 1


def load(folder: Path) -> dict[str, Any]:
    """The goldens of a folder by group."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))}


def main() -> None:
    """Print the report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--allowed", type=Path, default=HERE / "allowed_differences.txt")
    parser.add_argument("--show", type=int, default=20, help="lines shown of each kind and group")
    parser.add_argument("--all", action="store_true", help="show what is allowed too")
    chosen = parser.parse_args()
    before, after = load(chosen.before), load(chosen.after)
    if before.pop("inputs", None) != after.pop("inputs", None):
        sys.exit("The goldens were made of other inputs: make both again from the same ones.")
    allowed = allowances(chosen.allowed.read_text())
    used: Counter[Allowed] = Counter()
    wrong = 0
    for group in sorted(before.keys() & after.keys()):
        found = list(differences(before[group], after[group], group))
        told = [(each, permitted(each, allowed)) for each in found]
        used.update(rule for _, rule in told if rule is not None)
        refused = [each for each, rule in told if rule is None]
        wrong += len(refused)
        facts = count_facts(before[group])
        print(f"{group}: {facts} facts, {len(found)} differ, {len(refused)} of them not allowed")
        shown: Counter[str] = Counter()
        for each in found if chosen.all else refused:
            place = f"{each.kind} {re.sub('/[^/]*$', '', each.path)}"
            shown[place] += 1
            if shown[place] <= chosen.show:
                print(f"  {each.kind:8}{each.path}: {each.text}")
        for place, number in shown.items():
            if number > chosen.show:
                print(f"  ... {number - chosen.show} more: {place}")
    for group in sorted(before.keys() ^ after.keys()):
        print(f"{group}: only in one folder, not compared")
    print(f"\nallowed: {sum(used.values())} differences by {len(used)} of {len(allowed)} lines")
    for rule, number in used.most_common():
        print(f"  {number:6} {rule.kind} {rule.pattern}  ({rule.why})")
    print(f"not allowed: {wrong}")
    sys.exit(3 if wrong else 0)


if __name__ == "__main__":
    main()
