"""The paper's table, recomputed; thresholds that end a command with 3."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bridge.errors import UsageError
from bridge.exchange import trials_rates
from bridge.exchange.table_text import TableError, read_rows
from evaluator.cli import evaluate
from evaluator.compare import compare_csv
from evaluator.compare.published import check_published
from evaluator.result import Results, Table, load_results
from evaluator.thresholds import SHORT, missed, parse_thresholds

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
RATES = EXAMPLES / "paper_table_rates.csv"
PUBLISHED = EXAMPLES / "paper_table_published.csv"


def table_of(results: Results, name: str) -> Table:
    return next(table for table in results.tables if table.id == name)


def test_the_papers_rates_give_its_averages() -> None:
    success = table_of(compare_csv(RATES).results(), "success")
    rates: dict[tuple[Any, Any], list[Any]] = {}
    for cells in success.rows:
        line = dict(zip(success.columns, cells, strict=True))
        rates.setdefault((line["side"], line["condition"]), []).append(line["rate"])
    for key, percent in (
        (("sim", "without_replanning"), 66.667),
        (("real", "without_replanning"), 55.333),
        (("sim", "with_replanning"), 93.333),
        (("real", "with_replanning"), 80.0),
    ):
        assert sum(rates[key]) / len(rates[key]) == pytest.approx(percent / 100, abs=5e-6)


def test_the_papers_r_without_with_and_over_all_groups() -> None:
    results = compare_csv(RATES).results()
    # By hand: (80, 40, 46) with (80, 60, 60), and (90, 80, 70) with (100, 100, 80).
    without = results.get("agreement.pearson_r.without_replanning")
    assert without.value == pytest.approx(0.99028, abs=1e-5)
    with_it = results.get("agreement.pearson_r.with_replanning")
    assert with_it.value == pytest.approx(0.86603, abs=1e-5)
    assert results.get("agreement.pearson_r").value == pytest.approx(0.92914, abs=1e-5)
    for r in (without, with_it):
        assert r.interval is None
        assert "3 groups; it needs 4" in str(r.reason_without_interval)
    assert results.get("agreement.bias_pp").value == pytest.approx(12.333, abs=5e-4)


def test_the_notes_say_what_is_counted_in_objects() -> None:
    rows = table_of(compare_csv(RATES).results(), "notes").rows
    notes = {about: [str(text) for other, text in rows if other == about] for about, _ in rows}
    assert "counted in objects (n = 50)" in notes["ducks_into_basket"][0]


def test_a_paradox_is_one_where_the_twin_ranks_otherwise_inside_tasks(tmp_path: Path) -> None:
    path, rising = tmp_path / "rates.csv", (20, 30, 55, 65, 80, 90)
    for real, sim, opposed in (
        (rising, (20, 30, 60, 70, 85, 95), False),
        (rising, (30, 20, 70, 60, 95, 85), True),
        ((20, 80, 30, 85, 35, 90), (35, 90, 28, 86, 20, 85), False),  # r over all is as inside
    ):
        cells = zip("aabbcc", "pqpqpq", sim, real, strict=True)
        lines = ["task,policy,n,sim,real", *(f"{t},{p},100,{s}%,{r}%" for t, p, s, r in cells)]
        path.write_text("\n".join(lines))
        assert ("Simpson" in str(compare_csv(path).results().to_record()["tables"])) is opposed


def test_the_published_table_is_recomputed_figure_by_figure() -> None:
    check = check_published(PUBLISHED)
    verdicts = {finding.what: finding for finding in check.findings}
    for side, condition in (
        ("sim", "without_replanning"),
        ("recorded", "without_replanning"),
        ("sim", "with_replanning"),
        ("recorded", "with_replanning"),
    ):
        assert verdicts[f"average_percent {side} {condition}"].verdict == "as printed"
    relative = verdicts["gain_relative_percent recorded"]
    assert relative.verdict == "only from rounded figures"
    assert relative.recomputed == pytest.approx(44.58, abs=0.005)
    assert "44.67 comes from the rounded averages" in relative.note
    ducks = verdicts["ducks_into_basket without_replanning real"]
    assert ducks.verdict == "impossible"
    assert "23 of 50 objects, not 10 trials" in ducks.note
    assert verdicts["pearson_r all groups (n = 6)"].recomputed == pytest.approx(0.929, abs=5e-4)
    assert verdicts["pearson_r without_replanning (n = 3)"].recomputed == pytest.approx(
        0.990, abs=5e-4
    )
    assert verdicts["pearson_r with_replanning (n = 3)"].recomputed == pytest.approx(
        0.866, abs=5e-4
    )
    assert verdicts["gain_pp sloth_into_basket sim"].verdict == "as printed"
    assert len(check.failed) == 2


def test_checking_a_published_table_ends_with_three_and_a_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate(check_published=PUBLISHED, out=tmp_path / "out") == 3
    shown = capsys.readouterr()
    assert "44.67 comes from the rounded averages" in shown.err
    assert "row 13" in shown.err
    assert "Printed figures" in shown.out
    assert table_of(load_results(tmp_path / "out" / "results.json"), "published").rows


def test_a_published_table_beside_a_run_adds_its_table(
    six_trials: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate(six_trials.run.path, check_published=PUBLISHED) == 3
    assert "only from rounded" in capsys.readouterr().err
    results = load_results(six_trials.run.path)
    assert results.get("agreement.sim_planned.rate").k == 5
    assert table_of(results, "published").rows


def test_a_table_whose_figures_follow_passes(write_table: Callable[[str], Path]) -> None:
    path = write_table(
        "task,condition,side,n,rate_percent,statistic,printed\n"
        "a,without_replanning,sim,10,50,,\n"
        "a,without_replanning,real,10,40,,\n"
        "a,with_replanning,sim,10,80,,\n"
        "a,with_replanning,real,10,80,,\n"
        ",,real,,,gain_pp,40\n,,real,,,gain_relative_percent,100\n,,,,,bias_pp,5\n"
    )
    assert check_published(path).failed == ()
    wrong = path.read_text().replace("gain_pp,40", "gain_pp,41").replace("percent,100", "percent,9")
    path.write_text(wrong)
    assert [f.verdict for f in check_published(path).failed] == ["differs", "differs"]


def test_thresholds_are_read_by_short_name_by_id_and_several_at_once() -> None:
    found = parse_thresholds("r=0.8, views.all.psnr_db=20,0.5")
    assert [(t.id, t.limit) for t in found] == [
        ("agreement.pearson_r", 0.8),
        ("views.all.psnr_db", 20.0),
        ("agreement.sim_planned.rate", 0.5),
    ]


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (("r=high", "mood=1"), "--fail-under"),
        (("agreement=80", "1.5"), "fraction from 0 to 1"),
        (("r=nan", "inf", "psnr=-inf"), "no limit"),
        (("r=80", "ppv=1.5", "ssim=-2"), "at most 1"),
    ],
)
def test_thresholds_that_mean_nothing_are_refused(texts: tuple[str, ...], message: str) -> None:
    for text in texts:
        with pytest.raises(UsageError, match=message):
            parse_thresholds(text)
    assert parse_thresholds("psnr=25, agreement.mae_pp=5")[0].limit == 25


@pytest.mark.parametrize(("text", "code"), [("r=0.8", 0), ("r=0.95", 3), ("ppv=0.1", 3)])
def test_r_of_the_paper_against_a_threshold(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, code: int
) -> None:
    assert evaluate(RATES, out=tmp_path / "out", fail_under=text) == code
    shown = capsys.readouterr().err
    assert ("the threshold is" in shown) == (code == 3)
    if text == "ppv=0.1":
        assert "undefined: there is no agreement.sim_planned.ppv" in shown


def test_every_short_name_is_an_id_of_some_results(six_trials: Any) -> None:
    from evaluator.compare import compare_run

    ids = {m.id for m in compare_run(six_trials.run).measurements}
    for name, identifier in SHORT.items():
        assert identifier in ids or identifier.startswith("views."), name
    (text,) = missed(parse_thresholds("0.9"), compare_run(six_trials.run).results())
    assert text == "Agreement of twin and outcome is 0.8333; the threshold is 0.9."


def test_evaluate_without_anything_is_wrong_use() -> None:
    with pytest.raises(UsageError, match="needs a run folder or a table"):
        evaluate()


def test_every_file_is_there_before_a_missed_threshold_ends_the_command(tmp_path: Path) -> None:
    assert evaluate(RATES, out=tmp_path / "out", fail_under="r=0.99, agreement.bias_pp=0") == 3
    for name in ("report.html", "results.json", "tables/success.csv", "figures/scatter.svg"):
        assert (tmp_path / "out" / name).is_file()


HEAD = "task,condition,side,unit,n,rate_percent,statistic,printed\n"


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("a,c,sim,trial,10,50,,\na,c,sim,trial,10,90,,\n", r"row 3: sim of 'a'.*row 2 already"),
        ("a,c,sim,trial,10,50,,\na,c,real,object,50,46,,\n", r"row 3: unit 'object'.*row 2 says"),
        ("a,c,simulation,trial,10,50,,\n", r"row 2: side is 'simulation'"),
        ("a,c,sim,trial,10,50,,\n,,,,,,average_percent,50\n", r"row 3: side of average_percent"),
        ("a,c,sim,trial,10,50,,\n,,rael,,,,pearson_r,1\n", r"row 3: side of pearson_r is 'rael'"),
        ("a,c,sim,trial,10,50,,\n,,sim,,,,average_percent,nan\n", r"row 3: printed is 'nan'"),
        ("a,c,sim,trial,10,50,,\n,,sim,,,,gain_pp,1e-999999999\n", r"row 3: printed is '1e-9"),
        ("a,c,sim,trial,10,1e-999999999,,\n", r"row 2: rate_percent is '1e-9"),
        (",,real,,,,mood,1\n", "row 2: statistic is 'mood'"),
        (",,real,,,,gain_pp,much\n", "row 2: printed is 'much'"),
    ],
)
def test_a_published_table_that_says_a_cell_twice_or_a_side_wrongly_is_refused(
    write_table: Callable[[str], Path], lines: str, message: str
) -> None:
    with pytest.raises(TableError, match=message):
        check_published(write_table(HEAD + lines))


def test_a_rate_that_several_counts_give_accuses_nobody(write_table: Callable[[str], Path]) -> None:
    check = check_published(write_table(f"{HEAD}a,c,sim,trial,150,67,,\na,c,real,trial,10,46,,\n"))
    found = {finding.row: finding for finding in check.findings}
    assert found[2].verdict == "ambiguous"
    assert "2 counts of 150 round to 0.67" in found[2].note
    assert [finding.row for finding in check.failed] == [3]
    assert check.comparison.groups[0].sim.value == 0.67
    assert check.comparison.groups[0].sim.n is None


def test_a_printed_figure_that_the_rows_do_not_give_does_not_pass(
    write_table: Callable[[str], Path],
) -> None:
    rows = "a,c,sim,trial,10,50,,\na,c,real,trial,10,40,,\n"
    check = check_published(write_table(f"{HEAD}{rows},,,,,,pearson_r,0.95\n"))
    assert [finding.verdict for finding in check.failed] == ["undefined"]
    assert "printed 0.95, but the rows do not give it: 1 group" in check.failed[0].note


def test_the_count_behind_a_rate_of_a_billion_trials_is_not_searched_for(
    write_table: Callable[[str], Path],
) -> None:
    path = write_table("task,side,n,rate\na,sim,1000000000,0.5\nb,sim,1000000000,0.123456789\n")
    records = trials_rates.rates_of(read_rows(path, ("task", "side"), trials_rates.COLUMNS))
    assert [record.k for record in records] == [500_000_000, 123_456_789]


def test_a_table_names_the_intervals_that_it_prints() -> None:
    for source in (RATES, PUBLISHED):
        assert "95 % Wilson" in table_of(compare_csv(source).results(), "success").note


def test_no_gain_at_all_is_not_called_underpowered(write_table: Callable[[str], Path]) -> None:
    lines = [
        f"a,{condition}_replanning,{side},trial,10,50,,"
        for condition in ("without", "with")
        for side in ("sim", "real")
    ]
    comparison = check_published(write_table(HEAD + "\n".join(lines) + "\n")).comparison
    notes = [t for t in comparison.tables if t.id == "notes"]
    assert not any("underpowered" in str(row) for table in notes for row in table.rows)


def rounded_table(rates: list[tuple[float, float]], digits: int, *figures: str) -> str:
    """A published table whose rates are printed in percent, without counts."""
    lines = ["task,side,rate_percent,statistic,printed"]
    for index, (real, sim) in enumerate(rates):
        lines += [f"t{index},real,{real:.{digits}f},,", f"t{index},sim,{sim:.{digits}f},,"]
    return "\n".join([*lines, *figures]) + "\n"


TRUE_RATES = [(33.34, 41.44), (50.49, 45.51), (61.45, 72.36), (80.46, 77.55), (12.54, 20.35)]


def test_a_figure_of_rates_before_they_were_rounded_is_no_difference(
    write_table: Callable[[str], Path],
) -> None:
    import numpy as np

    real, sim = np.array(TRUE_RATES).T
    r, rmse = np.corrcoef(real, sim)[0, 1], np.sqrt(np.mean((sim - real) ** 2))
    mae = np.abs(sim - real).mean()
    rounded = np.corrcoef(np.round(real), np.round(sim))[0, 1]
    assert f"{r:.4f}" != f"{rounded:.4f}"  # else this shows nothing
    figures = (f",,,pearson_r,{r:.4f}", f",,,rmse_pp,{rmse:.2f}", f",,,mae_pp,{mae:.2f}")
    check = check_published(write_table(rounded_table(TRUE_RATES, 0, *figures)))
    verdicts = {f.what: f.verdict for f in check.findings}
    for name in ("pearson_r", "rmse_pp", "mae_pp"):
        assert verdicts[name] in ("as printed", "within the rounding of its rates"), name
    assert verdicts["pearson_r"] == "within the rounding of its rates"
    assert not check.failed
    path = write_table(rounded_table(TRUE_RATES, 0, f",,,pearson_r,{r - 0.03:.4f}"))
    (finding,) = check_published(path).failed
    assert finding.verdict == "differs"
    assert "as its rates are rounded" in finding.note


def test_counts_leave_nothing_to_rounding(write_table: Callable[[str], Path]) -> None:
    lines = ["task,side,n,rate_percent,statistic,printed"]
    for index, (real, sim) in enumerate([(3, 5), (6, 6), (9, 7), (2, 4)]):
        lines += [f"t{index},real,10,{10 * real},,", f"t{index},sim,10,{10 * sim},,"]
    (finding,) = check_published(write_table("\n".join([*lines, ",,,,mae_pp,12.6"]) + "\n")).failed
    assert (finding.verdict, finding.recomputed) == ("differs", pytest.approx(15.0))
    assert "rounded" not in finding.note


def test_rank_violation_is_given_in_both_orders(write_table: Callable[[str], Path]) -> None:
    """By hand: only t0 and t1 are ordered otherwise; recorded they are 10 apart, in sim 20."""
    rates = [(50.0, 60.0), (60.0, 40.0), (90.0, 90.0)]
    check = check_published(write_table(rounded_table(rates, 0)))
    found = {f.what.split()[0]: f.recomputed for f in check.findings}
    assert found["mmrv"] == pytest.approx(2 * 0.1 / 3)
    assert found["mmrv_sim_gap"] == pytest.approx(2 * 0.2 / 3)
    assert found["spearman_rho"] == pytest.approx(0.5)
    assert found["rmse_pp"] == pytest.approx((500 / 3) ** 0.5)
