"""Write ``ppi_reference.json``: what ppi-python gives, for tests that run without it.

Run in an environment of its own with ``pip install ppi-python==0.2.3``: its wheel installs a
package named ``tests``, so it has no place in this project's environment.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

PATH = Path(__file__).with_name("ppi_reference.json")


def sample(seed: int) -> tuple[list[bool], list[float], list[float]]:
    """Draw outcomes of robot trials, what the twin said of them, and of further starts."""
    rng = np.random.default_rng(seed)
    real = rng.random(120) < 0.6
    said = np.where(rng.random(120) < 0.6 + 0.06 * seed, real, ~real).astype(float)
    alone = (rng.random(300 * (seed + 1)) < 0.58).astype(float)
    return real.tolist(), said.tolist(), alone.tolist()


def main() -> None:
    """Ask ppi-python about six samples."""
    import ppi_py

    cases: list[dict[str, Any]] = []
    for seed in range(6):
        real, said, alone = (np.array(side, dtype=float) for side in sample(seed))
        point = ppi_py.ppi_mean_pointestimate(real, said, alone)
        low, high = ppi_py.ppi_mean_ci(real, said, alone, alpha=0.05)
        values = {"value": point, "low": low, "high": high}
        cases.append({"seed": seed, **{k: float(np.squeeze(v)) for k, v in values.items()}})
    PATH.write_text(json.dumps({"ppi-python": "0.2.3", "cases": cases}, indent=1) + "\n")


if __name__ == "__main__":
    main()
