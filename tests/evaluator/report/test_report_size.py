"""Large runs: the page stays small and says where the rest is; the results are complete."""

from pathlib import Path

import numpy as np
import pytest

from evaluator.compare.from_rows import compare_rows
from evaluator.compare.rows import Comparison, TrialRow
from evaluator.report.page import SHOWN_ROWS
from evaluator.report.write import write_report
from evaluator.result import load_results

MAX_BYTES = 5_000_000


def many(count: int) -> Comparison:
    """Draw trials of four tasks, with everything a trial row can say."""
    rng = np.random.default_rng(3)
    rows = []
    for number in range(count):
        recorded, said = bool(rng.random() < 0.6), bool(rng.random() < 0.7)
        condition = "with_replanning" if number % 2 else "without_replanning"
        rows.append(
            TrialRow(
                episode=f"monday-trial-{number:05d}",
                task=f"task_{number // 2 % 4}",
                condition=condition,
                policy="scripted",
                start_id=f"s{number // 2}",
                cell="standin",
                stand_in=True,
                recorded=recorded,
                sim_planned=said,
                sim_executed=recorded,
                verdict=said,
                p_success=float(rng.random()),
                first_failing=None if said else "clearance",
                failing_detail=None if said else "collision, gripper and box, at 1.40 s",
                stages=(("grasp", recorded or said), ("place", recorded)),
            )
        )
    return compare_rows(rows, run="large", source="run", stand_in=True)


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
def test_a_report_about_thousands_of_trials_stays_small_and_complete(tmp_path: Path) -> None:
    written = write_report(many(3000), tmp_path)
    text = written.report.read_text()
    assert len(text.encode()) < MAX_BYTES
    assert (
        f"The first {SHOWN_ROWS} of 3,000 rows; the whole is in trials.csv and trials.parquet"
        in text
    )
    assert "monday-trial-00199" in text
    assert "monday-trial-00200<" not in text
    lines = (tmp_path / "trials.csv").read_text().splitlines()
    assert len(lines) == 3001
    results = load_results(written.results)
    assert results == written.content
    assert len(results.get("agreement.sim_planned.rate").episodes) == 3000
    assert written.results.stat().st_size < 3_000_000
