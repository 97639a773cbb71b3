"""The published tables in ``datasets/published``: all are read, and agree with NumPy."""

import json
import re
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from bridge.exchange.table_text import TableError, TableOptions
from evaluator.compare import compare_csv
from evaluator.compare.published import SWAPPED, check_published
from evaluator.compare.rows import RateGroup
from evaluator.compare.table_words import DoubtfulTableError

FOLDER = Path(__file__).resolve().parents[2] / "datasets" / "published"
TABLES = sorted(FOLDER.glob("*.csv"))


checked = lru_cache(maxsize=None)(check_published)


def rates(groups: tuple[RateGroup, ...]) -> tuple[np.ndarray, np.ndarray]:
    both = [(g.recorded_rate, g.sim_rate) for g in groups if g.recorded_rate is not None]
    pairs = np.array([[float(a), float(b)] for a, b in both if b is not None])
    return pairs[:, 0], pairs[:, 1]


def max_violation(weights: np.ndarray, real: np.ndarray, sim: np.ndarray) -> float:
    """MMRV as Li et al. (2024), equation 1, by loops over pairs."""
    gaps = [
        max(
            abs(weights[i] - weights[j]) * ((sim[i] > sim[j]) != (real[i] > real[j]))
            for j in range(len(real))
        )
        for i in range(len(real))
    ]
    return float(np.mean(gaps))


def test_there_are_at_least_ten_and_each_names_its_source() -> None:
    assert len(TABLES) >= 10
    for path in TABLES:
        head = [line for line in path.read_text().splitlines() if line.startswith("#")]
        assert any("arXiv:" in line for line in head), path
        assert any(line.startswith("# Source: ") for line in head), path


@pytest.mark.parametrize("path", TABLES, ids=lambda path: path.stem)
def test_a_published_table_gives_the_numbers_of_numpy(path: Path) -> None:
    comparison = checked(path).comparison
    real, sim = rates(comparison.groups)
    assert len(real) >= 4
    results = comparison.results()
    r = results.get("agreement.pearson_r")
    assert r.value == pytest.approx(np.corrcoef(real, sim)[0, 1], abs=1e-9)
    if all(rate.n for group in comparison.groups for rate in group.pair):
        assert r.interval is not None, r.reason_without_interval
        assert -1 <= r.interval.low < r.interval.high <= 1
        assert (r.interval.low, r.interval.high) != (-1, 1)
    else:
        assert "without n" in str(r.reason_without_interval)
    for name, value in (
        ("bias_pp", 100 * np.mean(sim - real)),
        ("mae_pp", 100 * np.mean(np.abs(sim - real))),
        ("mmrv_recorded_gap", max_violation(real, real, sim)),
    ):
        assert results.get(f"agreement.{name}").value == pytest.approx(value, abs=1e-9), name


def test_figures_that_fit_with_swapped_arguments_are_named() -> None:
    """The three MMRV that real2sim-eval prints weight the gap of sim rates; its r are pooled."""
    findings = checked(FOLDER / "real2sim_eval_200.csv").findings
    by_what = {finding.what: finding.verdict for finding in findings}
    for task in ("toy_packing", "rope_routing", "t_block_pushing"):
        assert by_what[f"mmrv {task}"] == SWAPPED
        assert by_what[f"pearson_r {task}"] == "as printed"


def test_a_mean_of_r_per_task_is_told_from_r_over_all_groups(
    write_table: Callable[[str], Path],
) -> None:
    lines = ["task,policy,side,rate,statistic,printed"]
    inside = {"a": (0.9, 0.8, 0.6), "b": (0.2, 0.3, 0.1)}
    for task, found in inside.items():
        for policy, real, sim in zip("xyz", (0.5, 0.6, 0.8), found, strict=True):
            lines += [f"{task},{policy},real,{real},,", f"{task},{policy},sim,{sim},,"]
    per_task = [np.corrcoef((0.5, 0.6, 0.8), found)[0, 1] for found in inside.values()]
    lines.append(f",,,,pearson_r,{np.mean(per_task):.3f}")
    lines.append(f"a,,,,pearson_r,{per_task[0]:.3f}")
    lines.append(",x,sim,,average_percent,55.0")
    findings = check_published(write_table("\n".join(lines) + "\n")).findings
    verdicts = {finding.what: finding.verdict for finding in findings if finding.printed}
    assert verdicts == {
        "pearson_r": "differs",
        "pearson_r a": "as printed",
        "average_percent sim x": "as printed",
    }


AS_PRINTED = json.loads((FOLDER / "as_printed" / "sources.json").read_text())["tables"]


def numbers(path: Path, columns: Sequence[int], scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Both rates of each row in which both stand, read without the reader: counts, else numbers."""
    found = []
    for line in path.read_text().splitlines():
        cells = [c.strip(" *") for c in line.strip("|").split("|" if path.suffix == ".md" else ",")]
        texts = [cells[place] for place in columns if place < len(cells)]
        shares = [re.search(r"(\d+)/(\d+)", text) for text in texts]
        plain = [re.match(r"[\d.]+", text) for text in texts]
        if len(texts) == 2 and all(plain):
            found.append(
                [
                    int(share[1]) / int(share[2]) if share else float(number[0]) / scale
                    for share, number in zip(shares, plain, strict=True)
                    if number
                ]
            )
    return np.array(found)[:, 0], np.array(found)[:, 1]


@pytest.mark.parametrize("name", AS_PRINTED)
def test_a_table_as_it_is_printed_is_read_without_editing(name: str) -> None:
    source = AS_PRINTED[name]
    (path,) = (FOLDER / "as_printed").glob(f"{name}.[mc]*")
    options = TableOptions(yes=source.get("yes", False))
    if "refused" in source:
        with pytest.raises(TableError, match=re.escape(source["refused"])):
            compare_csv(path, options)
        return
    if options.yes:  # what is not the only reading waits for a yes
        with pytest.raises(DoubtfulTableError):
            compare_csv(path)
    compared = compare_csv(path, options)
    results = compared.results()
    real, sim = numbers(path, source["columns"], source["scale"])
    np.testing.assert_allclose(rates(compared.groups), (real, sim), atol=1e-9)
    r = results.get("agreement.pearson_r").value
    assert r == pytest.approx(np.corrcoef(real, sim)[0, 1], abs=1e-9)
    mmrv = results.get("agreement.mmrv_recorded_gap").value
    assert mmrv == pytest.approx(max_violation(real, real, sim), abs=1e-9)
    if printed := source.get("printed", {}).get("pearson_r"):
        assert r == pytest.approx(float(printed), abs=0.005)
