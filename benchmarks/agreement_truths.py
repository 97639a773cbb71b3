"""True success rates on which the model of agreement is judged, fixed before the first result.

Every truth draws groups: a recorded rate and the twin's. Judged is whether an interval holds the
correlation and the mean difference of the rates of the population that the groups come from: of new
tasks and policies, too, where groups are tasks x policies. Seventeen truths, each with 8, 12 and 28
groups (4 x 2, 4 x 3, 7 x 4) of 10 and 20 recorded trials, half of the studies with as many trials
of the twin and half with ten times as many; the seed is [truth, groups, trials, factor, 1].
Success: the least coverage over the 102 cells (truth, groups, trials) is at least 93 %. How the
tails of r are divided was chosen on other seeds, [991, truth, groups, trials, factor], and once
more after a first choice had held 91.5 % in the worst of the cells seen on [truth, ..., factor].
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.special import expit, logit, ndtr
from scipy.stats import beta

NUM_GROUPS = {8: (4, 2), 12: (4, 3), 28: (7, 4)}
"""Number of groups, and as how many tasks and policies where these are crossed."""
NUM_TRIALS = (10, 20)
SIM_FACTORS = (1, 10)
BLIND = 0.2
"""Share of groups in which a blind twin says nothing of what is recorded."""
Rates = Float64[np.ndarray, "studies groups"]
Sides = tuple[Rates, Rates]
Draw = Callable[[np.random.Generator, int, int], Sides]
Curve = Callable[[np.ndarray], np.ndarray]


def _beta(a: float, b: float) -> Curve:
    shares = np.linspace(0, 1, 4001)
    rates = beta.ppf(shares, a, b)
    return lambda u: np.interp(u, shares, rates)


def _zeros(part: float) -> Curve:
    above = _beta(1, 2)
    return lambda u: np.where(u < part, 0.0, above(np.clip((u - part) / (1 - part), 0, 1)))


def _levels(top: float) -> Curve:
    return lambda u: np.where(u < 0.5, 0.1, top - 0.1) + 0.1 * np.where(u < 0.5, 2 * u, 2 * u - 1)


def _normal(
    rng: np.random.Generator, shape: tuple[int, ...], rho: float
) -> Float64[np.ndarray, "*shape 2"]:
    found = rng.standard_normal((*shape, 2))
    found[..., 1] = rho * found[..., 0] + np.sqrt(1 - rho**2) * found[..., 1]
    return found


def _copula(recorded: Curve, sim: Curve, rho: float) -> Draw:
    def draw(rng: np.random.Generator, studies: int, groups: int) -> Sides:
        share = ndtr(_normal(rng, (studies, groups), rho))
        return recorded(share[..., 0]), sim(share[..., 1])

    return draw


def with_blind(
    said: Curve, share: float, rng: np.random.Generator, shape: tuple[int, int], crossed: bool
) -> tuple[Rates, Rates, Bool[np.ndarray, "studies groups"]]:
    """A twin that follows closely, but in some groups says something else; and in which."""
    x = CROSSED_RATES(rng, *shape)[0] if crossed else _beta(1.2, 1.2)(rng.random(shape))
    noise = 0.3 + 0.4 * rng.standard_normal(shape)
    y = expit(logit(np.clip(x, 0.002, 0.998)) + noise)
    blind = rng.random(shape) < share
    return x, np.where(blind, said(rng.random(shape)), y), blind


def _blind(said: Curve) -> Draw:
    return lambda rng, studies, groups: with_blind(said, BLIND, rng, (studies, groups), False)[:2]


def _crossed(of_tasks: float, of_policies: float, of_cells: float) -> Draw:
    """Effects of tasks, of policies and of both together, each with its own correlation."""

    def draw(rng: np.random.Generator, studies: int, groups: int) -> Sides:
        tasks, policies = NUM_GROUPS.get(groups, (1, 1))
        effects = 0.9 * _normal(rng, (studies, tasks, 1), of_tasks)
        effects = effects + 0.6 * _normal(rng, (studies, 1, policies), of_policies)
        effects = effects + 0.4 * _normal(rng, (studies, tasks, policies), of_cells)
        rates = expit(1.3 * effects).reshape(studies, groups, 2)
        return rates[..., 0], rates[..., 1]

    return draw


def _same(rng: np.random.Generator, studies: int, groups: int) -> Sides:
    x = _beta(0.8, 0.8)(rng.random((studies, groups)))
    return x, x


CROSSED_RATES = _crossed(0.7, 0.7, 0.3)
SAID: dict[str, Curve] = {
    "yes": lambda u: 0.85 + 0.15 * u,
    "no": lambda u: 0.1 * u,
    "anything": lambda u: u,
}
MIDDLING = (_beta(2, 2), _beta(2.5, 2))
TRUTHS: dict[str, Draw] = {
    "middling, rho 0": _copula(*MIDDLING, 0.0),
    "middling, rho 0.6": _copula(*MIDDLING, 0.6),
    "middling, rho 0.95": _copula(*MIDDLING, 0.95),
    "U-shaped, rho 0.6": _copula(_beta(0.4, 0.4), _beta(0.5, 0.4), 0.6),
    "U-shaped, rho 0.95": _copula(_beta(0.4, 0.4), _beta(0.5, 0.4), 0.95),
    "full of zeros": _copula(_zeros(0.4), _zeros(0.3), 0.6),
    "two levels": _copula(_levels(0.8), _levels(0.9), 0.6),
    **{f"blind fifth says {words}": _blind(said) for words, said in SAID.items()},
    "tasks x policies": CROSSED_RATES,
    "tasks x policies, opposed": _crossed(0.9, -0.3, 0.0),
    "ceiling": _copula(_beta(8, 1.5), _beta(9, 1.2), 0.6),
    "all alike": _copula(lambda u: 0.46 + 0.08 * u, lambda u: 0.5 + 0.1 * u, 0.6),
    "unequal n": _copula(*MIDDLING, 0.6),
    "the twin is right": _same,
    "the twin turns it round": _copula(*MIDDLING, -0.8),
}
CROSSED = ("tasks x policies", "tasks x policies, opposed")
UNEQUAL = "unequal n"
"""Groups of half, once and three times as many trials."""


def population(name: str, many: int = 1_000_000) -> tuple[float, float]:
    """Return the correlation of both rates over the population, and the mean difference."""
    rng = np.random.default_rng(7)
    size = (many, 1) if name in CROSSED else (1, many)
    x, y = (side.ravel() for side in TRUTHS[name](rng, *size))
    return float(np.corrcoef(x, y)[0, 1]), float((y - x).mean())


Counts = Int64[np.ndarray, "studies groups"]


def studies(
    name: str, groups: int, trials: int, factor: int, many: int
) -> tuple[Counts, Counts, Counts, Counts]:
    """Draw studies: successes and trials as recorded, and the twin's."""
    rng = np.random.default_rng([list(TRUTHS).index(name), groups, trials, factor, 1])
    x, y = TRUTHS[name](rng, many, groups)
    n = np.full(x.shape, trials)
    if name == UNEQUAL:
        n = rng.choice([trials // 2, trials, 3 * trials], size=x.shape)
    return rng.binomial(n, x), n, rng.binomial(factor * n, y), factor * n
