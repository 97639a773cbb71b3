"""What a policy is told of the cell and how its answer is read: one TOML file for each policy.

Without a file a policy gets ``pixels`` (by camera), ``agent_pos`` (joints and width) and ``task``,
and answers joint targets with a width.
"""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from bridge.episode.provenance import hash_settings
from bridge.errors import PathNotFoundError
from bridge.geometry import se3
from twin.policies.errors import PolicyError, RefusedError
from twin.robot.inverse import solve_ik
from twin.robot.model import RobotModel

Kind = Literal["joint_position", "joint_delta", "joint_velocity", "ee_delta", "ee_pose"]
Value = Literal[
    "joints_rad", "joints_deg", "width_m", "closed", "open", "open_percent", "tool_m", "tool_wxyz"
]
JOINTS_OF_POSE = {"ee_delta": 6, "ee_pose": 7}


class Picture(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """One picture that a policy gets."""

    camera: str
    size: tuple[int, int] | None = None
    """Width and height: the picture is fitted in, black beside it; none: as it is."""
    order: Literal["rgb", "bgr"] = "rgb"
    layout: Literal["hwc", "chw"] = "hwc"
    scale: Literal["uint8", "0..1"] = "uint8"


class Actions(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """How one row of an answer becomes a target."""

    key: str = "actions"
    kind: Kind = "joint_position"
    """ee: the tool in the base frame: metres and a rotation vector (delta), or metres and wxyz."""
    degrees: bool = False
    scale: float = 1.0
    """Times all but the gripper's number."""
    gripper: Literal["width_m", "closed", "open", "open_percent", "none"] = "width_m"
    """What the last number of a row says: a distance between the pads, or how closed or open the
    gripper is, 0 to 1 or to 100."""
    binary_at: float | None = None
    """The gripper opens or closes all the way: above this share it is the one that is named."""


class PolicyMap(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """All that one policy needs to know of a cell, and the other way round."""

    schema_version: Literal[1] = 1
    rate_hz: float = 10.0
    horizon: int = 0
    """Rows of an answer that are executed before it is asked again; 0: all."""
    prompt: str = ""
    """Empty: the task's instruction."""
    prompt_key: str = "prompt"
    images: dict[str, Picture] = {}
    state: dict[str, tuple[Value, ...]] = {}
    actions: Actions = Actions()

    def sha256(self) -> str:
        """Hash of what it says."""
        return hash_settings(msgspec.to_builtins(self))


DEFAULT = PolicyMap()
END = {"done": True}
"""The answer of a policy that wants nothing more: the rollout ends and is judged."""


def is_end(answer: object) -> bool:
    """Whether an answer says that the policy is done."""
    return isinstance(answer, Mapping) and answer.get("done") is True


def read_mapping(path: Path | None) -> PolicyMap:
    """Read a mapping; None: the default."""
    if path is None:
        return DEFAULT
    try:
        table = tomllib.loads(path.read_text())
        mapping = msgspec.convert(table, PolicyMap)
    except FileNotFoundError as error:
        hint = "Write one: docs/policies.md."
        raise PathNotFoundError(path=path, what="mapping", hint=hint) from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise PolicyError(f"mapping {path}: {error}. docs/policies.md lists every key.") from error
    if not 0.1 <= mapping.rate_hz <= 240:
        raise PolicyError(f"mapping {path}: rate_hz {mapping.rate_hz:g} is not within 0.1 to 240")
    if mapping.horizon < 0:
        raise PolicyError(f"mapping {path}: horizon {mapping.horizon} is negative")
    return mapping


class Interpreter:
    """Translates between one cell and one policy."""

    def __init__(self, mapping: PolicyMap, robot: RobotModel, prompt: str) -> None:
        """Nothing is checked before the first observation."""
        self.mapping = mapping
        self._robot = robot
        self._prompt = mapping.prompt or prompt
        self._max_width_m = robot.record.gripper.max_width_m

    def cameras(self) -> tuple[str, ...]:
        """Cameras that the policy looks through; none: all."""
        return tuple(dict.fromkeys(item.camera for item in self.mapping.images.values()))

    def sizes(self) -> dict[str, tuple[int, int]]:
        """In which size a camera is drawn: the largest that is asked of it."""
        found: dict[str, tuple[int, int]] = {}
        for item in self.mapping.images.values():
            if item.size is not None:
                found[item.camera] = max(found.get(item.camera, (0, 0)), item.size)
        whole = [item.camera for item in self.mapping.images.values() if item.size is None]
        return {name: size for name, size in found.items() if name not in whole}

    def observation(
        self,
        pictures: Mapping[str, UInt8[np.ndarray, "height width 3"]],
        joints_rad: Float[np.ndarray, " num_joints"],
        width_m: float,
    ) -> dict[str, Any]:
        """What the policy is sent."""
        if not self.mapping.images and not self.mapping.state:
            state = np.append(joints_rad, width_m).astype(np.float32)
            return {"pixels": dict(pictures), "agent_pos": state, "task": self._prompt}
        found: dict[str, Any] = {self.mapping.prompt_key: self._prompt}
        for key, item in self.mapping.images.items():
            found[key] = _as_wanted(pictures[item.camera], item)
        for key, values in self.mapping.state.items():
            parts = [self._value(value, joints_rad, width_m) for value in values]
            found[key] = np.concatenate(parts).astype(np.float32)
        return found

    def _value(
        self, value: Value, joints_rad: Float[np.ndarray, " num_joints"], width_m: float
    ) -> Float[np.ndarray, " num_values"]:
        if value == "joints_rad":
            return joints_rad
        if value == "joints_deg":
            return np.asarray(np.degrees(joints_rad))
        if value == "width_m":
            return np.array([width_m])
        if value in ("closed", "open", "open_percent"):
            share = width_m / self._max_width_m if self._max_width_m else 0.0
            shares = {"closed": 1.0 - share, "open": share, "open_percent": 100.0 * share}
            return np.array([shares[value]])
        q_wxyz, p_m = se3.split(self._robot.T_base_tcp(joints_rad))
        found: Float[np.ndarray, " num_values"] = p_m if value == "tool_m" else q_wxyz
        return found

    def rows(self, answer: object) -> Float[np.ndarray, "num_rows num_values"]:
        """Take the rows out of an answer.

        Raises:
            PolicyError: It is not what the mapping says, with what came instead.
        """
        key, width = self.mapping.actions.key, self.num_values()
        if isinstance(answer, Mapping):
            if key not in answer:
                there = ", ".join(map(str, answer)) or "nothing"
                raise PolicyError(f"the policy's answer has no {key!r}; it has: {there}")
            answer = answer[key]
        try:
            rows = np.asarray(answer, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise PolicyError(f"the policy's {key} are no numbers ({error})") from error
        rows = rows[None] if rows.ndim == 1 else rows
        if rows.ndim != 2 or rows.shape[1] != width or not len(rows):
            raise PolicyError(
                f"the policy's {key} have shape {rows.shape}; {self.mapping.actions.kind} of "
                f"{self._robot.name} takes rows of {width} numbers"
            )
        if not np.isfinite(rows).all():
            bad = int(np.argmin(np.isfinite(rows).all(axis=1)))
            raise PolicyError(f"the policy's {key} are not finite from row {bad} on: {rows[bad]}")
        return rows

    def num_values(self) -> int:
        """Numbers in one row."""
        actions = self.mapping.actions
        arm = JOINTS_OF_POSE.get(actions.kind, len(self._robot.joints))
        return arm + (actions.gripper != "none")

    def target(
        self,
        row: Float[np.ndarray, " num_values"],
        last_rad: Float[np.ndarray, " num_joints"],
        last_width_m: float,
    ) -> tuple[Float[np.ndarray, " num_joints"], float]:
        """Joints and width that one row asks for, from the target before it.

        Raises:
            RefusedError: A pose that the arm does not reach.
        """
        actions = self.mapping.actions
        arm = row if actions.gripper == "none" else row[:-1]
        width_m = last_width_m if actions.gripper == "none" else self._width_m(float(row[-1]))
        arm = arm * actions.scale
        if actions.kind in JOINTS_OF_POSE:
            return self._reach(arm, last_rad), width_m
        arm = np.radians(arm) if actions.degrees else arm
        if actions.kind == "joint_position":
            return arm, width_m
        step = arm if actions.kind == "joint_delta" else arm / self.mapping.rate_hz
        return last_rad + step, width_m

    def _width_m(self, number: float) -> float:
        actions = self.mapping.actions
        if actions.gripper == "width_m":
            return number
        if actions.gripper == "open_percent":
            number /= 100.0
        if actions.binary_at is not None:
            number = float(number > actions.binary_at)
        share = min(max(number, 0.0), 1.0)
        return self._max_width_m * (1.0 - share if actions.gripper == "closed" else share)

    def _reach(
        self, pose: Float[np.ndarray, " num_values"], last_rad: Float[np.ndarray, " num_joints"]
    ) -> Float[np.ndarray, " num_joints"]:
        if self.mapping.actions.kind == "ee_pose":
            length = float(np.linalg.norm(pose[3:]))
            if length < 1e-6:
                raise PolicyError("the policy's quaternion is zero")
            T = se3.transform_from(pose[3:] / length, pose[:3])
        else:
            T = self._robot.T_base_tcp(last_rad)
            T[:3, 3] += pose[:3]
            T[:3, :3] = se3.rotation_from_vector(pose[3:]) @ T[:3, :3]
        found = solve_ik(self._robot, T, warm_start_rad=last_rad, restarts=0)
        if not found.reached:
            p = ", ".join(f"{x:.3f}" for x in T[:3, 3])
            raise RefusedError(
                name="reach",
                detail=f"the arm does not bring the tool to ({p}) m: "
                f"{found.position_error_m * 1e3:.0f} mm and {found.rotation_error_rad:.2f} rad "
                "are missing",
            )
        return found.joints_rad


def fitting(width: int, height: int, size: tuple[int, int]) -> tuple[int, int]:
    """Width and height of the largest picture of the same shape that fits into a size."""
    factor = min(size[0] / width, size[1] / height)
    return max(1, int(width * factor)), max(1, int(height * factor))


def fitted(
    picture: UInt8[np.ndarray, "height width 3"], size: tuple[int, int]
) -> UInt8[np.ndarray, "new_height new_width 3"]:
    """All of a picture in another size, black beside it, as policies were trained with."""
    width, height = size
    inner = fitting(picture.shape[1], picture.shape[0], size)
    small = np.asarray(Image.fromarray(picture).resize(inner, Image.Resampling.BILINEAR))
    left, top = (width - inner[0]) // 2, (height - inner[1]) // 2
    found = np.zeros((height, width, 3), dtype=np.uint8)
    found[top : top + inner[1], left : left + inner[0]] = small
    return found


def _as_wanted(picture: UInt8[np.ndarray, "height width 3"], item: Picture) -> np.ndarray:
    found: np.ndarray = picture if item.size is None else fitted(picture, item.size)
    if item.order == "bgr":
        found = found[..., ::-1]
    if item.layout == "chw":
        found = np.moveaxis(found, -1, 0)
    if item.scale == "0..1":
        found = found.astype(np.float32) / np.float32(255)
    return np.ascontiguousarray(found)
