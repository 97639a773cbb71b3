"""``robot-gst calibrate RUN --cameras``: each camera by what was recorded of it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, UsageError
from bridge.geometry import se3
from bridge.task.robot import BASE_FRAME
from bridge.terminal import Output
from twin.calibrate.config import CalibrateConfig
from twin.calibrate.fixed_camera import FixedCamera, find_fixed_camera
from twin.calibrate.pairs import PosePairs, read_pairs, recorded_pairs, target_cameras
from twin.calibrate.placement import MOVING, NO_DEPTH, depth_cameras, placement
from twin.calibrate.target import TargetCamera, find_camera
from twin.scene.store.calibration import CALIBRATION_FILE, write_calibration


class NothingToCalibrateError(UsageError):
    """The run holds nothing from which a camera could be found."""


def calibrate_cameras(run: RunFolder, config: CalibrateConfig, output: Output) -> dict[str, Any]:
    """Find every camera the run has data of, and write ``scene/calibration.json``.

    A camera is found from pose pairs of a target where there are some, otherwise, when it stands
    still, from the robot in its depth images.

    Raises:
        NothingToCalibrateError: No camera could be found for want of data; says what is missing.
        UndeterminedCameraError: The one camera that was asked for is not determined.
        RobotNotAlignedError: The same, from the robot it sees.
    """
    episodes = _readable(run, output)
    where = {} if config.pairs is not None else placement(episodes)
    found: dict[str, Any] = {}
    reasons: dict[str, str] = {}
    for camera_id in _wanted(episodes, where, config):
        try:
            found[camera_id] = _camera(episodes, camera_id, where.get(camera_id, NO_DEPTH), config)
        except GstError as error:
            if config.camera:
                raise
            reasons[camera_id] = str(error)
            output.detail(f"camera {camera_id}: {error}")
    if not found:
        raise NothingToCalibrateError(_nothing(run, reasons))
    return write_calibration(run, found, reasons)


def _readable(run: RunFolder, output: Output) -> list[Episode]:
    """All episodes but those that cannot be opened, which are named."""
    episodes = []
    for path in run.episodes():
        try:
            episodes.append(Episode.open(path))
        except GstError as error:
            output.say(f"{path.stem}: {error}")
    return episodes


def _wanted(
    episodes: Sequence[Episode], where: Mapping[str, str], config: CalibrateConfig
) -> list[str]:
    if config.pairs is not None and not config.camera:
        message = "--pairs needs --camera: which camera do the pose pairs belong to?"
        raise UsageError(message)
    if config.camera:
        return [config.camera]
    return sorted({*where, *target_cameras(episodes)})


def _camera(
    episodes: Sequence[Episode], camera_id: str, where: str, config: CalibrateConfig
) -> dict[str, Any]:
    if config.pairs is not None:
        return _from_target(read_pairs(config.pairs), config)
    if camera_id in target_cameras(episodes):
        return _from_target(recorded_pairs(episodes, camera_id, config.link), config)
    if where == NO_DEPTH:
        message = (
            f"camera {camera_id} has neither target poses (topic .../cam/{camera_id}/target/pose) "
            "nor depth images with intrinsics. Record one of them, or give --pairs FILE."
        )
        raise NothingToCalibrateError(message)
    if where == MOVING:
        message = (
            f"camera {camera_id} moves with the robot and there are no target poses of it. Record "
            f"a target from 10 to 20 places on .../cam/{camera_id}/target/pose, or give --pairs "
            "FILE."
        )
        raise NothingToCalibrateError(message)
    with_depth = [episode for episode in episodes if camera_id in depth_cameras(episode)]
    found = find_fixed_camera(
        with_depth, camera_id, max_postures=config.max_postures, seed=config.seed
    )
    return fixed_record(found)


def _from_target(pairs: PosePairs, config: CalibrateConfig) -> dict[str, Any]:
    return target_record(find_camera(pairs, config.mount, seed=config.seed), pairs, config.link)


def target_record(found: TargetCamera, pairs: PosePairs, link: str) -> dict[str, Any]:
    """Say what pose pairs gave."""
    solution = found.solution
    in_hand = found.mount == "hand"
    return {
        "method": "target pose pairs, AX = ZB",
        "mount": found.mount,
        "link": link if in_hand else BASE_FRAME,
        "stream": "color",
        "T_link_camera": pose_record(solution.X if in_hand else solution.Z),
        "T_base_target" if in_hand else "T_effector_target": pose_record(
            solution.Z if in_hand else solution.X
        ),
        "residual_m": solution.residual_m.to_record(),
        "residual_rad": solution.residual_rad.to_record(),
        "sigma_m": solution.x_sigma_m,
        "sigma_rad": solution.x_sigma_rad,
        "num_pairs": solution.num_pairs,
        "num_outliers": solution.num_outliers,
        "second_turn_rad": solution.second_turn_rad,
        "sources": [pairs.source],
    }


def fixed_record(found: FixedCamera) -> dict[str, Any]:
    """Say what the robot seen by a fixed camera gave."""
    record = {
        "method": "depth of the robot against its description",
        "mount": "fixed",
        "link": BASE_FRAME,
        "stream": "depth",
        "T_link_camera": pose_record(found.alignment.T_base_source),
        **found.alignment.to_record(),
        "sources": list(found.episodes),
    }
    if found.T_base_believed is not None:
        change = se3.invert(found.T_base_believed) @ found.alignment.T_base_source
        record["correction_m"] = float(np.linalg.norm(change[:3, 3]))
        record["correction_rad"] = float(se3.rotation_angle_rad(change[:3, :3]))
    return record


def pose_record(T: Float[np.ndarray, "4 4"]) -> dict[str, list[float]]:
    """Position [m] and quaternion, as they are stored."""
    q, p = se3.split(T)
    return {"p_m": p.tolist(), "q_wxyz": q.tolist()}


def _nothing(run: RunFolder, reasons: Mapping[str, str]) -> str:
    if not reasons:
        return (
            f"no episode in {run.episodes_dir} has target poses or depth images of a camera. "
            "Record one of them, or give --pairs FILE --camera ID."
        )
    listed = " ".join(f"{key}: {reason}" for key, reason in sorted(reasons.items()))
    return f"no camera could be calibrated. {listed}"


def describe_cameras(record: Mapping[str, Any]) -> str:
    """Say in a line per camera what was identified and what was not."""
    lines = [f"calibration {record['calibration_id']} in scene/{CALIBRATION_FILE}"]
    lines += [f"{key}: {_describe(item)}" for key, item in record["cameras"].items()]
    lines += [f"{key}: not identified. {why}" for key, why in record["not_identified"].items()]
    return "\n".join(lines)


def _describe(item: Mapping[str, Any]) -> str:
    residual = item["residual_m"]
    text = (
        f"{item['mount']}, residual {residual['value'] * 1e3:.2f} mm "
        f"[{residual['low'] * 1e3:.2f}, {residual['high'] * 1e3:.2f}]"
    )
    if "residual_rad" in item:
        turn = {key: float(np.degrees(value)) for key, value in item["residual_rad"].items()}
        text += f" and {turn['value']:.3f} [{turn['low']:.3f}, {turn['high']:.3f}] degrees"
        text += f", {item['num_pairs']} pairs, {item['num_outliers']} outliers"
        return f"{text}; position known to {item['sigma_m'] * 1e3:.2f} mm (bootstrap)"
    text += f", robot seen in {item['num_postures']} postures, fitness {item['fitness']:.2f}"
    text += f", depth scale {item['depth_scale']:.4f}"
    if "correction_m" in item:
        moved, turned = item["correction_m"] * 1e3, float(np.degrees(item["correction_rad"]))
        text += f"; {moved:.1f} mm and {turned:.2f} degrees from where the recording believed it"
    return text
