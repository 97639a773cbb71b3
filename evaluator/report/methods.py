"""A paragraph of methods for a paper, from what was measured, with its BibTeX references.

Only what the results hold is described: a method that was not used is neither said nor cited.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from evaluator.report.tables import latex
from evaluator.result import Results

SOURCES = {
    "run": "recorded trials and their replays in the twin",
    "trials": "a table of trials",
    "rates": "a table of success rates",
    "images": "folders of images",
}


@dataclass(frozen=True, kw_only=True)
class Reference:
    """One entry of the bibliography."""

    kind: str
    fields: Mapping[str, str]

    def bibtex(self, key: str) -> str:
        """Write the entry under its key."""
        lines = [f"  {name} = {{{value}}}," for name, value in self.fields.items()]
        return "\n".join((f"@{self.kind}{{{key},", *lines, "}"))


def _article(author: str, title: str, journal: str, year: int, **more: str) -> Reference:
    fields = {"author": author, "title": title, "journal": journal, "year": str(year), **more}
    return Reference(kind="article", fields=fields)


REFERENCES: dict[str, Reference] = {
    "wilson1927": _article(
        "Wilson, Edwin B.",
        "Probable Inference, the Law of Succession, and Statistical Inference",
        "Journal of the American Statistical Association",
        1927,
        volume="22",
        pages="209--212",
    ),
    "clopper1934": _article(
        "Clopper, C. J. and Pearson, E. S.",
        "The Use of Confidence or Fiducial Limits Illustrated in the Case of the Binomial",
        "Biometrika",
        1934,
        volume="26",
        pages="404--413",
    ),
    "brown2001": _article(
        "Brown, Lawrence D. and Cai, T. Tony and DasGupta, Anirban",
        "Interval Estimation for a Binomial Proportion",
        "Statistical Science",
        2001,
        volume="16",
        pages="101--133",
    ),
    "tango1998": _article(
        "Tango, Toshiro",
        "Equivalence Test and Confidence Interval for the Difference in Proportions for the "
        "Paired-Sample Design",
        "Statistics in Medicine",
        1998,
        volume="17",
        pages="891--908",
    ),
    "newcombe1998": _article(
        "Newcombe, Robert G.",
        "Interval Estimation for the Difference Between Independent Proportions: Comparison of "
        "Eleven Methods",
        "Statistics in Medicine",
        1998,
        volume="17",
        pages="873--890",
    ),
    "mcnemar1947": _article(
        "McNemar, Quinn",
        "Note on the Sampling Error of the Difference Between Correlated Proportions or "
        "Percentages",
        "Psychometrika",
        1947,
        volume="12",
        pages="153--157",
    ),
    "fagerland2013": _article(
        "Fagerland, Morten W. and Lydersen, Stian and Laake, Petter",
        "The {McNemar} Test for Binary Matched-Pairs Data: Mid-p and Asymptotic Are Better Than "
        "Exact Conditional",
        "BMC Medical Research Methodology",
        2013,
        volume="13",
        pages="91",
    ),
    "boschloo1970": _article(
        "Boschloo, R. D.",
        "Raised Conditional Level of Significance for the 2 x 2-Table When Testing the Equality "
        "of Two Probabilities",
        "Statistica Neerlandica",
        1970,
        volume="24",
        pages="1--9",
    ),
    "li2024": _article(
        "Li, Xuanlin and Hsu, Kyle and Gu, Jiayuan and others",
        "Evaluating Real-World Robot Manipulation Policies in Simulation",
        "arXiv preprint arXiv:2405.05941",
        2024,
    ),
    "simpson1951": _article(
        "Simpson, E. H.",
        "The Interpretation of Interaction in Contingency Tables",
        "Journal of the Royal Statistical Society, Series B",
        1951,
        volume="13",
        pages="238--241",
    ),
    "brier1950": _article(
        "Brier, Glenn W.",
        "Verification of Forecasts Expressed in Terms of Probability",
        "Monthly Weather Review",
        1950,
        volume="78",
        pages="1--3",
    ),
    "waudbysmith2024": _article(
        "Waudby-Smith, Ian and Ramdas, Aaditya",
        "Estimating Means of Bounded Random Variables by Betting",
        "Journal of the Royal Statistical Society, Series B",
        2024,
        volume="86",
        pages="1--27",
    ),
    "wang2004": _article(
        "Wang, Zhou and Bovik, Alan C. and Sheikh, Hamid R. and Simoncelli, Eero P.",
        "Image Quality Assessment: From Error Visibility to Structural Similarity",
        "IEEE Transactions on Image Processing",
        2004,
        volume="13",
        pages="600--612",
    ),
    "firth1993": _article(
        "Firth, David",
        "Bias Reduction of Maximum Likelihood Estimates",
        "Biometrika",
        1993,
        volume="80",
        pages="27--38",
    ),
    "cohen1960": _article(
        "Cohen, Jacob",
        "A Coefficient of Agreement for Nominal Scales",
        "Educational and Psychological Measurement",
        1960,
        volume="20",
        pages="37--46",
    ),
}

INTERVALS = {
    "wilson": ("Wilson's score method", "wilson1927"),
    "clopper-pearson": ("the exact method of Clopper and Pearson", "clopper1934"),
    "jeffreys": ("Jeffreys' method", "brown2001"),
    "tango": ("Tango's score method for paired differences", "tango1998"),
    "newcombe-10": ("Newcombe's method 10 for unpaired differences", "newcombe1998"),
    "betting": ("a betting confidence sequence, valid at any time", "waudbysmith2024"),
}
"""By method of an interval: its words and reference."""
USED: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    (
        "agreement.pearson_r",
        "Agreement over groups is Pearson's r of the two rates, computed from exact counts, beside "
        "the bias (sim minus recorded)",
        (),
    ),
    (
        "agreement.mmrv_recorded_gap",
        "rank violations are the mean maximum rank violation, weighted by the gap of recorded "
        "rates",
        ("li2024",),
    ),
    (
        "agreement.model.*",
        "headline intervals of r and bias are those of a hierarchical binomial model of all "
        "counts, which removes the noise of counting",
        (),
    ),
    (
        "agreement.model.opposed",
        "within-task and between-task correlation are reported apart",
        ("simpson1951",),
    ),
    (
        "paired.mcnemar_p_mid.*",
        "paired starts are tested by McNemar's mid-p test",
        ("mcnemar1947", "fagerland2013"),
    ),
    (
        "unpaired.boschloo_p.*",
        "unpaired conditions are tested by Boschloo's exact test",
        ("boschloo1970",),
    ),
    ("reliability.brier", "stated probabilities are scored by Brier's score", ("brier1950",)),
    ("views.all.ssim", "images are compared by PSNR and SSIM", ("wang2004",)),
)
"""Ids that say that a method was used, its words and references."""
TABLES = {
    "sensitivity": (
        "factors of failure and of disagreement are estimated jointly by Firth's penalised "
        "logistic regression",
        ("firth1993",),
    ),
    "raters": ("agreement of raters is Cohen's kappa", ("cohen1960",)),
}
"""The same of tables."""


def methods(results: Results) -> tuple[str, str]:
    r"""Return a LaTeX paragraph of methods and the BibTeX entries that it cites.

    The paragraph cites with ``\cite``; it says how many groups and trials, from what, which
    intervals and tests, and the version of the program.

    Args:
        results: What was measured.
    """
    cited: dict[str, None] = {}

    def cite(keys: Sequence[str]) -> str:
        cited.update(dict.fromkeys(keys))
        return rf"~\cite{{{','.join(keys)}}}" if keys else ""

    source = SOURCES.get(results.source, results.source)
    parts = [f"{_counts(results)} were evaluated from {source}{_stand_in(results)}"]
    names = {m.interval.method for m in results.measurements if m.interval is not None}
    found = [(words, key) for name, (words, key) in INTERVALS.items() if name in names]
    if found:
        listed = [f"{latex(words)}{cite((key,))}" for words, key in found]
        parts.append(f"Intervals are two-sided at 95 \\% by {_joined(listed)}")
    used = list(_used(results))
    parts += [f"{latex(words[0].upper() + words[1:])}{cite(keys)}" for words, keys in used]
    software = results.provenance.get("software")
    if isinstance(software, Mapping):
        told = f"{software.get('name', 'robot-gst')} {software.get('version', '')}".strip()
        commit = str(software.get("git_commit") or "")[:12]
        parts.append(f"Computed by {latex(told)}" + (f", commit {commit}" if commit else ""))
    bib = "\n\n".join(REFERENCES[key].bibtex(key) for key in sorted(cited))
    return ". ".join(parts) + ".\n", bib + "\n" if bib else ""


def _counts(results: Results) -> str:
    by_id = {m.id: m for m in results.measurements}
    r = by_id.get("agreement.pearson_r")
    pairs = by_id.get("agreement.sim_planned.rate")
    parts = []
    if r is not None and r.n:
        parts.append(f"{r.n} groups (task, policy, condition)")
    if pairs is not None and pairs.n:
        parts.append(f"{pairs.n} trials with a recorded and a simulated outcome")
    return " of ".join(parts) or "The data"


def _stand_in(results: Results) -> str:
    return "; the recorded side is a simulated laboratory" if results.stand_in else ""


def _used(results: Results) -> Iterator[tuple[str, Sequence[str]]]:
    ids = [m.id for m in results.measurements if m.value is not None]
    for pattern, words, keys in USED:
        if any(fnmatchcase(name, pattern) for name in ids):
            yield words, keys
    there = {table.id for table in results.tables}
    for name, (words, keys) in TABLES.items():
        if name in there:
            yield words, keys


def _joined(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
