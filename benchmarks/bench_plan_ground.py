"""Instructions: how many are understood as meant, and CPU time for one.

Our own are those of the tests; those given are read from the shared data where it is there.
"""

import contextlib
import json
import os
import statistics
import sys
import time
from pathlib import Path

from measure import ROOT, Target, report_targets

from twin.plan.ground.grammar import ground
from twin.plan.ground.vocabulary import GroundingError, Vocabulary

TESTS = ROOT / "tests" / "twin" / "plan" / "ground"
SHARED = Path(os.environ.get("GST_SHARED_DATA", ROOT.parent / "shared" / "data"))
REPEATS = 20


def cpu_s(scene: Vocabulary, text: str) -> float:
    """Of one instruction, the median of some repeats [s]."""
    times = []
    for _ in range(REPEATS):
        began = time.process_time()
        with contextlib.suppress(GroundingError):
            ground(text, scene)
        times.append(time.process_time() - began)
    return statistics.median(times)


def main() -> None:
    sys.path.insert(0, str(TESTS))
    from spoken_scenes import SCENES, as_meant, vocabulary_from_labels

    rows = [
        [part.strip() for part in line.split(" | ")]
        for line in (TESTS / "paraphrases.txt").read_text().splitlines()
        if line and not line.startswith("#")
    ]
    good = [as_meant(*row) for row in rows]
    errors = [fits for fits, row in zip(good, rows, strict=True) if row[2].startswith("!")]
    times = [cpu_s(SCENES[scene], text) for scene, text, *_ in rows]
    given = SHARED / "planning" / "instructions.json"
    if given.is_file():
        table = json.loads(given.read_text())
        scenes = {name: vocabulary_from_labels(about) for name, about in table["scenes"].items()}
        times += [cpu_s(scenes[case["scene"]], case["text"]) for case in table["cases"]]
    report_targets(
        "plan_ground",
        [
            Target(
                what="our own instructions understood as meant",
                measured=sum(good) / len(good),
                limit=0.95,
                at_most=False,
            ),
            Target(what="error cases not as meant", measured=errors.count(False), limit=0),
            Target(
                what="CPU time of one, median", measured=statistics.median(times) * 1e3, limit=5,
                unit="ms",
            ),
            Target(what="CPU time of one, largest", measured=max(times) * 1e3, limit=5, unit="ms"),
        ],
        note=f"{len(rows)} of our own, {len(times)} timed; one thread, machine shared",
    )  # fmt: skip


if __name__ == "__main__":
    main()
