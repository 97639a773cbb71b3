"""What a report shows, in the order a reader needs it: parts, their tables, their numbers."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from evaluator.result import Measurement, Results, Table

HEADLINES: dict[str, str] = {
    "agreement.sim_planned.rate": "Twin and recorded outcome agree",
    "agreement.sim_planned.phi": "phi of twin and recorded outcome",
    "agreement.sim_planned.ppv": "Success when the twin says success (PPV)",
    "agreement.sim_planned.npv": "Failure when the twin says failure (NPV)",
    "baseline.sim_planned.base_rate": "Success whatever the twin says (base rate)",
    "baseline.sim_planned.geometric_rule.rate": "Geometric rule and outcome agree",
    "baseline.sim_planned.geometric_rule.twin_gain_pp": "Twin more often right than that rule",
    "agreement.verdict.ppv": "Success when the gate accepted (PPV)",
    "agreement.pearson_r": "Pearson r over groups",
    "agreement.pearson_r.without_replanning": "Pearson r without replanning",
    "agreement.pearson_r.with_replanning": "Pearson r with replanning",
    "agreement.bias_pp": "Bias of the twin",
    "agreement.mmrv_recorded_gap": "MMRV (gap of recorded rates)",
    "decision.regret_pp": "Loss of taking what the twin ranks first",
    "motion.planned.path_mean_m": "Tool path: recorded to planned replay, lag taken out",
    "motion.planned.lag_s": "Tool lag: recorded behind planned replay",
    "motion.executed.path_mean_m": "Tool path: recorded to executed replay, lag taken out",
    "views.all.psnr_db": "PSNR of held-out views, raw",
    "views.all.psnr_gain_db": "The same after a gain per image and channel",
    "views.all.ssim": "SSIM of held-out views",
    "views.all.ssim_zero": "The same, zeros beyond the border",
    "views.all.depth_median_abs_m": "Depth of held-out views, median error of an image",
    "views.all.depth_mean_abs_m": "The same, mean error: edges count most",
    "views.all.lpips": "LPIPS of held-out views",
    "views.all.lpips_vgg_01": "LPIPS (VGG, images in 0..1) of held-out views",
}
"""What to read first, and what to call it."""
NAMES: dict[str, str] = HEADLINES | {
    "protocol.departures": "Departures from the protocol",
    "agreement.spearman_rho": "Spearman's rank correlation",
    "agreement.mae_pp": "Mean absolute error of the twin",
    "agreement.blind_share": "Share of groups in which the twin is blind",
    "decision.wrong_pairs": "Pairs of candidates in the wrong order",
    "decision.wrong_pairs_pp": "Recorded difference of those pairs, mean",
    "agreement.verdict.rate": "Verdict and outcome agree",
    "agreement.verdict.npv": "Failure when the gate refused (NPV)",
    "agreement.verdict_unheeded.ppv": "PPV where the gate was not obeyed",
    "agreement.verdict_unheeded.npv": "NPV where the gate was not obeyed",
    "baseline.verdict_unheeded.base_rate": "Base rate where the gate was not obeyed",
    "baseline.verdict_unheeded.geometric_rule.twin_gain_pp": "Gate more often right than the rule",
    "motion.planned.path_max_m": "Tool path: largest distance to planned replay",
}
"""All numbers that a report calls by name; the others stand in ``results.json``."""


@dataclass(frozen=True)
class Section:
    """One part: which numbers, tables and figures it holds. Names may end in ``*``."""

    id: str
    title: str
    lead: str
    """What question it answers, and what to beware of."""
    numbers: tuple[str, ...] = ()
    """Patterns of ids; those in ``NAMES`` are shown."""
    tables: tuple[str, ...] = ()
    figures: tuple[str, ...] = ()


_TEXT = """
conclusions | Task by task |  | conclusions
    The numbers behind the sentences of the first page.
published | The printed figures, recomputed |  | published
    A published table is taken at its rows; every printed figure that does not follow from them
    is named.
protocol | The study against its protocol | protocol.* | protocol_departures
    What was fixed before the first trial, what it found, and every departure from it.
success | Success rates |  | success notes | success
    How often a task succeeded in the twin and as recorded. Twin: the plan actually sent,
    replayed with physics.
agreement | Agreement over groups | agreement.[!sv]* agreement.spearman_rho decision.* |  | scatter
    Whether the twin's rates move with the recorded ones, and how far off they are. A high r
    does not show that the right decision follows, nor that there is no bias.
comparisons | Which is better |  | comparisons standing
    Policies, and each without and with replanning, as recorded.
gate | Trial by trial: twin and outcome | agreement.sim_planned.* agreement.verdict* baseline.* | confusion attribution
    What the twin said of each plan against how it ended, and what obeying it costs and avoids.
raters | Other raters |  | raters
    How far raters of the same trials agree.
stages | Where trials fail |  | funnel failures
    Which stage ends a trial, and what failed first on each side.
motion | Motions | motion.* | motion* end_points_*
    How far the recorded robot lies from the replayed one: planned tells about the controller,
    executed about kinematics and calibration.
states | Predicted states |  | final_states
    How far from where they were predicted objects were localised.
views | Images | views.* | views* image*
    Rendered against held-out recorded images. No value stands without its protocol: it is in
    the definition of each number in results.json.
"""  # noqa: E501
"""One section each: id, title, numbers, tables, figures; and what it leads in with."""


def _section(text: str) -> Section:
    head, _, lead = text.partition("\n")
    id_, title, *names = (part.strip() for part in head.split("|"))
    numbers, tables, figures = (tuple(part.split()) for part in (*names, "", "")[:3])
    return Section(id_, title, " ".join(lead.split()), numbers, tables, figures)


SECTIONS = tuple(map(_section, re.split(r"\n(?=\w)", _TEXT.strip())))

OTHER = Section("other", "More tables", "", tables=("*",))
TRIALS = "trials"
"""The table that is as long as the run; it comes last."""
MOST_TABLES = 12
"""In a report; ``--all`` shows the rest too."""
TABLES: dict[str, str] = {
    "published": "whether a printed number may be quoted",
    "comparisons": "which candidate to use, and whether to run more trials",
    "standing": "which candidates to keep",
    "protocol_departures": "whether the study may be quoted as it was planned",
    "conclusions": "for which task the twin may stand in for the robot",
    "success": "which candidate to use",
    "notes": "what these numbers must not be taken for",
    "trials": "which trial to look at",
    "image_methods": "which reconstruction to use",
    "confusion": "whether the twin's yes may start the robot, and its no may stop it",
    "attribution": "whether to work on what a policy sees, or on the physics",
    "funnel": "on which stage to work",
    "failures": "which cause to remove first",
    "end_points_*": "whether the engine's friction and timing are right",
    "motion": "whether to work on the controller or on the calibration",
    "final_states": "whether the localisation is good enough for the task",
    "views_0": "whether the scene is good enough to look at",
    "raters": "whether the labels can be trusted",
}
"""What each table decides, the most urgent first."""
FIGURES: dict[str, str] = {
    "success": "which candidate to use",
    "scatter": "whether the twin's rates may stand in for recorded ones",
}


def section_of(table_id: str) -> Section:
    """Return the part a table belongs to."""
    matches = (s for s in SECTIONS if any(fnmatchcase(table_id, name) for name in s.tables))
    return next(matches, OTHER)


def numbers_of(
    section: Section, measurements: Sequence[Measurement]
) -> list[tuple[str, Measurement]]:
    """Return (name, measurement) of a part, in the order of the names."""
    by_id = {measurement.id: measurement for measurement in measurements}
    return [
        (name, by_id[id_])
        for id_, name in NAMES.items()
        if id_ in by_id and any(fnmatchcase(id_, pattern) for pattern in section.numbers)
    ]


def shown_tables(results: Results, *, everything: bool = False) -> list[Table]:
    """Return the tables that a report shows, in their own order."""
    if everything:
        return list(results.tables)
    places = {table.id: _place(table.id) for table in results.tables if table.rows}
    ranked = sorted((place, name) for name, place in places.items() if place is not None)
    chosen = {name for _, name in ranked[:MOST_TABLES]}
    return [table for table in results.tables if table.id in chosen]


def _place(table_id: str) -> int | None:
    return next((i for i, name in enumerate(TABLES) if fnmatchcase(table_id, name)), None)


def decides(table_id: str) -> str:
    """Say what a table decides; empty where it only informs."""
    return next((text for name, text in TABLES.items() if fnmatchcase(table_id, name)), "")
