"""``robot-gst calibrate RUN --physics``: everything in order, from the run to the scene."""

from collections.abc import Mapping
from typing import Any

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.terminal import Output
from twin.calibrate.config import CalibrateConfig
from twin.calibrate.physics.data import read_cases
from twin.calibrate.physics.delay import Delay, delay_of, mean_delay
from twin.calibrate.physics.evaluate import Evaluator
from twin.calibrate.physics.fit import FitConfig, fit
from twin.calibrate.physics.local import cloud_size
from twin.calibrate.physics.parameters import rigid_parameters
from twin.calibrate.physics.record import physics_record
from twin.crew.size import default_size
from twin.physics.config import PhysicsConfig
from twin.scene.store.calibration import write_physics


def calibrate_physics(
    run: RunFolder, config: CalibrateConfig, output: Output
) -> tuple[Mapping[str, Any], str]:
    """Find out about physics from a run's probes and trials, and write ``calibration.json``.

    Returns:
        The physics record that was made now, and the id of the calibration that holds now.

    Raises:
        NothingToCalibrateError: No probe or trial can be used.
    """
    cases, skipped = read_cases(run, output)
    physics = PhysicsConfig()
    parameters = rigid_parameters(physics)
    total = config.evaluations + 2 * cloud_size(len(parameters))
    settings = FitConfig(evaluations=config.evaluations, budget_s=config.budget_s, seed=config.seed)
    output.say(
        f"{len(cases)} episodes: "
        + ", ".join(
            f"{sum(case.kind == kind for case in cases)} {kind}"
            for kind in sorted({case.kind for case in cases})
        )
    )
    workers = config.workers or default_size()
    with (
        Evaluator(
            cases, parameters, physics, num_samples=config.samples, workers=workers
        ) as evaluator,
        output.progress("physics", total) as advance,
    ):
        found = fit(
            evaluator,
            parameters,
            settings,
            advance=lambda done, note: advance(min(done, total), note),
        )
    record = physics_record(found, cases, physics, _delay(run), skipped)
    return record, str(write_physics(run, record)["calibration_id"])


def _delay(run: RunFolder) -> Delay | None:
    delays = []
    for path in run.episodes():
        try:
            found = delay_of(Episode.open(path))
        except GstError:
            continue
        if found is not None:
            delays.append(found)
    return mean_delay(delays)
