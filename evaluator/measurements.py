"""Every measurement: its id, unit, definition, and which way is better.

An id is a pattern: ``rate.{side}.{task}.{condition}.{policy}``. ``Quantity.of`` fills in the parts and gives
what a ``Measurement`` is made with, so no other module spells an id.
"""

from functools import partial

from evaluator import motion_measurements as motion_measurements
from evaluator.metrics import image
from evaluator.metrics.image import METRICS, ImageMetric
from evaluator.quantity import REGISTRY as REGISTRY
from evaluator.quantity import SIGNED, UP
from evaluator.quantity import Defined as Defined
from evaluator.quantity import Quantity as Quantity
from evaluator.quantity import new_quantity as _new
from evaluator.quantity import quantity_of as quantity_of
from evaluator.quantity import slug as slug

# ruff: noqa: E501  # one line for each definition

_good, _bad, _plain = (partial(_new, "1", better) for better in ("higher", "lower", "none"))
_good_pp, _bad_pp = (partial(_new, "pp", better) for better in ("higher", "lower"))
"""Shares, coefficients and percentage points that are better when higher or lower, or neither."""


# Success rates.

_SIDES = {
    "recorded": "successes / trials as labelled by the operator",
    "sim_planned": "successes / trials in the twin: the plan actually sent, planned trajectory, dynamic replay; with replanning the twin itself selected these plans",
    "sim_executed": "successes / trials in the twin: the executed joints replayed dynamically; diagnosis only, never part of r",
    "verdict": "plans accepted / plans judged: the gate's verdict on the plan actually sent, before motion; without replanning it was recorded and not obeyed, with replanning it selected these plans",
}
RATES = {
    side: _good(f"rate.{side}.{{task}}.{{condition}}.{{policy}}", words)
    for side, words in _SIDES.items()
}
RATES_IN_COMMON = {
    side: _good(
        f"rate_common.{side}.{{task}}.{{condition}}.{{policy}}",
        f"{_SIDES[side]}; over the trials where both sides are known",
    )
    for side in ("recorded", "sim_planned")
}
RATE_BY_UNIT = _good(
    "rate.recorded_{unit}.{task}.{condition}.{policy}",
    "successes / {unit}s as labelled; {unit}s of one trial are not independent, so the interval is narrower than the trials justify",
)
RATE_AS_GIVEN = _good(
    "rate.{side}.{task}.{condition}.{policy}", "successes / {unit}s, as given{where}"
)
STAGE = _good(
    "stage.{task}.{condition}.{stage}",
    "trials that passed stage {stage} of {task} / trials that reached it and whose ending is known",
)

# Which is better, and the protocol.

COMPARED = _good_pp(
    "comparison.pp.{second}.against.{first}",
    "recorded success of {second} less that of {first}, over all tasks, each weighted by its pairs: {words}",
)
COMPARED_IN_TASK = _good_pp(
    "comparison.pp.{second}.against.{first}.{task}", "the same in {task}: {words}"
)
PROTOCOL_DEPARTURES = _new(
    "count",
    "lower",
    "protocol.departures",
    "departures of what was done from the protocol that was locked before the first trial",
)

# Agreement over groups. ``{what}`` says over which.

PEARSON_R = _good(
    "agreement.pearson_r", "Pearson r of the twin's and the recorded success rates {what}", SIGNED
)
PEARSON_R_OF_CONDITION = _good("agreement.pearson_r.{condition}", PEARSON_R.definition, SIGNED)
BLIND_SHARE = _bad(
    "agreement.blind_share",
    "share of groups of this kind in which the twin says nothing of what is recorded, by the model of all counts",
)
BLIND_GROUP = _bad(
    "agreement.blind.{task}.{condition}.{policy}",
    "probability that the twin says nothing of what is recorded in this group, where it is 0.6 or more",
)
REGRET = _bad_pp(
    "decision.regret_pp",
    "recorded success rate of the best candidate less that of what the twin ranks first ({words}), mean over the tasks that all have",
    (0.0, 100.0),
)
WRONG_PAIRS = _bad(
    "decision.wrong_pairs",
    "pairs of candidates that the twin orders wrongly or as level / pairs whose recorded rates differ{words}",
)
WRONG_BY = _bad_pp(
    "decision.wrong_pairs_pp",
    "mean recorded difference of the pairs that the twin orders wrongly{words}",
    (0.0, 100.0),
)
SPEARMAN = _good(
    "agreement.spearman_rho",
    "Spearman rank correlation of the same rates {what}; average ranks",
    SIGNED,
)
BIAS = _new(
    "pp",
    "none",
    "agreement.bias_pp",
    "mean of sim rate - recorded rate {what}; above 0 the twin is optimistic",
)
MAE = _bad_pp("agreement.mae_pp", "mean size of sim rate - recorded rate {what}", (0.0, 100.0))
MMRV_RECORDED = _bad(
    "agreement.mmrv_recorded_gap",
    "mean maximum rank violation {what}; convention: gap of recorded rates (SIMPLER equation 1); it grows with the number of groups",
)
# Trial by trial: the replay, the verdict, the gate. ``{by}`` is sim_planned, verdict and so on.

AGREED = _good(
    "agreement.{by}.rate", "trials where {words} and the labelled outcome say the same / trials"
)
PHI = _good(
    "agreement.{by}.phi", "phi coefficient of {words} and the labelled outcome over trials", SIGNED
)
PPV = _good(
    "agreement.{by}.ppv",
    "positive predictive value: trials that succeeded / trials where {words} predicted success",
)
NPV = _good(
    "agreement.{by}.npv",
    "negative predictive value: trials that failed / trials where {words} predicted failure",
)
_BESIDE = "over trials where {words}, the forecast and the labelled outcome are known"
BASE_RATE = _plain(
    "baseline.{by}.base_rate",
    "trials that succeeded / trials where {words} and the labelled outcome are known: what always saying yes gets right",
)
BASELINE_ACCURACY = _plain(
    "baseline.{by}.{baseline}.rate",
    f"trials where the forecast without a twin ({{baseline}}) and the labelled outcome are the same / trials, {_BESIDE}",
)
BASELINE_GAIN = _good_pp(
    "baseline.{by}.{baseline}.twin_gain_pp",
    f"share of right answers of the twin minus that of the forecast ({{baseline}}), paired, {_BESIDE}",
)
# Images. A mean over views, before and after an alignment or a mask (``{variant}``).


def _image(images: str, metric: ImageMetric, variant: str) -> Quantity:
    return _new(
        metric.unit,
        "higher" if metric.higher_is_better else "lower",
        f"{images}.{metric.named(variant)}",
        f"{metric.definition}{{protocol}}",
        UP if metric.id.startswith("lpips") else SIGNED if metric.unit == "1" else UP,
    )


_IMAGES = ("views.{part}", "image.{method}")
VIEWS, RENDERS = (
    {(name, raw): _image(images, metric, "raw" if raw else "{variant}")
     for name, metric in METRICS.items() for raw in (True, False) if raw or not metric.raw_only}
    for images in _IMAGES
)  # fmt: skip
"""By the metric, and whether the images were compared as they are stored."""
LPIPS_MISSING = _bad("views.{part}.lpips", "learned perceptual image patch similarity", UP)
DEPTHS = {
    name: _new(
        "m",
        "lower",
        f"views.{{part}}.depth_{name}",
        f"{words} depth error, {image.DEPTH_PROTOCOL}; {{after}}",
    )
    for name, words in (("mean_abs_m", "mean absolute"), ("median_abs_m", "median absolute"))
}
"""By the field of ``DepthScore``."""
