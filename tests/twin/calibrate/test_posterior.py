"""A session's own trials as evidence: what draws are kept, how much a yes is trusted afterwards."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from scipy import integrate, stats
from small_plans import plan_of
from verdicts import verdict_of

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.task.task_file import load_task
from bridge.task.verdict import Factor, Verdict
from bridge.terminal import Output
from twin.calibrate import posterior
from twin.calibrate.posterior import (
    BIAS_M,
    FRICTION,
    WRONG,
    Ended,
    Trial,
    calibrate_posterior,
    describe_posterior,
    draw_beforehand,
    effective,
    log_nearness,
    trusted,
    weighed,
)
from twin.physics.unseen import CENTRE_OF_MASS, EDGE_SHARE
from twin.replay import monte_carlo, rebuilt_scene
from twin.replay.config import PosteriorDraw, ReplayConfig, VariationConfig
from twin.replay.monte_carlo import rigid_movers
from twin.replay.scene import ReplayScene
from twin.scene.store.calibration import Calibration, read_calibration, write_part

QUIET = Output(quiet=True)
TASK = load_task("slippery_block_into_box")
PLAN = plan_of()
VERDICT = verdict_of()


def scene() -> ReplayScene:
    poses = TASK.draw_start(np.random.default_rng(3))
    return ReplayScene(task=TASK, urdf="", Ts_base_object=poses)


def trial(*, success: bool, end_m: tuple[float, float] = (0.5, 0.2)) -> Trial:
    return Trial(
        info=EpisodeInfo(id=f"trial_{success}", kind="trial"),
        sha256="0",
        plan=PLAN,
        scene=scene(),
        config=ReplayConfig(),
        success=success,
        ends_m={"block": np.array(end_m)},
    )


def holds_from(limit: float) -> object:
    """A world in which a block is held from a friction on."""

    def end_of(tried: Trial, draw: PosteriorDraw) -> Ended:
        held = draw.finger_pair_friction * draw.grip_scale / draw.mass_scale > limit
        end_m = np.array([0.5, 0.2]) if held else tried.scene.Ts_base_object["block"][:2, 3]
        return Ended(success=held, ends_m={"block": end_m})

    return end_of


def test_draws_fill_the_priors_evenly_and_are_the_same_every_time() -> None:
    draws = draw_beforehand(256, {})
    assert draws == draw_beforehand(256, {})
    assert sum(draw.weight for draw in draws) == pytest.approx(1.0)
    friction = np.array([draw.finger_pair_friction for draw in draws])
    middle = np.sqrt(FRICTION[0] * FRICTION[1])
    assert np.mean(friction < middle) == pytest.approx(0.5, abs=0.01)
    assert friction.min() >= FRICTION[0]
    assert friction.max() <= FRICTION[1]
    bias = np.array([draw.bias_m for draw in draws])
    np.testing.assert_allclose(bias.std(axis=0), BIAS_M, rtol=0.05)


@pytest.mark.parametrize(("right", "wrong"), [(0, 0), (4, 0), (2, 2), (0, 4)])
def test_how_far_an_answer_is_trusted_is_the_integral_over_all_rates(
    right: int, wrong: int
) -> None:
    """Independent reference: Bayes' rule by quadrature over how often it is wrong."""
    rate = stats.beta(*WRONG)

    def weigh(extra: int) -> float:
        return float(
            integrate.quad(
                lambda q: rate.pdf(q) * q ** (wrong + extra) * (1 - q) ** right, 0, 1, limit=200
            )[0]
        )

    likelihood, next_wrong = trusted(right, wrong)
    assert np.exp(likelihood) == pytest.approx(weigh(0), rel=1e-4)
    assert next_wrong == pytest.approx(weigh(1) / weigh(0), rel=1e-4)


def test_draws_that_end_as_the_trials_did_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(posterior, "end_of", holds_from(0.3))
    draws = draw_beforehand(64, {})
    start = scene().Ts_base_object["block"][:2, 3]
    fell = [trial(success=False, end_m=tuple(start)) for _ in range(3)]
    kept = weighed(draws, fell, workers=1, output=QUIET)
    assert sum(draw.weight for draw in kept) == pytest.approx(1.0)
    loses = [d.finger_pair_friction * d.grip_scale / d.mass_scale <= 0.3 for d in kept]
    weights = np.array([draw.weight for draw in kept])
    assert weights[loses].sum() > 0.95
    assert effective(kept) <= sum(loses) + 1


def test_what_no_draw_explains_makes_every_yes_doubtful(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(posterior, "end_of", holds_from(-1.0))  # the twin always says yes
    draws = draw_beforehand(8, {})
    doubtful = weighed(draws, [trial(success=False)] * 4, workers=1, output=QUIET)
    sure = weighed(draws, [trial(success=True)] * 4, workers=1, output=QUIET)
    assert all(draw.wrong_yes > 0.7 for draw in doubtful)
    assert all(draw.wrong_yes < 0.1 for draw in sure)
    assert {draw.wrong_no for draw in doubtful} == {WRONG[0] / sum(WRONG)}


def test_an_end_elsewhere_counts_against_a_draw_but_not_without_bound() -> None:
    seen = trial(success=True)
    logs = [
        log_nearness(seen, Ended(success=True, ends_m={"block": np.array([0.5 + off_m, 0.2])}))
        for off_m in (0.0, 0.005, 0.02, 1.0)
    ]
    assert logs == sorted(logs, reverse=True)
    assert logs[0] == pytest.approx(0.0)
    assert log_nearness(seen, Ended(success=False, ends_m={})) == pytest.approx(logs[-1])


def test_a_draw_shifts_every_object_and_keeps_the_objects_own_friction() -> None:
    draw = replace(draw_beforehand(2, {})[1], bias_m=(0.004, -0.002), mass_scale=1.5)
    before, config = scene(), ReplayConfig()
    after, settings = monte_carlo.with_draw(draw, before, config)
    for name, T in before.Ts_base_object.items():
        np.testing.assert_allclose(after.Ts_base_object[name][:2, 3] - T[:2, 3], draw.bias_m)
    own = settings.physics.object_friction
    assert own == config.physics.object_friction
    assert settings.physics.finger_friction * own == pytest.approx(draw.finger_pair_friction)
    heavier = after.task.objects["block"].mass_kg / before.task.objects["block"].mass_kg
    assert heavier == pytest.approx(1.5)
    assert after.task.objects["box"] == before.task.objects["box"]


def test_each_rigid_mover_has_edges_and_weight_of_its_own_within_the_priors() -> None:
    movers = rigid_movers(load_task("clear_then_place"))
    assert list(movers) == ["block", "cube"]
    draws = draw_beforehand(256, movers)
    for name, model in movers.items():
        half_m = np.array(model.size_m) / 2
        found = [dict(draw.unseen)[name] for draw in draws]
        shares = np.array([each.edge_m for each in found]) / half_m.min()
        assert 0 <= shares.min() < 0.01 < shares.max() <= EDGE_SHARE
        assert shares.mean() == pytest.approx(EDGE_SHARE / 2, rel=0.02)
        centres = np.array([each.centre_of_mass_m for each in found]) / half_m
        np.testing.assert_allclose(centres.std(axis=0), CENTRE_OF_MASS, rtol=0.05)
        np.testing.assert_allclose(centres.mean(axis=0), 0.0, atol=0.01)
    first, second = (np.array([d.unseen[k][1].edge_m for d in draws]) for k in (0, 1))
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.1
    assert rigid_movers(load_task("sloth_into_basket")) == {}


def test_samples_draw_edges_and_weight_anew_where_no_draw_says_them() -> None:
    stays = draw_beforehand(2, rigid_movers(TASK))[0]
    half_m, rng = np.array(TASK.objects["block"].size_m) / 2, np.random.default_rng(0)
    for draws in ((), (replace(stays, unseen=()),), (stays,)):
        config = ReplayConfig(variation=VariationConfig(posterior=draws))
        drawn = [monte_carlo.draw_variation(rng, scene(), config)[0].unseen for _ in range(200)]
        if draws == (stays,):
            assert all(unseen == dict(stays.unseen) for unseen in drawn)
            continue
        assert all(set(unseen) == {"block"} for unseen in drawn)
        edges_m = np.array([unseen["block"].edge_m for unseen in drawn])
        centres_m = np.array([unseen["block"].centre_of_mass_m for unseen in drawn])
        assert edges_m.mean() == pytest.approx(EDGE_SHARE * half_m.min() / 2, rel=0.15)
        np.testing.assert_allclose(centres_m.std(axis=0), CENTRE_OF_MASS * half_m, rtol=0.2)


def test_samples_take_turns_among_the_draws_as_their_weights_say() -> None:
    shares = [monte_carlo.halving(index) for index in range(16)]
    np.testing.assert_allclose(np.diff(sorted(shares)), 1 / 17, atol=0.04)
    first, second = draw_beforehand(2, {})
    few = (replace(first, weight=0.75), replace(second, weight=0.25))
    config = ReplayConfig(variation=VariationConfig(posterior=few))
    frictions = [
        monte_carlo.draw_variation(monte_carlo.sample_rng(0, "s", k), scene(), config, index=k)[
            1
        ].physics.finger_friction
        for k in range(16)
    ]
    its_own = first.finger_pair_friction / config.physics.object_friction
    assert sum(value == its_own for value in frictions) == 12


def test_the_success_probability_counts_each_answer_as_far_as_it_is_trusted() -> None:
    draw = replace(draw_beforehand(2, {})[0], weight=1.0, wrong_yes=0.4, wrong_no=0.1)
    config = ReplayConfig(samples=4, variation=VariationConfig(posterior=(draw,)))
    answers = iter([True, True, False, None])

    def replay(there: ReplayScene, settings: ReplayConfig) -> Verdict:
        return replace(VERDICT, terminal=Factor(value=next(answers)))

    p = monte_carlo.with_samples(VERDICT, replay, scene(), config, identity="s").p_success
    assert p is not None
    assert p["value"] == pytest.approx((0.6 + 0.6 + 0.1 + 0.1) / 4)
    assert (p["k"], p["n"]) == (2, 4)
    assert p["low"] < p["value"] < p["high"]


def of_one_task(draws: Sequence[PosteriorDraw]) -> dict[str, object]:
    return {
        "draws": [asdict(draw) for draw in draws],
        "effective_draws": float(len(draws)),
        "sources": {"trial_0001": trial(success=True).to_record()},
    }


def record_of(tasks: Mapping[str, Sequence[PosteriorDraw]]) -> dict[str, object]:
    return {
        "tasks": {name: of_one_task(draws) for name, draws in tasks.items()},
        "skipped": {"trial_0002": "nobody said how it ended"},
    }


def test_replays_read_the_posterior_that_was_written(tmp_path: Path) -> None:
    run, draws = RunFolder.create(tmp_path / "run"), draw_beforehand(4, {})
    record = record_of({TASK.name: draws})
    _, before = write_part(run, "posterior", record)
    known = read_calibration(run)
    assert known is not None
    assert rebuilt_scene.calibrated(ReplayConfig(), known, TASK).variation.posterior == tuple(draws)
    told = describe_posterior(record, before)
    assert f"{TASK.name}: 4 draws weighed by 1 trials, 1 of which succeeded" in told
    assert "trial_0002 not used" in told
    write_part(run, "posterior", record_of({TASK.name: draws[:2]}))
    again = read_calibration(run)
    assert again is not None
    assert again.calibration_id != before
    damaged = {**known.record, "posterior": {"tasks": {TASK.name: {"draws": [{"weight": 1.0}]}}}}
    with pytest.raises(rebuilt_scene.UnreadablePosteriorError, match="finger_pair_friction"):
        rebuilt_scene.posterior_of(Calibration(record=damaged, cameras={}), TASK)


def test_a_task_takes_its_own_draws_and_never_silently_anothers(tmp_path: Path) -> None:
    run, draws = RunFolder.create(tmp_path / "run"), draw_beforehand(4, {})
    other = load_task("heavy_block_into_box")
    write_part(run, "posterior", record_of({TASK.name: draws[:1], other.name: draws[1:]}))
    known = read_calibration(run)
    assert known is not None
    assert rebuilt_scene.posterior_of(known, TASK) == tuple(draws[:1])
    assert rebuilt_scene.posterior_of(known, other) == tuple(draws[1:])
    assert rebuilt_scene.read_rebuilt_scene(run, TASK).notes == ()
    alone = load_task("cube_into_box")
    assert rebuilt_scene.calibrated(ReplayConfig(), known, alone).variation.posterior == ()
    assert rebuilt_scene.read_rebuilt_scene(run, alone).notes == (rebuilt_scene.OTHER_TASKS,)


def test_a_task_is_weighed_by_its_own_trials_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One task's trials all fall and another's are all held: neither moves the other's draws."""
    monkeypatch.setattr(posterior, "end_of", holds_from(0.3))
    run, other = RunFolder.create(tmp_path / "run"), load_task("heavy_block_into_box")
    start = scene().Ts_base_object["block"][:2, 3]
    fell = [trial(success=False, end_m=tuple(start)) for _ in range(3)]
    held = [
        replace(each, info=replace(each.info, id="held"), scene=replace(each.scene, task=other))
        for each in [trial(success=True)] * 3
    ]
    monkeypatch.setattr(posterior, "read_trials", lambda run, output: ([*held, *fell], {}))
    record, _ = calibrate_posterior(run, num_draws=16, workers=1, output=QUIET)
    assert sorted(record["tasks"]) == sorted([TASK.name, other.name])
    known = read_calibration(run)
    assert known is not None
    for task, mine in ((TASK, fell), (other, held)):
        movers = rigid_movers(task)
        alone = weighed(draw_beforehand(16, movers), mine, workers=1, output=QUIET)
        assert rebuilt_scene.posterior_of(known, task) == tuple(alone), (
            "as from a run of this task alone"
        )
    assert rebuilt_scene.posterior_of(known, TASK) != rebuilt_scene.posterior_of(known, other)


def test_a_run_without_executed_trials_says_so(run: RunFolder) -> None:
    with pytest.raises(UsageError, match="no executed trial"):
        calibrate_posterior(run, num_draws=2, workers=1, output=QUIET)
    assert not (run.scene_dir / "calibration.json").exists()
