"""The parts of the report, in the order a reader needs them, and what belongs to each."""

import re
from dataclasses import dataclass
from fnmatch import fnmatchcase

from evaluator.result import Measurement


@dataclass(frozen=True, kw_only=True)
class Section:
    """One part: which numbers, tables and figures it holds. Names may end in ``*``."""

    id: str
    title: str
    lead: str
    """What question it answers, and what to beware of."""
    numbers: tuple[tuple[str, str], ...] = ()
    """Pattern of ids, and what to call the number; an empty name is made from the id."""
    tables: tuple[str, ...] = ()
    figures: tuple[str, ...] = ()


SECTIONS: tuple[Section, ...] = (
    Section(
        id="conclusions",
        title="Task by task",
        lead="The numbers behind the sentences of the first page.",
        tables=("conclusions",),
    ),
    Section(
        id="published",
        title="The printed figures, recomputed",
        lead="A published table is taken at its rows; every printed figure that does not follow "
        "from them is named.",
        tables=("published",),
    ),
    Section(
        id="protocol",
        title="The study against its protocol",
        lead="What was fixed before the first trial, what it found, and every departure from it.",
        numbers=(("protocol.departures", "Departures from the protocol"),),
        tables=("protocol_departures",),
    ),
    Section(
        id="success",
        title="Success rates",
        lead="How often a task succeeded in the twin and as labelled. Sim is planned-in-twin: the "
        "plan actually sent, replayed with physics.",
        numbers=(),
        tables=("success", "layout", "notes"),
        figures=("success",),
    ),
    Section(
        id="agreement",
        title="Agreement over groups",
        lead="Whether the twin's rates move with the labelled ones, and how far off they are. A "
        "high r does not show that the right decision follows, nor that there is no bias.",
        numbers=(
            ("agreement.pearson_r", "Pearson r"),
            ("agreement.pearson_r.without_replanning", "Pearson r, without replanning"),
            ("agreement.pearson_r.with_replanning", "Pearson r, with replanning"),
            ("agreement.spearman_rho", "Spearman's rank correlation"),
            ("agreement.bias_pp", "Bias: sim minus labelled"),
            ("agreement.mae_pp", "Mean absolute error"),
            ("agreement.mmrv_recorded_gap", "MMRV, gap of recorded rates"),
            ("agreement.blind*", ""),
            ("decision.*", ""),
        ),
        figures=("scatter",),
    ),
    Section(
        id="comparisons",
        title="Which is better",
        lead="Policies, and each without and with replanning, as recorded.",
        numbers=(("comparison.*", ""),),
        tables=("comparisons", "standing"),
    ),
    Section(
        id="gate",
        title="Trial by trial: the gate's scorecard",
        lead="What the twin said of each plan against how it ended, and what obeying it costs "
        "and avoids.",
        numbers=(
            ("agreement.sim_planned.rate", "Sim and outcome agree"),
            ("agreement.sim_planned.ppv", "Success when sim says success (PPV)"),
            ("agreement.sim_planned.npv", "Failure when sim says failure (NPV)"),
            ("agreement.sim_planned.phi", "phi of sim and outcome"),
            ("baseline.sim_planned.base_rate", "Success whatever sim says (base rate)"),
            ("baseline.sim_planned.geometric_rule.rate", "Geometric rule and outcome agree"),
            ("baseline.sim_planned.geometric_rule.twin_gain_pp", "Sim more often right than it"),
            ("agreement.verdict.rate", "Verdict and outcome agree"),
            ("agreement.verdict.ppv", "Success when the gate accepted (PPV)"),
            ("agreement.verdict.npv", "Failure when the gate refused (NPV)"),
            ("agreement.verdict_unheeded.ppv", "PPV where the gate was not obeyed"),
            ("agreement.verdict_unheeded.npv", "NPV where the gate was not obeyed"),
            ("baseline.verdict_unheeded.base_rate", "Base rate where the gate was not obeyed"),
            (
                "baseline.verdict_unheeded.geometric_rule.twin_gain_pp",
                "Gate more right than it",
            ),
            ("reliability.brier", "Brier score of the stated probability"),
            ("reliability.brier_of_base_rate", "Brier score of the base rate"),
        ),
        tables=("confusion",),
    ),
    Section(
        id="against",
        title="Another twin, other raters",
        lead="Which of two twins is right more often on the same trials, and how far raters agree.",
        tables=("against", "flips", "raters"),
    ),
    Section(
        id="stages",
        title="Where trials are lost",
        lead="Which stage ends a trial, and what failed first on each side.",
        numbers=(),
        tables=("funnel", "failures"),
    ),
    Section(
        id="motion",
        title="Motions",
        lead="How far the recorded robot lies from the replayed one: planned tells about the "
        "controller, executed about kinematics and calibration.",
        numbers=tuple(
            (f"motion.{against}.{quantity}", f"{words}, {against} replay")
            for against in ("planned", "executed")
            for quantity, words in (
                ("lag_s", "Tool, lag behind the replay"),
                ("path_mean_m", "Tool, mean distance of the paths, lag taken out"),
                ("path_max_m", "Tool, largest distance of the paths"),
                ("end_point_m", "Tool, distance at the end"),
                ("joint_rms_rad", "Joints, root mean square"),
            )
        ),
        tables=("motion*", "end_points_*"),
    ),
    Section(
        id="states",
        title="Predicted states and labels",
        lead="Where the twin expected objects to end up, where they were localised, and where the "
        "replay left them; and whether labels and localised goals agree.",
        numbers=(("label.*", ""),),
        tables=("final_states", "label*"),
    ),
    Section(
        id="views",
        title="Images",
        lead="Rendered against held-out recorded images. No value stands without its protocol: it "
        "is in the definition of each number below.",
        numbers=(
            ("views.all.psnr_db", "PSNR, raw"),
            ("views.all.psnr_gain_db", "PSNR, after a gain per image"),
            ("views.all.ssim", "SSIM, raw"),
            ("views.all.ssim_gain", "SSIM, after a gain per image"),
            ("views.all.lpips*", ""),
            ("views.all.depth_median_abs_m", "Depth, median absolute error"),
            ("views.all.depth_mean_abs_m", "Depth, mean absolute error"),
            ("image.*", ""),
        ),
        tables=("views*", "image*"),
    ),
)

OTHER = Section(id="other", title="More tables", lead="", tables=("*",))
TRIALS = "trials"
"""The table that is as long as the run; it comes last."""


def section_of(table_id: str) -> Section:
    """Return the part a table belongs to."""
    for section in SECTIONS:
        if any(fnmatchcase(table_id, pattern) for pattern in section.tables):
            return section
    return OTHER


def numbers_of(
    section: Section, measurements: tuple[Measurement, ...]
) -> list[tuple[str, Measurement]]:
    """Return (name, measurement) of a part, in the order of its patterns."""
    found: dict[str, tuple[str, Measurement]] = {}
    for pattern, name in section.numbers:
        for measurement in measurements:
            if fnmatchcase(measurement.id, pattern):
                found.setdefault(measurement.id, (name or name_of(measurement.id), measurement))
    return list(found.values())


def name_of(measurement_id: str) -> str:
    """Write an id as words, for numbers that have no other name."""
    plain = _UNIT.sub("", measurement_id.removesuffix(".-"))
    words = plain.removeprefix("views.all.").replace("_", " ").split(".")
    return ", ".join(word for word in words if word not in ("", "-"))


_UNIT = re.compile(r"_(m|rad|s|db|pp)$")
"""Ends of ids that the value says again."""
