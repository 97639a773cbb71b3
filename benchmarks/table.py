"""Print the targets of every stored result whose name begins as given: ``table.py record``."""

import json
import os
import sys
from dataclasses import fields
from pathlib import Path

from measure import ROOT, Target, print_targets


def main() -> None:
    """One table over all results."""
    prefix = sys.argv[1] if len(sys.argv) > 1 else ""
    folder = Path(os.environ.get("GST_BENCH_RESULTS", ROOT / "benchmarks" / "results"))
    names = {item.name for item in fields(Target)}
    targets, about = [], []
    for path in sorted(folder.glob(f"{prefix}*.json")):
        result = json.loads(path.read_text())
        rows = result.get("targets", [])
        targets += [
            Target(**{name: value for name, value in row.items() if name in names}) for row in rows
        ]
        if rows:
            machine = result["machine"]
            about.append(
                f"  {path.stem}: {result['note']}; {machine['cores']} cores, "
                f"load {machine['load_1min']}"
            )
    if not targets:
        return
    print(f"\nTargets, {sum(target.met for target in targets)} of {len(targets)} met")
    print_targets(targets)
    print("\n".join(about))


if __name__ == "__main__":
    main()
