"""The laboratory's frozen difficulty: in its band, and the same when it is measured again."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from bridge.sources.standin.cell_file import load_cell

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.append(str(BENCHMARKS))
ROWS: list[dict[str, Any]] = json.loads(
    (BENCHMARKS / "results" / "lab_difficulty.json").read_text()
)["tasks"]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: str(row["task"]))
def test_thirty_to_eighty_percent_succeed_and_the_world_is_to_blame(row: dict[str, Any]) -> None:
    good = [item for item in row["trials"] if item["result"] == "success"]
    assert (row["k"], row["n"]) == (len(good), len(row["trials"]))
    assert row["n"] >= 40
    assert 0.3 <= row["k"] / row["n"] <= 0.8
    assert row["control_k"] >= 0.9 * row["control_n"] > 0
    low, high = load_cell("lab").development_seeds
    assert all(low <= item["lab"] <= high for item in row["trials"])
