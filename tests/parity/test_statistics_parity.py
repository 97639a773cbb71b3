"""Our statistics against SciPy's and those of statsmodels."""

import warnings

import numpy as np
import pytest
from scipy import optimize, stats

from evaluator.statistics import agreement
from evaluator.statistics.intervals import wilson
from evaluator.statistics.sequential import Evidence, Stratum

pytestmark = pytest.mark.parity

COUNTS = [(0, 10), (10, 10), (1, 1), (23, 50), (4, 10), (8, 10), (81, 263)]
INSIDE = [(1, 10), (23, 50), (4, 10), (8, 10), (81, 263), (99, 100)]
EXACT = 1e-9


@pytest.mark.parametrize(("k", "n"), COUNTS)
@pytest.mark.parametrize("level", [0.9, 0.95, 0.99])
def test_intervals_agree_with_scipy(k: int, n: int, level: float) -> None:
    theirs = stats.binomtest(k, n).proportion_ci(level, method="wilson")
    mine = wilson(k, n, level=level)
    assert (mine.low, mine.high) == pytest.approx((theirs.low, theirs.high), abs=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_correlations_agree_with_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 12))
    # Few distinct values, so that ties are common.
    recorded, sim = rng.integers(0, 6, n) / 5, rng.integers(0, 6, n) / 5
    if len(set(recorded)) == 1 or len(set(sim)) == 1:
        pytest.skip("a constant side has no correlation")
    x, y = recorded.tolist(), sim.tolist()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", stats.NearConstantInputWarning)
        assert agreement.pearson(x, y) == pytest.approx(stats.pearsonr(x, y)[0], abs=1e-12)
        assert agreement.spearman(x, y) == pytest.approx(stats.spearmanr(x, y)[0], abs=1e-12)


def mmrv_plain(recorded: list[float], sim: list[float]) -> float:
    """Equation 1, written out once more with arrays."""
    R, S = np.array(recorded), np.array(sim)
    gap = np.abs(R[:, None] - R[None, :])
    wrong = (S[:, None] > S[None, :]) != (R[:, None] > R[None, :])
    return float(np.mean(np.max(gap * wrong, axis=1)))


@pytest.mark.parametrize("seed", range(10))
def test_mmrv_agrees_with_equation_1(seed: int) -> None:
    rng = np.random.default_rng(seed)
    recorded, sim = (rng.integers(0, 8, 6) / 8).tolist(), (rng.integers(0, 8, 6) / 8).tolist()
    mine = agreement.mmrv(recorded=recorded, sim=sim)
    assert mine == pytest.approx(mmrv_plain(recorded, sim))
    swapped = agreement.mmrv(recorded=recorded, sim=sim, gap="sim")
    assert swapped == pytest.approx(mmrv_plain(sim, recorded))


@pytest.mark.parametrize(("k", "n"), INSIDE)
@pytest.mark.parametrize("level", [0.9, 0.95])
def test_rate_intervals_agree_with_statsmodels(k: int, n: int, level: float) -> None:
    proportion = pytest.importorskip("statsmodels.stats.proportion")
    low, high = proportion.proportion_confint(k, n, alpha=1 - level, method="wilson")
    mine = wilson(k, n, level=level)
    assert (mine.low, mine.high) == pytest.approx((low, high), abs=EXACT)


def restricted_score(improved: int, worsened: int, n: int, d: float) -> float:
    """Tango's score with the restricted maximum found by a general optimiser."""
    same = n - improved - worsened

    def minus_log(q: float) -> float:
        p, rest = q + d, 1 - 2 * q - d
        terms = ((improved, p), (worsened, q), (same, rest))
        return -sum(c * np.log(max(v, 1e-300)) for c, v in terms if c)

    low, high = max(0.0, -d), (1 - d) / 2
    found = optimize.minimize_scalar(
        minus_log, bounds=(low, high), method="bounded", options={"xatol": 1e-13}
    )
    variance = (2 * found.x + d - d * d) / n
    return float(((improved - worsened) / n - d) / np.sqrt(variance))


@pytest.mark.parametrize("table", [(5, 1, 20), (12, 9, 43), (3, 8, 15), (40, 20, 160)])
def test_tango_is_where_the_restricted_score_reaches_its_quantile(
    table: tuple[int, int, int],
) -> None:
    improved, worsened, n = table
    stratum = Stratum(improved=improved, worsened=worsened, pairs=n)
    mine = Evidence(strata=(stratum,)).interval()
    z = stats.norm.ppf(0.975)
    for end, wanted in ((mine.low, z), (mine.high, -z)):
        # The optimiser knows its place to about the root of the float spacing.
        assert restricted_score(*table, end) == pytest.approx(wanted, abs=1e-6)
