"""Send a policy one recorded start, and explain what it answers; nothing moves."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from bridge.episode.run_folder import RunFolder
from twin.policies.cell import TwinCell
from twin.policies.colours import gains_of
from twin.policies.config import RolloutConfig
from twin.policies.errors import PolicyError, StoppedError
from twin.policies.gap import describe_gap, visual_gap
from twin.policies.mapping import Interpreter, read_mapping
from twin.policies.policy import open_policy
from twin.policies.starts import open_start, trial_episodes
from twin.policies.views import TwinCameras


def check_policy(run: RunFolder, config: RolloutConfig) -> dict[str, Any]:
    """Ask once.

    Returns:
        ``sent`` and ``answered``: shape, type and range by key; ``first``: the first target, how
        far it is from where the arm stands, and what refuses it; ``gains`` of
        the trials' light; ``gap``: the visual gap.
    """
    episode = trial_episodes(run, config.task)[0]
    start = open_start(run, episode)
    cell, mapping = TwinCell(start), read_mapping(config.map)
    policy = open_policy(config.policy, config.timeout_s)
    try:
        speak = Interpreter(mapping, cell.robot, start.task.instruction)
        cameras = TwinCameras(run, start, speak.cameras(), speak.sizes())
        policy.reset(config.seed)
        observation = speak.observation(cameras.draw(cell), *cell.posture())
        rows = speak.rows(policy.infer(observation))
        found = {
            "policy": config.policy,
            "metadata": policy.metadata,
            "start": start.id,
            "sent": {key: _described(value) for key, value in _flat(observation)},
            "answered": _described(rows),
            "kind": mapping.actions.kind,
            "rate_hz": mapping.rate_hz,
            "response": start.response.describe(),
        }
        found |= _first(speak, cell, rows)
        gains = gains_of(run, episode, list(cameras.viewpoints))
        gap = visual_gap(run, episode, policy, speak, config.seed, gains)
        return found | {"gains": gains, "gap": gap}
    finally:
        policy.close()
        cell.close()


def _first(speak: Interpreter, cell: TwinCell, rows: np.ndarray) -> dict[str, Any]:
    """Where the answer leads, as far as the limits let it."""
    begun, refused, followed = cell.target_rad.copy(), "", 0
    try:
        for row in rows:
            target = speak.target(row, cell.target_rad, cell.target_width_m)
            cell.go(*target, 1.0 / speak.mapping.rate_hz)
            followed += 1
    except (PolicyError, StoppedError) as error:
        refused = str(error)
    away = cell.target_rad - begun
    return {
        "followed": followed,
        "refused": refused,
        "away_rad": [round(float(x), 4) for x in away],
        "width_m": round(cell.target_width_m, 4),
    }


def _flat(observation: Mapping[str, Any]) -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for key, value in observation.items():
        if isinstance(value, Mapping):
            found += [(f"{key}.{inner}", item) for inner, item in value.items()]
        else:
            found.append((key, value))
    return found


def _described(value: object) -> str:
    if not isinstance(value, np.ndarray):
        return repr(value)
    shape = " x ".join(map(str, value.shape))
    return f"{shape} {value.dtype}, {value.min():.4g} to {value.max():.4g}"


def describe_check(found: Mapping[str, Any]) -> str:
    """What was sent, what came back, and where it leads."""
    lines = [f"sent, from {found['start']}:"]
    lines += [f"  {key}: {text}" for key, text in found["sent"].items()]
    lines.append(f"answered: {found['answered']}, read as {found['kind']}")
    seconds = found["followed"] / found["rate_hz"]
    lines.append(
        f"followed for {found['followed']} rows, {seconds:.2f} s: joints go by "
        f"{found['away_rad']} rad, the fingers to {found['width_m']} m"
    )
    if found["refused"]:
        lines.append(f"then refused: {found['refused']}")
    lines.append(found["response"])
    return "\n".join([*lines, *describe_gap(found["gap"])])
