"""Where held-out probes settled: predicted, localised, and in truth.

A twin that is judged against localised poses is judged with their noise. Truth has none, but no
frame in common with the twin: cameras are millimetres from where the cell believes them to be, and
so are the fingers. Neither can be found by a twin that looks through the one and moves the other.
Hence three comparisons, all in the plane of the table:

- ``localised``: predicted in the cameras' frame, against the localised pose.
- ``shifted``: the same, against truth moved by what the cameras are off on average over every
  localisation of the run, before and after each probe. Localisation without its noise.
- ``truth``: predicted in the robot's frame, as replays live (localised poses plus the bias that was
  found), against truth. It holds what the robot's joints are off, which nobody can find.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import TRUTH, object_topic
from bridge.terminal import Output
from twin.calibrate.physics.cases import Case, planar, read_cases
from twin.calibrate.physics.parameters import BIAS
from twin.calibrate.physics.simulate import predict
from twin.physics.config import PhysicsConfig

COMPARED = {
    "localised": "against localised poses",
    "shifted": "against truth as the cameras see it",
    "truth": "against truth in the robot's frame",
}
SAME_M = 1e-9


def settled_poses(run: RunFolder, row: dict[str, Any]) -> list[dict[str, Any]]:
    """Live the held-out episodes through again, and read the truth beside them.

    Returns:
        Per pose of a held-out episode, in metres: ``true``, ``shifted``, ``localised``; and per set
        of parameters (``nominal``, ``calibrated``) what it predicts in the frame of the cameras
        (``nominal``) and of the robot (``nominal_robot``).

    Raises:
        RuntimeError: The predictions are not those that the calibration was judged by.
    """
    cases, _ = read_cases(run, Output(quiet=True))
    true = [_true_m(run, case) for case in cases]
    seen = [
        pair
        for case, (start, end) in zip(cases, true, strict=True)
        for pair in ((_starts_m(case), start), (case.settled[:, :2], end))
    ]
    shift = np.nanmean(np.concatenate([found - real for found, real in seen]), axis=0)
    found = {name: item["value"] for name, item in row["parameters"].items()}
    sets: dict[str, dict[str, float]] = {"nominal": {}, "calibrated": found}
    rows: list[dict[str, Any]] = []
    for case, (_, end) in zip(cases, true, strict=True):
        if case.episode not in row["held_out"]["episodes"]:
            continue
        settled = {
            label: predict(case, values, PhysicsConfig()).settled[:, :2]
            for label, values in sets.items()
        }
        for k in np.flatnonzero(np.isfinite(case.settled).all(axis=1)):
            pose = {"true": end[k], "shifted": end[k] + shift, "localised": case.settled[k, :2]}
            for label, values in sets.items():
                pose[label] = settled[label][k]
                bias = [values.get(name, 0.0) for name in BIAS[:2]]
                pose[f"{label}_robot"] = settled[label][k] + bias
            told = {key: value.tolist() for key, value in pose.items()}
            rows.append({"episode": case.episode, "kind": case.kind, **told})
    _check_same(rows, row)
    return rows


def errors_m(
    poses: Sequence[dict[str, Any]], compared: str
) -> tuple[Float[np.ndarray, " num_poses"], Float[np.ndarray, " num_poses"]]:
    """Distances on the table with the defaults and calibrated, by a name of ``COMPARED``."""
    ending = "_robot" if compared == "truth" else ""
    against = np.array([pose["true" if compared == "truth" else compared] for pose in poses])
    before, after = (
        np.linalg.norm(np.array([pose[f"{label}{ending}"] for pose in poses]) - against, axis=1)
        for label in ("nominal", "calibrated")
    )
    return before, after


def _true_m(
    run: RunFolder, case: Case
) -> tuple[Float[np.ndarray, "num_objects 2"], Float[np.ndarray, "num_objects 2"]]:
    """Where the objects of a case truly lay at the beginning and at the end of its episode."""
    episode = Episode.open(run.episodes_dir / f"{case.episode}.mcap")
    tracks = [
        streams.pose_track(episode, object_topic(TRUTH, key, "pose")).p_m for key in case.objects
    ]
    return np.array([p[0, :2] for p in tracks]), np.array([p[-1, :2] for p in tracks])


def _starts_m(case: Case) -> Float[np.ndarray, "num_objects 2"]:
    return np.array([planar(case.Ts_base_start[key])[:2] for key in case.objects])


def _check_same(poses: Sequence[dict[str, Any]], row: dict[str, Any]) -> None:
    for label, again in zip(("nominal", "calibrated"), errors_m(poses, "localised"), strict=True):
        first = np.array(row["held_out"][label]["settled_errors_m"])
        if first.shape != again.shape or not np.allclose(first, again, rtol=0.0, atol=SAME_M):
            message = (
                f"seed {row['seed']}: the {label} predictions of {len(again)} held-out poses are "
                "not those of the kept calibration. Delete its seed_*.json and calibrate again."
            )
            raise RuntimeError(message)
