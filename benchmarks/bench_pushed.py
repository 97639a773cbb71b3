"""Friction x weight of objects that were pushed once each, and their friction after a lift.

The protocol. 20 cubes of ``push_cube_to_mark`` in the stand-in cell, each in a laboratory of its
own and pushed once as the task says. Masses lie evenly on a logarithm from 50 g to 1 kg, shuffled;
frictions on the table are even from 0.10 to 0.50, as this task has them in ``lab``. Seeds are
5420000 to 5420019, none looked at before; every push counts. The twin reads the episode alone, no
truth, no image. A lift is a mass known to 2 %, off as drawn from the seed. To reach: 18 of 20
intervals hold the truth, half of one is 20 % of its value in the median; "not determined" holds
nothing, without end. Settings were chosen on seeds 1000000 to 1000023.
"""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from bench_held_mass import answer, one_trial
from measure import Target, report_targets

from twin.calibrate.weights import share_masses, together

FIRST, COUNT, TASK, LIFTED, G = 5_420_000, 20, "push_cube_to_mark", 0.02, 9.81


def main() -> None:
    """Measure, print and store."""
    rng, rows, targets = np.random.default_rng(FIRST), list[dict[str, Any]](), []
    masses, frictions = rng.permutation(np.geomspace(0.05, 1, COUNT)), rng.uniform(0.1, 0.5, COUNT)
    with tempfile.TemporaryDirectory() as folder:
        for seed, (kg, mu) in enumerate(
            zip(masses.tolist(), frictions.tolist(), strict=True), FIRST
        ):
            episode, task, _ = one_trial(Path(folder), "standin", seed, TASK, kg, mu)
            row, cube = answer(episode, task), task.manipulated[0]
            lifted_kg = kg * float(np.exp(LIFTED * np.random.default_rng(seed).standard_normal()))
            found = {TASK: {cube: {"value": lifted_kg, "sigma_log": LIFTED, "why": ""}}}
            if "drag_N" in row:
                found[TASK][cube]["drag"] = together([row], "drag_N")
                share_masses({TASK: task}, found)
            true = {"seed": seed, "mass_kg": kg, "drag": kg * mu * G, "friction": mu}
            rows.append({**true, "said": found[TASK][cube], "why": row.get("why", "")})
    for name in ("drag", "friction"):
        said = [(row[name], row["said"].get(name, {})) for row in rows]
        held = sum(x.get("low", np.inf) <= true <= x.get("high", -np.inf) for true, x in said)
        halves = [(x["high"] - x["low"]) / 2 / x["value"] if x else np.inf for _, x in said]
        targets += [Target(what=f"{name}: hold", measured=held, limit=18, at_most=False)]
        targets += [Target(what=f"{name}: half", measured=float(np.median(halves)), limit=0.2)]
    report_targets("pushed", targets, note="20 cubes of 50 g to 1 kg, a push each", rows=rows)


if __name__ == "__main__":
    main()
