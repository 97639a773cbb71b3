"""``compare_run``: pairing, gate, starts, headline sim, and what is left out with a reason."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from own_process import printed

from bridge.episode import schema
from bridge.episode.catalogue import label_episode
from bridge.episode.cdr.messages import CompressedColor
from bridge.episode.metadata import Derived, EpisodeInfo, Outcome
from bridge.episode.provenance import hash_file
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.errors import PathNotFoundError, UsageError
from bridge.media.color import encode_jpeg
from evaluator.cli import evaluate
from evaluator.compare import Comparison, TrialRow, compare_run
from evaluator.compare.motion import distance_over_time
from evaluator.errors import EvaluatorError


def row_of(comparison: Comparison, name: str) -> TrialRow:
    return next(row for row in comparison.rows if row.episode == name)


def reasons(comparison: Comparison, name: str) -> str:
    return " | ".join(e.reason for e in comparison.exclusions if e.episode == name)


def test_the_twin_agrees_with_five_of_six_trials(six_trials: Any) -> None:
    comparison = compare_run(six_trials.run)
    results = comparison.results()
    agreed = results.get("agreement.sim_planned.rate")
    assert (agreed.k, agreed.n, agreed.counted) == (5, 6, "trial")
    assert agreed.interval is not None
    assert agreed.interval.method == "wilson"
    # tp 3, fp 1, fn 0, tn 2: phi = 6 / sqrt(4 * 3 * 3 * 2)
    assert results.get("agreement.sim_planned.phi").value == pytest.approx(6 / np.sqrt(72))
    ppv = results.get("agreement.sim_planned.ppv")
    assert (ppv.k, ppv.n) == (3, 4)
    assert results.get("agreement.sim_planned.npv").k == 2
    assert comparison.stand_in is True


def test_a_point_of_the_scatter_compares_the_same_trials(six_trials: Any) -> None:
    six_trials.trial("b4", recorded="failure", condition="with_replanning", sent=False)
    comparison = compare_run(six_trials.run)
    results = comparison.results()
    cell = "cube_into_box.with_replanning.scripted"
    everyone = results.get(f"rate.recorded.{cell}")
    common = results.get(f"rate_common.recorded.{cell}")
    assert (everyone.k, everyone.n) == (2, 4)
    assert (common.k, common.n) == (2, 3)
    assert set(common.episodes) == set(results.get(f"rate_common.sim_planned.{cell}").episodes)
    with_replanning = next(c for c in comparison.groups if c.condition == "with_replanning")
    assert with_replanning.pair[1] == common


def test_starts_are_paired_across_conditions(six_trials: Any) -> None:
    results = compare_run(six_trials.run).results()
    name = "scripted_with_replanning.against.scripted_without_replanning"
    found = results.get(f"comparison.pp.{name}")
    assert (found.n, found.value) == (6, pytest.approx(100 / 3))
    assert "with replanning 2 of 3, without replanning 1 of 3" in found.definition
    counts = next(table for table in results.tables if table.id == "comparisons")
    line = dict(zip(counts.columns, counts.rows[0], strict=True))
    assert (line["shared starts"], line["decided"]) == (3, "no")


def test_executed_in_twin_never_enters_the_headline(maker: Any) -> None:
    maker.trial("t1", recorded="failure")
    maker.replay("t1", accepted=True, trajectory="executed")
    row = row_of(compare_run(maker.run), "t1")
    assert row.sim_executed is True
    assert row.sim_planned is None


def test_a_kinematic_replay_is_no_headline_sim(maker: Any) -> None:
    maker.trial("t1")
    maker.replay("t1", mode="kinematic")
    comparison = compare_run(maker.run)
    assert row_of(comparison, "t1").sim_planned is None
    assert "no dynamic replay of the planned trajectory" in reasons(comparison, "t1")


def test_only_the_plan_that_was_sent_counts(maker: Any) -> None:
    maker.trial("t1")
    maker.replay("t1", plan_id="plan_t1_unsent", accepted=False)
    maker.replay("t1", accepted=True)
    row = row_of(compare_run(maker.run), "t1")
    assert row.plan_id == "plan_t1"
    assert row.sim_planned is True
    assert (row.num_plans, row.num_plans_sent) == (2, 1)


def test_two_checkpoints_recorded_under_one_name_end_it_with_both_named(maker: Any) -> None:
    maker.trial("first", tags=("monday", "checkpoint:step 40000"))
    maker.trial("unsaid")
    assert row_of(compare_run(maker.run), "first").checkpoint == "step 40000"
    maker.trial("second", tags=("checkpoint:step 50000",))
    words = "second: policy 'scripted' is checkpoint 'step 50000', in first 'step 40000'"
    with pytest.raises(UsageError, match=words):
        compare_run(maker.run)


def test_a_trial_whose_plans_were_not_sent_executed_nothing(maker: Any) -> None:
    maker.trial("t1", recorded="failure", sent=False)
    maker.trial("t2", recorded="failure")
    comparison = compare_run(maker.run)
    assert row_of(comparison, "t1").nothing_executed
    assert not row_of(comparison, "t2").nothing_executed


def test_a_verdict_after_the_motion_started_is_not_before_motion(maker: Any) -> None:
    maker.trial("t1", gate=True, late_gate=False)
    maker.trial("t2", late_gate=False)
    comparison = compare_run(maker.run)
    assert row_of(comparison, "t1").verdict is True
    assert row_of(comparison, "t2").verdict is None


def test_every_gap_has_its_reason(maker: Any) -> None:
    maker.trial("unlabelled", recorded=None)
    maker.trial("unknown", recorded="unknown")
    maker.trial("unsent", sent=False)
    maker.trial("undecided")
    maker.replay("undecided", accepted=None)
    maker.trial("stale")
    maker.replay("stale", source_sha256="0" * 64)
    comparison = compare_run(maker.run)
    assert "not labelled" in reasons(comparison, "unlabelled")
    assert "labelled unknown" in reasons(comparison, "unknown")
    assert "no plan was sent" in reasons(comparison, "unsent")
    assert "terminal undecided" in reasons(comparison, "undecided")
    assert "another version of the episode" in reasons(comparison, "stale")
    rate = comparison.results().get("agreement.sim_planned.rate")
    assert rate.value is None
    assert rate.n == 0


def test_the_first_failing_factor_is_named(maker: Any) -> None:
    maker.trial("t1", recorded="failure")
    maker.replay("t1", accepted=False)
    row = row_of(compare_run(maker.run), "t1")
    assert row.first_failing == "clearance"
    assert row.failing_detail == "collision, gripper and box, at 1.50 s"


def test_a_label_given_afterwards_overrides_the_recorded_one(maker: Any) -> None:
    maker.trial("t1", recorded="success")
    label_episode(maker.run, "t1", Outcome(result="failure", k=0, n=1, by="reviewer"))
    assert row_of(compare_run(maker.run), "t1").recorded is False


@pytest.mark.parametrize("start_ns", [0, 10_000_000_000])
def test_tool_error_is_measured_at_matching_instants(maker: Any, start_ns: int) -> None:
    maker.trial("t1")
    maker.replay("t1", offset_m=0.01, start_ns=start_ns)
    row = row_of(compare_run(maker.run), "t1")
    planned = maker.run.derived_dir / str(row.planned_replay)
    recorded = maker.run.episodes_dir / row.file
    found = distance_over_time(recorded, planned, str(row.plan_id))
    assert found is not None
    np.testing.assert_allclose(found[1], 0.01, atol=1e-9)
    assert found[0][0] == 0.0
    assert found[0][-1] == pytest.approx(1.0)
    planned.unlink()
    assert distance_over_time(recorded, planned, str(row.plan_id)) is None


def test_an_episode_with_metadata_of_another_program_is_left_out_and_named(six_trials: Any) -> None:
    with EpisodeWriter(six_trials.run.episodes_dir / "foreign.mcap") as writer:
        writer.add_metadata("episode", {"id": "null", "kind": "7"})
    comparison = compare_run(six_trials.run)
    assert len(comparison.rows) == 6
    assert "cannot be read" in reasons(comparison, "foreign.mcap")


def test_an_empty_run_says_what_is_missing(tmp_path: Path) -> None:
    comparison = compare_run(RunFolder.create(tmp_path / "empty"))
    assert comparison.rows == ()
    assert comparison.stand_in is None
    assert any(text.startswith("trials:") for text in comparison.missing)
    assert any(text.startswith("views:") for text in comparison.missing)
    comparison.results().to_record()


def test_a_run_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PathNotFoundError, match="robot-gst record"):
        compare_run(RunFolder(tmp_path / "nowhere"))


def image_u8(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.kron(rng.integers(0, 255, (4, 5, 3)), np.ones((8, 8, 1))).astype(np.uint8)


def write_views(run: RunFolder, *, with_recorded: bool, source_sha256: str = "") -> None:
    info = EpisodeInfo(id="scan-views-x", kind="scan")
    derived = Derived(kind="views", source_episode="scan", source_sha256=source_sha256)
    scan = run.episodes_dir / "scan.mcap"
    views = run.derived_dir / "scan.views.x.mcap"
    with EpisodeWriter(scan) as original, EpisodeWriter(views) as rendered:
        original.describe(EpisodeInfo(id="scan", kind="scan"))
        rendered.describe(info, derived=derived)
        for index in range(3):
            recorded = encode_jpeg(image_u8(index), 95)
            again = encode_jpeg(
                np.clip(image_u8(index).astype(int) + 6, 0, 255).astype(np.uint8), 95
            )
            targets = [(original, "color", recorded), (rendered, "rendered", again)]
            if with_recorded:
                targets.append((rendered, "color", recorded))
            for writer, name, data in targets:
                color = CompressedColor(
                    stamp_ns=1000 + index, frame_id="wrist_color_optical", format="jpeg", data=data
                )
                writer.write(
                    f"/standin/cam/wrist/{name}/image",
                    color.to_cdr(),
                    type_name=schema.COMPRESSED_IMAGE,
                    log_time_ns=1000 + index,
                )


@pytest.mark.parametrize("with_recorded", [True, False])
def test_a_run_with_only_views_gets_image_scores(maker: Any, with_recorded: bool) -> None:
    write_views(maker.run, with_recorded=with_recorded)
    comparison = compare_run(maker.run)
    psnr = comparison.results().get("views.all.psnr_db")
    assert psnr.n == 3
    assert psnr.value is not None
    assert 28 < psnr.value < 40
    assert "JPEG" in psnr.definition
    lpips = comparison.results().get("views.all.lpips")
    assert lpips.value is None
    assert "no backbone" in str(lpips.reason_if_undefined)
    table = next(table for table in comparison.tables if table.id == "views_0")
    assert len(table.rows) == 3


def test_views_of_another_version_of_the_episode_are_left_out(maker: Any) -> None:
    write_views(maker.run, with_recorded=True, source_sha256="0" * 64)
    comparison = compare_run(maker.run)
    assert not any(m.id.startswith("views.") for m in comparison.measurements)
    assert "another version of the episode" in reasons(comparison, "scan.views.x.mcap")


def test_a_rendered_view_without_its_recorded_image_is_left_out(maker: Any) -> None:
    write_views(maker.run, with_recorded=False)
    (maker.run.episodes_dir / "scan.mcap").unlink()
    comparison = compare_run(maker.run)
    assert comparison.results().get("views.all.psnr_db").value is None
    assert any("no recorded image" in e.reason for e in comparison.exclusions)


def test_the_evaluator_loads_nothing_heavy() -> None:
    code = (
        "import sys, evaluator.compare, evaluator.report.write;"
        "print([n for n in ('torch','zenoh','mujoco','pybullet','open3d','pandas','twin')"
        " if n in sys.modules])"
    )
    assert printed(code) == "[]"


def test_a_run_of_which_nothing_can_be_read_ends_with_an_error_after_its_report(maker: Any) -> None:
    """Beside one episode that can be read, a broken one is left out and named."""
    maker.trial("t1")
    path = maker.run.episodes_dir / "t1.mcap"
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(EvaluatorError, match=r"nothing could be measured: t1\.mcap cannot be read"):
        evaluate(maker.run.path)
    assert (maker.run.results_dir / "report.html").is_file()
    maker.trial("t2")
    assert evaluate(maker.run.path) == 0


def test_a_verdict_made_before_motion_counts_although_it_arrived_late(maker: Any) -> None:
    """Gate and cell are two connections: the cell's stamp decides, not the order of arrival."""
    maker.trial("t1", late_gate=False, late_gate_made_ns=9_900_000_000)
    assert row_of(compare_run(maker.run), "t1").verdict is False


def test_a_plan_refused_but_executed_anyway_is_named_as_such(maker: Any) -> None:
    """Without replanning the gate was asked and not obeyed; with it, only its yes was sent."""
    for name, condition, recorded, said in (
        ("a", "without_replanning", "success", False),
        ("b", "without_replanning", "failure", False),
        ("c", "without_replanning", "success", True),
        ("d", "with_replanning", "failure", True),
    ):
        maker.trial(name, condition=condition, recorded=recorded, gate=said)
    comparison = compare_run(maker.run)
    results = comparison.results()
    npv = results.get("agreement.verdict.npv")
    assert (npv.k, npv.n) == (1, 2)
    assert (results.get("agreement.verdict.ppv").k, results.get("agreement.verdict.ppv").n) == (
        1,
        2,
    )
    unheeded = results.get("agreement.verdict_unheeded.ppv")
    assert (unheeded.k, unheeded.n) == (1, 1)
    assert "not obeyed" in unheeded.definition
    table = next(table for table in comparison.tables if table.id == "confusion")
    counts = {row[0]: row[1:] for row in table.rows}
    assert counts["verdict before motion"] == (1, 1, 1, 1, 4)
    assert counts["verdict, not obeyed (without replanning)"] == (1, 0, 1, 1, 3)
    assert counts["verdict, obeyed (with replanning)"] == (0, 1, 0, 0, 1)
    assert "executed anyway" in table.note


def test_the_success_table_says_that_the_twin_selected_the_accepted_plans(six_trials: Any) -> None:
    table = next(t for t in compare_run(six_trials.run).tables if t.id == "success")
    assert "the twin selected the accepted plans" in table.note


def test_the_largest_tool_error_is_not_lost_between_samples(maker: Any) -> None:
    maker.trial("t1", num_poses=900)
    maker.replay("t1", num_poses=900, astray=301)
    largest = compare_run(maker.run).results().get("motion.planned.path_max_m")
    assert largest.value == pytest.approx(1.0)


def test_a_pose_that_is_not_a_number_leaves_the_tool_error_undefined(maker: Any) -> None:
    maker.trial("t1")
    maker.replay("t1", offset_m=float("nan"))
    results = compare_run(maker.run).results()
    error = results.get("motion.planned.position_mean_m")
    assert error.value is None
    assert "not finite" in str(error.reason_if_undefined)
    assert results.get("agreement.sim_planned.rate").k == 1


def test_every_input_file_is_named_with_its_hash(six_trials: Any) -> None:
    provenance = compare_run(six_trials.run).provenance
    assert provenance["folder"] == str(six_trials.run.path)
    assert provenance["episodes"]["episodes/a1.mcap"] == hash_file(
        six_trials.run.episodes_dir / "a1.mcap"
    )
    assert all(len(item["sha256"]) == 64 for item in provenance["derived"].values())
