"""Every measurement: its id, unit, definition, and which way is better.

An id is a pattern: ``gain.pp.{side}.{task}.{policy}``. ``Quantity.of`` fills in the parts and gives
what a ``Measurement`` is made with, so no other module spells an id.
"""

import math
import sys
from pathlib import Path

from evaluator import motion_measurements as motion_measurements
from evaluator import study_measurements as study_measurements
from evaluator.metrics import image
from evaluator.metrics.image_protocol import ImageMetric
from evaluator.metrics.image_scores import METRICS
from evaluator.quantity import REGISTRY as REGISTRY
from evaluator.quantity import SIGNED, UP, Better, with_tables
from evaluator.quantity import Defined as Defined
from evaluator.quantity import Quantity as Quantity
from evaluator.quantity import new_quantity as _new
from evaluator.quantity import quantity_of as quantity_of
from evaluator.quantity import slug as slug

# ruff: noqa: E501  # one line for each definition


# Success rates.

_SIDES = {
    "recorded": "successes / trials as labelled by the operator",
    "sim_planned": "successes / trials in the twin: the plan actually sent, planned trajectory, dynamic replay; with replanning the twin itself selected these plans",
    "sim_executed": "successes / trials in the twin: the executed joints replayed dynamically; diagnosis only, never part of r",
    "verdict": "plans accepted / plans judged: the gate's verdict on the plan actually sent, before motion; without replanning it was recorded and not obeyed, with replanning it selected these plans",
}
RATES = {
    side: _new(f"rate.{side}.{{task}}.{{condition}}.{{policy}}", "1", "higher", words)
    for side, words in _SIDES.items()
}
RATES_IN_COMMON = {
    side: _new(
        f"rate_common.{side}.{{task}}.{{condition}}.{{policy}}",
        "1",
        "higher",
        f"{_SIDES[side]}; over the trials where both sides are known",
    )
    for side in ("recorded", "sim_planned")
}
RATE_BY_UNIT = _new(
    "rate.recorded_{unit}.{task}.{condition}.{policy}",
    "1",
    "higher",
    "successes / {unit}s as labelled; {unit}s of one trial are not independent, so the interval is narrower than the trials justify",
)
RATE_AS_GIVEN = _new(
    "rate.{side}.{task}.{condition}.{policy}",
    "1",
    "higher",
    "successes / {unit}s, as given{where}",
)
RATE_VARIED = _new(
    "rate.sim_varied.{task}.{condition}.{policy}",
    "1",
    "higher",
    "mean over trials of the share of varied planned replays of the plan actually sent that succeed: start, friction, forces, masses, stiffness and timing drawn anew, no draw that the gate used",
)
SELECTION_BIAS = _new(
    "bias.selection.{task}.{condition}.{policy}",
    "pp",
    "none",
    "sim - sim estimated again, over the trials that have varied replays",
)
AVERAGE_MACRO = _new(
    "average.macro.{side}.{condition}",
    "1",
    "higher",
    "mean of the unrounded {side} rates of {over} {condition}: every group counts the same",
)
AVERAGE_POOLED = _new(
    "average.pooled.{side}.{condition}",
    "1",
    "higher",
    "successes / {unit}s over {over} {condition} ({side}): every trial counts the same",
)
NEVER_SENT = _new(
    "plans.never_sent",
    "count",
    "none",
    "plans that were published and never executed, of all plans published; they are part of no rate",
)
STAGE = _new(
    "stage.{task}.{condition}.{stage}",
    "1",
    "higher",
    "trials that passed stage {stage} of {task} / trials that reached it and whose ending is known",
)

# Gains with replanning.

GAIN_POINTS = _new(
    "gain.pp.{side}.{task}.{policy}",
    "pp",
    "higher",
    "gain with replanning in percentage points ({side}): {words}",
)
GAIN_RELATIVE = _new(
    "gain.relative.{side}.{task}.{policy}",
    "1",
    "higher",
    "relative gain with replanning ({side}), (with - without) / without: {words}; not percentage points",
    (-1.0, math.inf),
)
GAIN_POINTS_AVERAGE = _new(
    "gain.pp.{side}.average",
    "pp",
    "higher",
    "gain with replanning in percentage points of the unrounded mean rates of {count} tasks ({side})",
)
GAIN_RELATIVE_AVERAGE = _new(
    "gain.relative.{side}.average",
    "1",
    "higher",
    "relative gain with replanning of the unrounded mean rates of {count} tasks ({side}); not percentage points",
    (-1.0, math.inf),
)
BOSCHLOO = _new(
    "unpaired.boschloo_p.{side}.{task}.{policy}",
    "1",
    "none",
    "two-sided p of Boschloo's exact test, starts not paired: {about}",
)
BOSCHLOO_POOLED = _new(
    "unpaired.boschloo_p.{side}.pooled",
    "1",
    "none",
    "two-sided p of Boschloo's exact test over the pooled trials of {count} tasks ({side}), starts not paired",
)
TRIALS_NEEDED = _new(
    "power.trials_needed.{side}.{task}.{policy}",
    "count",
    "none",
    "per condition, to show a gain as large as {about} with {power}",
)
PAIRED_GAIN = _new(
    "paired.gain_pp.{side}",
    "pp",
    "higher",
    "gain with replanning in percentage points over paired starts: {words}",
)
MCNEMAR = {
    kind: _new(
        f"paired.mcnemar_p_{kind}.{{side}}",
        "1",
        "none",
        f"two-sided McNemar test, {test}: {{words}}",
    )
    for kind, test in (("exact", "exact binomial"), ("mid", "mid-p"))
}
START_DISTANCE = {
    kind: _new(
        f"paired.start_distance_{kind}_m",
        "m",
        "lower",
        f"{kind} over paired starts of the largest distance between the localised objects of both trials; pairs beyond {{limit_mm:.0f}} mm are excluded, {{unknown}} of {{count}} pairs were not localised and are kept",
    )
    for kind in ("mean", "max")
}

# Agreement over groups. ``{what}`` says over which.


def _agreement(
    name: str,
    unit: str,
    better: Better,
    definition: str,
    allowed: tuple[float, float] | None = None,
) -> Quantity:
    return _new(f"agreement.{name}", unit, better, f"{definition}{{resampled}}", allowed)


PEARSON_R = _agreement(
    "pearson_r",
    "1",
    "higher",
    "Pearson r of the twin's and the recorded success rates {what}",
    SIGNED,
)
PEARSON_R_OF_CONDITION = _new(
    "agreement.pearson_r.{condition}",
    "1",
    "higher",
    PEARSON_R.definition,
    SIGNED,
)
PEARSON_R_REMEASURED = _new(
    "agreement.pearson_r_remeasured",
    "1",
    "higher",
    "the same r {what}; its band is where r would fall if the same groups were measured again with as many trials",
    SIGNED,
)
MODEL_R = _new(
    "agreement.model.r",
    "1",
    "higher",
    "correlation of the true rates of these groups: the noise of counting is taken out",
    SIGNED,
)
MODEL_R_OTHERS = _new(
    "agreement.model.r_others",
    "1",
    "higher",
    "the same over all groups of this kind; its interval is that of Pearson r",
    SIGNED,
)
MODEL_WITHIN = _new(
    "agreement.model.r_within",
    "1",
    "higher",
    "correlation of log-odds between groups of one task, noise of counting taken out",
    SIGNED,
)
MODEL_BETWEEN = _new(
    "agreement.model.r_between",
    "1",
    "higher",
    "correlation of the mean log-odds of tasks, noise of counting taken out",
    SIGNED,
)
MODEL_OPPOSED = _new(
    "agreement.model.opposed",
    "1",
    "none",
    "probability that the correlations within and between tasks have different signs",
)
MODEL_BIAS = _new(
    "agreement.model.bias_pp",
    "pp",
    "none",
    "mean true sim rate - true recorded rate of these groups",
)
MODEL_BIAS_OF_GROUP = _new(
    "agreement.model.bias_pp.{task}.{condition}.{policy}",
    "pp",
    "none",
    "true sim rate - true recorded rate of one group, drawn towards the others where it is small",
)
MODEL_GAIN = _new(
    "gain.model.pp.{side}.average",
    "pp",
    "higher",
    "gain with replanning ({side}), mean of tasks, in the model of all groups",
)
MODEL_GAIN_OF_TASK = _new(
    "gain.model.pp.{side}.{task}.{policy}",
    "pp",
    "higher",
    "gain with replanning ({side}) of one task in the model of all groups: drawn towards the others",
)
MODEL_BEST = _new(
    "decision.model.best",
    "1",
    "higher",
    "probability that what the twin calls best ({words}) has the highest recorded rate",
)
SPEARMAN = _agreement(
    "spearman_rho",
    "1",
    "higher",
    "Spearman rank correlation of the same rates {what}; average ranks",
    SIGNED,
)
BIAS = _agreement(
    "bias_pp",
    "pp",
    "none",
    "mean of sim rate - recorded rate {what}; above 0 the twin is optimistic",
)
MAE = _agreement(
    "mae_pp",
    "pp",
    "lower",
    "mean size of sim rate - recorded rate {what}",
    (0.0, 100.0),
)
ORDER_ACCURACY = _agreement(
    "order_accuracy",
    "1",
    "higher",
    "pairs of groups that the twin orders as the recorded rates do / pairs whose recorded rates differ; a tie in the twin counts 1/2; {what}",
)
MMRV_RECORDED = _agreement(
    "mmrv_recorded_gap",
    "1",
    "lower",
    "mean maximum rank violation {what}; convention: gap of recorded rates (SIMPLER equation 1); it grows with the number of groups",
)
# Trial by trial: the replay, the verdict, the gate. ``{by}`` is sim_planned, verdict and so on.

AGREED = _new(
    "agreement.{by}.rate",
    "1",
    "higher",
    "trials where {words} and the labelled outcome say the same / trials",
)
PHI = _new(
    "agreement.{by}.phi",
    "1",
    "higher",
    "phi coefficient of {words} and the labelled outcome over trials",
    SIGNED,
)
KAPPA = _new(
    "agreement.{by}.kappa",
    "1",
    "higher",
    "Cohen's kappa of {words} and the labelled outcome over trials",
    SIGNED,
)
PPV = _new(
    "agreement.{by}.ppv",
    "1",
    "higher",
    "positive predictive value: trials that succeeded / trials where {words} predicted success",
)
NPV = _new(
    "agreement.{by}.npv",
    "1",
    "higher",
    "negative predictive value: trials that failed / trials where {words} predicted failure",
)
_BESIDE = "over trials where {words}, the forecast and the labelled outcome are known"
BASE_RATE = _new(
    "baseline.{by}.base_rate",
    "1",
    "none",
    "trials that succeeded / trials where {words} and the labelled outcome are known: what always saying yes gets right",
)
BASELINE_ACCURACY = _new(
    "baseline.{by}.{baseline}.rate",
    "1",
    "none",
    f"trials where the forecast without a twin ({{baseline}}) and the labelled outcome are the same / trials, {_BESIDE}",
)
BASELINE_PPV = _new(
    "baseline.{by}.{baseline}.ppv",
    "1",
    "none",
    f"trials that succeeded / trials where the forecast without a twin ({{baseline}}) said success, {_BESIDE}",
)
BASELINE_NPV = _new(
    "baseline.{by}.{baseline}.npv",
    "1",
    "none",
    f"trials that failed / trials where the forecast without a twin ({{baseline}}) said failure, {_BESIDE}",
)
BASELINE_GAIN = _new(
    "baseline.{by}.{baseline}.twin_gain_pp",
    "pp",
    "higher",
    f"share of right answers of the twin minus that of the forecast ({{baseline}}), paired, {_BESIDE}",
)
BASELINE_GAIN_OF_TASK = _new(
    "baseline.{by}.{baseline}.twin_gain_pp.{task}",
    "pp",
    "higher",
    BASELINE_GAIN.definition,
)
BREAK_EVEN_PRICE = _new(
    "gate.break_even_price",
    "1",
    "higher",
    "bad executions avoided / good plans refused, by verdicts that were not obeyed: what refusing a good plan may cost, in bad executions, for the gate to pay",
    UP,
)
_WHOSE = "the probability is the planned replay's, where it has none the verdict's before motion; with replanning the twin selected these plans"
BRIER = _new(
    "reliability.brier",
    "1",
    "lower",
    f"Brier score: mean of (sampled success probability - outcome)^2; {_WHOSE}",
)
BRIER_OF_BASE_RATE = _new(
    "reliability.brier_of_base_rate",
    "1",
    "none",
    "Brier score of always saying the observed success rate; above it the probability is worth nothing",
)
BRIER_PERFECT = _new(
    "reliability.brier_perfect",
    "1",
    "none",
    "Brier score of a perfect forecaster of the same probabilities, with the range of 95 % of what it would show over as many trials",
)
LABEL_AGREED = _new(
    "label.localised.rate",
    "1",
    "higher",
    "trials{where} where the operator's label and the success predicate on the poses localised after the execution say the same / trials where both are known{without}",
)
LABEL_AGREED_OF_TASK = _new("label.localised.{task}.rate", "1", "higher", LABEL_AGREED.definition)
LABEL_OBJECTS = _new(
    "label.objects.rate",
    "1",
    "higher",
    "trials where the operator counted as many objects as the predicate on the localised poses / trials labelled by object where both are known",
)

# Images. A mean over views, before and after an alignment or a mask (``{variant}``).


def _image(images: str, metric: ImageMetric, variant: str) -> Quantity:
    return _new(
        f"{images}.{metric.named(variant)}",
        metric.unit,
        "higher" if metric.higher_is_better else "lower",
        f"{metric.definition}{{protocol}}",
        UP if metric.id.startswith("lpips") else SIGNED if metric.unit == "1" else UP,
    )


_IMAGES = ("views.{part}", "image.{method}")
VIEWS, RENDERS = (
    {(name, raw): _image(images, metric, "raw" if raw else "{variant}")
     for name, metric in METRICS.items() for raw in (True, False)}
    for images in _IMAGES
)  # fmt: skip
"""By the metric, and whether the images were compared as they are stored."""
LPIPS_MISSING = _new(
    "views.{part}.lpips",
    "1",
    "lower",
    "learned perceptual image patch similarity",
    UP,
)
DEPTHS = {
    name: _new(
        f"views.{{part}}.depth_{name}",
        "m",
        "lower",
        f"{words} depth error, {image.DEPTH_PROTOCOL}; {{after}}",
    )
    for name, words in (
        ("mean_abs_m", "mean absolute"),
        ("median_abs_m", "median absolute"),
        ("rmse_m", "root mean square"),
    )
}
"""By the field of ``DepthScore``."""


if __name__ == "__main__":  # python -m evaluator.measurements docs/metrics.md
    for name in sys.argv[1:]:
        page = Path(name)
        page.write_text(with_tables(page.read_text()))
