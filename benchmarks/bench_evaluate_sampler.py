"""The posterior of the model of agreement, once by its quadrature and once by a sampler.

The sampler shares no code with the evaluator: Metropolis steps for the log-odds of groups and for
spreads and correlations, exact draws of means, many chains at once. Spreads also move together with
what they spread (Yu and Meng 2011), without which few trials leave the chains where they are.
Written down are the posterior
means of both, and their difference in posterior standard deviations beside the sampler's own error.
"""

import os
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from measure import ROOT, Target, report_targets
from scipy.special import expit, ndtri

from evaluator.statistics.group_likelihood import GroupCounts
from evaluator.statistics.hierarchical import AgreementModel

FULL_SWEEPS = 10_000
SWEEPS = int(os.environ.get("SAMPLER_SWEEPS", FULL_SWEEPS))
CHAINS = 400
ERROR = "error of the sampler in sd"
MEAN_SD, SPREAD, ALIKE = 2.5, 2.5, 0.5
HEAVY = 5.0
"""Degrees of freedom of what proposes log-odds anew."""
if SWEEPS != FULL_SWEEPS:
    os.environ.setdefault("GST_BENCH_RESULTS", str(ROOT / "build" / "quick_results"))

STUDIES: dict[str, list[tuple[str, int, int, int, int]]] = {
    "eight tasks, unequal n": [
        ("a", 3, 10, 30, 50), ("b", 9, 10, 44, 50), ("c", 0, 10, 6, 50), ("d", 6, 10, 29, 50),
        ("e", 12, 20, 41, 50), ("f", 19, 20, 50, 50), ("g", 2, 20, 9, 50), ("h", 5, 5, 40, 50),
    ],
    "four tasks of three policies": [
        ("a", 3, 10, 4, 10), ("a", 6, 10, 8, 10), ("a", 9, 10, 9, 10),
        ("b", 0, 10, 2, 10), ("b", 2, 10, 3, 10), ("b", 5, 10, 4, 10),
        ("c", 7, 10, 6, 10), ("c", 8, 10, 9, 10), ("c", 10, 10, 10, 10),
        ("d", 1, 10, 5, 10), ("d", 4, 10, 5, 10), ("d", 5, 10, 8, 10),
    ],
}  # fmt: skip
"""Task, successes and trials as recorded, and in the twin."""


@dataclass(kw_only=True)
class State:
    """Where all chains are."""

    theta: np.ndarray
    """Log-odds (chains, groups, sides)."""
    centre: np.ndarray
    """Means of tasks (chains, tasks, sides); the overall mean alone without shared tasks."""
    mean: np.ndarray
    within: np.ndarray
    """Logarithms of both spreads, and the arcsine of the correlation."""
    between: np.ndarray
    shared: bool
    """Whether groups share tasks: then both correlations are alike beforehand."""


def normal_log(off: np.ndarray, spread: np.ndarray, more: float) -> np.ndarray:
    """Log density of pairs (chains, many, 2) summed over the many, up to a constant."""
    s, t = np.exp(2 * spread[:, 0]) + more, np.exp(2 * spread[:, 1]) + more
    c = np.sin(spread[:, 2]) * np.exp(spread[:, 0] + spread[:, 1])
    det = s * t - c * c
    xx, yy, xy = (off[..., 0] ** 2).sum(1), (off[..., 1] ** 2).sum(1), off.prod(-1).sum(1)
    return np.asarray(
        -0.5 * (t * xx + s * yy - 2 * c * xy) / det - 0.5 * off.shape[1] * np.log(det)
    )


def spread_log(spread: np.ndarray) -> np.ndarray:
    """Log prior: half-normal spreads on their logarithm, a uniform arcsine of rho."""
    sizes = np.exp(spread[:, :2])
    return np.asarray((spread[:, :2] - 0.5 * sizes**2 / SPREAD**2).sum(1))


def prior_log(state: State, which: str, spread: np.ndarray) -> np.ndarray:
    """Log prior of one level's spread, given the other's: a normal copula of both angles."""
    found = spread_log(spread)
    if not state.shared:
        return found
    other = state.between if which == "within" else state.within
    z, o = (ndtri(each[:, 2] / np.pi + 0.5) for each in (spread, other))
    return np.asarray(
        found - 0.5 * (z**2 + o**2 - 2 * ALIKE * z * o) / (1 - ALIKE**2) + 0.5 * (z**2 + o**2)
    )


def matrix(spread: np.ndarray, more: float) -> np.ndarray:
    """Covariance of each chain."""
    size = np.exp(spread[:, :2])
    found = size[:, :, None] * size[:, None, :]
    found[:, 0, 1] *= np.sin(spread[:, 2])
    found[:, 1, 0] *= np.sin(spread[:, 2])
    return np.asarray(found + more * np.eye(2))


def gauss(precision: np.ndarray, pull: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw from the normal distribution with these natural parameters (chains, many, 2)."""
    cov = np.linalg.inv(precision)
    mean = np.einsum("...ij,...j->...i", cov, pull)
    return np.asarray(
        mean
        + np.einsum("...ij,...j->...i", np.linalg.cholesky(cov), rng.standard_normal(mean.shape))
    )


def sample(study: list[tuple[str, int, int, int, int]], more: float) -> np.ndarray:
    """Return draws (sweeps, chains, quantities): both means, rho within, rho between, mean gap.

    Args:
        more: Variance that the model adds to the spread within tasks.
    """
    rng = np.random.default_rng(7)
    names = list(dict.fromkeys(row[0] for row in study))
    shared = len(names) < len(study)
    task = np.array([names.index(row[0]) if shared else 0 for row in study])
    member = (task[None, :] == np.arange(task.max() + 1)[:, None]).astype(float)
    k = np.array([[row[1], row[3]] for row in study], dtype=float)
    n = np.array([[row[2], row[4]] for row in study], dtype=float)
    first = np.log((k + 0.5) / (n - k + 0.5))
    state = State(
        theta=first + 0.3 * rng.standard_normal((CHAINS, *first.shape)),
        centre=np.zeros((CHAINS, len(member), 2)),
        mean=np.zeros((CHAINS, 2)),
        within=0.3 * rng.standard_normal((CHAINS, 3)),
        between=0.3 * rng.standard_normal((CHAINS, 3)),
        shared=shared,
    )
    found = []
    for sweep in range(SWEEPS):
        step_rates(state, k, n, task, more, rng)
        step_rates_far(state, k, n, task, more, rng)
        step_means(state, member, shared, more, rng)
        for _ in range(2):
            step_spread(state, state.theta - state.centre[:, task], "within", more, rng)
            if shared:
                step_spread(state, state.centre - state.mean[:, None], "between", 1e-4, rng)
        step_together(state, k, n, task, "within", more, rng)
        if shared:
            step_together(state, k, n, task, "between", 1e-4, rng)
        if sweep >= SWEEPS // 5:
            rates = expit(state.theta)
            gap = (rates[..., 1] - rates[..., 0]).mean(1)
            rho = np.sin(state.within[:, 2]), np.sin(state.between[:, 2])
            found.append(np.stack([*state.mean.T, rho[0], rho[1], gap], axis=-1))
    return np.array(found)


def step_rates(
    state: State,
    k: np.ndarray,
    n: np.ndarray,
    task: np.ndarray,
    more: float,
    rng: np.random.Generator,
) -> None:
    """Move the log-odds of every group."""
    inverse = np.linalg.inv(matrix(state.within, more))
    centre = state.centre[:, task]

    def log(theta: np.ndarray) -> np.ndarray:
        off = theta - centre
        prior = -0.5 * np.einsum("cgi,cij,cgj->cg", off, inverse, off)
        return np.asarray((k * theta - n * np.logaddexp(0, theta)).sum(-1) + prior)

    scale = rng.choice([0.3, 1.0, 2.5], size=(*state.theta.shape[:2], 1))
    moved = state.theta + scale * rng.standard_normal(state.theta.shape)
    accept = np.log(rng.random(moved.shape[:2])) < log(moved) - log(state.theta)
    state.theta = np.where(accept[..., None], moved, state.theta)


def step_rates_far(
    state: State,
    k: np.ndarray,
    n: np.ndarray,
    task: np.ndarray,
    more: float,
    rng: np.random.Generator,
) -> None:
    """Draw the log-odds of every group anew, about where counts and the others put them."""
    inverse = np.linalg.inv(matrix(state.within, more))
    centre = state.centre[:, task]
    noise = 1 / (k + 0.5) + 1 / (n - k + 0.5)
    precision = inverse[:, None] + np.eye(2) / noise[:, None, :]
    pull = np.einsum("cij,cgj->cgi", inverse, centre) + np.log((k + 0.5) / (n - k + 0.5)) / noise
    cov = np.linalg.inv(precision)
    middle = np.einsum("cgij,cgj->cgi", cov, pull)
    chol = np.linalg.cholesky(1.3 * cov)
    stretch = np.sqrt(HEAVY / rng.chisquare(HEAVY, (*middle.shape[:2], 1)))
    moved = middle + np.einsum("cgij,cgj->cgi", chol, rng.standard_normal(middle.shape) * stretch)

    def log(theta: np.ndarray) -> np.ndarray:
        off = theta - centre
        prior = -0.5 * np.einsum("cgi,cij,cgj->cg", off, inverse, off)
        away = theta - middle
        far = np.einsum("cgi,cgij,cgj->cg", away, precision, away) / 1.3
        here = (k * theta - n * np.logaddexp(0, theta)).sum(-1) + prior
        return np.asarray(here + (HEAVY + 2) / 2 * np.log1p(far / HEAVY))

    accept = np.log(rng.random(moved.shape[:2])) < log(moved) - log(state.theta)
    state.theta = np.where(accept[..., None], moved, state.theta)


def step_means(
    state: State, member: np.ndarray, shared: bool, more: float, rng: np.random.Generator
) -> None:
    """Draw the means of tasks, and the overall one."""
    inner = np.linalg.inv(matrix(state.within, more))
    prior = np.eye(2) / MEAN_SD**2
    sums = np.einsum("tg,cgi->cti", member, state.theta)
    if not shared:
        total = prior + len(member[0]) * inner
        state.mean = gauss(total, np.einsum("cij,cj->ci", inner, sums[:, 0]), rng)
        state.centre = state.mean[:, None]
        return
    outer = np.linalg.inv(matrix(state.between, 1e-4))
    precision = outer[:, None] + member.sum(1)[None, :, None, None] * inner[:, None]
    pull = np.einsum("cij,ctj->cti", inner, sums)
    pull += np.einsum("cij,cj->ci", outer, state.mean)[:, None]
    state.centre = gauss(precision, pull, rng)
    total = prior + len(member) * outer
    state.mean = gauss(total, np.einsum("cij,cj->ci", outer, state.centre.sum(1)), rng)


def moved_from(now: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Propose spreads and correlations; an angle beyond its end comes back from there."""
    size = rng.choice([0.1, 0.3, 1.0], size=(CHAINS, 1))
    moved = now + size * rng.standard_normal(now.shape)
    half = np.pi / 2
    moved[:, 2] = half - np.abs((moved[:, 2] + half) % (4 * half) - 2 * half)
    return np.asarray(moved)


def step_spread(
    state: State, off: np.ndarray, which: str, more: float, rng: np.random.Generator
) -> None:
    """Move spreads and correlation of one level."""
    now = getattr(state, which)
    moved = moved_from(now, rng)
    gain = normal_log(off, moved, more) + prior_log(state, which, moved)
    gain -= normal_log(off, now, more) + prior_log(state, which, now)
    accept = np.log(rng.random(CHAINS)) < gain
    setattr(state, which, np.where(accept[:, None], moved, now))


def step_together(
    state: State,
    k: np.ndarray,
    n: np.ndarray,
    task: np.ndarray,
    which: str,
    more: float,
    rng: np.random.Generator,
) -> None:
    """Move spreads and correlation of one level, and what they spread in the same proportion."""
    now = getattr(state, which)
    moved = moved_from(now, rng)
    turn = np.linalg.cholesky(matrix(moved, more)) @ np.linalg.inv(
        np.linalg.cholesky(matrix(now, more))
    )
    of_tasks = which == "between"
    middle = state.mean[:, None] if of_tasks else state.centre[:, task]
    off = (state.centre if of_tasks else state.theta) - middle
    change = np.einsum("cij,cgj->cgi", turn, off) - off
    theta = state.theta + (change[:, task] if of_tasks else change)

    def log(rates: np.ndarray) -> np.ndarray:
        return np.asarray((k * rates - n * np.logaddexp(0, rates)).sum((1, 2)))

    gain = log(theta) - log(state.theta)
    gain += prior_log(state, which, moved) - prior_log(state, which, now)
    accept = np.log(rng.random(CHAINS)) < gain
    setattr(state, which, np.where(accept[:, None], moved, now))
    state.theta = np.where(accept[:, None, None], theta, state.theta)
    if of_tasks:
        state.centre = np.where(accept[:, None, None], state.centre + change, state.centre)


def main() -> None:
    """Compare, print and store."""
    began = time.process_time()
    details: dict[str, Any] = {}
    targets = []
    for name, study in STUDIES.items():
        groups = [GroupCounts(recorded=(a, b), sim=(c, d), task=task) for task, a, b, c, d in study]
        model = AgreementModel(groups)
        more = (model.likelihood.step / 2) ** 2
        draws = sample(study, more)
        ours = {
            "mean recorded log-odds": model.of_nodes(model.nodes.mean[:, 0]).mean,
            "mean sim log-odds": model.of_nodes(model.nodes.mean[:, 1]).mean,
            "rho within": model.within.mean,
            "rho between": model.between.mean if model.in_tasks else None,
            "mean gap of these groups": float(model.draws.gap.mean()),
        }
        rows: dict[str, Any] = {}
        for place, (what, value) in enumerate(ours.items()):
            if value is None:
                continue
            mean, sd = float(draws[..., place].mean()), float(draws[..., place].std())
            error = float(draws[..., place].mean(0).std(ddof=1) / np.sqrt(CHAINS))
            rows[what] = {
                "quadrature": value, "sampler": mean, "sd": sd,
                "difference in sd": abs(value - mean) / sd, ERROR: error / sd,
            }  # fmt: skip
        details[name] = {"groups": study, "posterior": rows}
        targets.append(
            Target(
                what=f"largest difference of a posterior mean, {name}",
                measured=max(row["difference in sd"] for row in rows.values()),
                limit=0.01,
                unit="sd",
                reference=f"sampler {max(r[ERROR] for r in rows.values()):.3f} sd",
            )
        )
    report_targets(
        "evaluate_sampler",
        targets,
        note=f"{CHAINS} chains of {SWEEPS} sweeps, a fifth thrown away",
        cpu_seconds=round(time.process_time() - began, 1),
        studies=details,
    )


if __name__ == "__main__":
    main()
