"""What an invented run is made of: one drawn trial, and how its messages are written."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from PIL import Image

from bridge.episode import schema
from bridge.episode.cdr import messages
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.robots.default import ARM_JOINTS
from bridge.task.plan import Plan
from bridge.task.task_file import Task

START_NS = 100_000_000_000
STEP_NS = 100_000_000
NUM_STEPS = 30
CELL = "/standin"
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One drawn trial."""

    id: str
    task: Task
    condition: str
    start: int
    success: bool
    done: int
    """Objects of the task that ended where they belong."""
    said: bool
    """What the planned replay says."""
    executed: bool
    p_success: float
    label: bool
    """What the operator said; once it is wrong on purpose."""
    found: bool = True
    """Whether the manipulated objects were localised afterwards."""

    @property
    def plan_id(self) -> str:
        """Name of the plan that was sent."""
        return f"plan_{self.id}"


def wobble(rng: np.random.Generator, size_m: float) -> Float[np.ndarray, "num_steps 3"]:
    """An error that grows and shrinks slowly, as a controller's does."""
    phase = np.linspace(0, 2 * np.pi, NUM_STEPS)[:, None] + rng.uniform(0, 6, 3)
    return size_m * np.abs(np.sin(phase / 2)) * rng.uniform(0.4, 1.4, 3)


@dataclass(frozen=True)
class Log:
    """Puts messages into one episode."""

    writer: EpisodeWriter

    def raw(self, topic: str, type_name: str, data: bytes, stamp_ns: int) -> None:
        """Write one message of the cell."""
        topic = f"{CELL}/{topic}"
        self.writer.write(topic, data, type_name=type_name, log_time_ns=stamp_ns)

    def json(self, topic: str, type_name: str, stamp_ns: int, **record: object) -> None:
        """Write one JSON record."""
        record = {"schema_version": 1, "stamp_ns": stamp_ns, **record}
        self.writer.write(f"{CELL}/{topic}", record, type_name=type_name, log_time_ns=stamp_ns)

    def execution(self, plan: Plan) -> None:
        """Write when the execution and its stages began and ended."""
        events = [(0, "execution_started", None)]
        for stage in plan.stages:
            events += [(stage.t_start_ns, "stage_started", stage.id)]
            events += [(stage.t_end_ns, "stage_ended", stage.id)]
        events += [(NUM_STEPS * STEP_NS, "execution_ended", None)]
        for t_ns, kind, stage_id in events:
            about = {"type": kind, "plan_id": plan.id, "stage_id": stage_id}
            self.json("event", schema.EVENT, START_NS + t_ns, **about)

    def tool(self, path_m: Float[np.ndarray, "num_steps 3"]) -> None:
        """Write the poses of the tool centre point."""
        self._track("tcp/pose", path_m, range(NUM_STEPS))

    def objects(
        self, task: Task, starts: Mapping[str, np.ndarray], ends: Mapping[str, np.ndarray]
    ) -> None:
        """Write where moved objects are at first and from half-way on; soft ones with nodes."""
        for name in task.manipulated:
            path = np.array([starts[name], ends[name], ends[name]])
            steps = (0, NUM_STEPS // 2, NUM_STEPS)
            self._track(f"object/{name}/pose", path, steps)
            model = task.objects[name]
            if model.soft is None:
                continue
            for step, p_m, press in zip(steps, path, (1.0, 0.97, 0.97), strict=True):
                nodes = p_m + CORNERS * np.array(model.size_m) / 2 * [1.0, 1.0, press]
                stamp_ns = START_NS + step * STEP_NS
                sample = messages.PointCloudSample(
                    stamp_ns=stamp_ns, frame_id="base_link", points_m=nodes
                )
                topic = f"object/{name}/nodes"
                self.raw(topic, schema.POINT_CLOUD, sample.to_cdr(), stamp_ns)

    def _track(
        self, topic: str, path_m: Float[np.ndarray, "num_steps 3"], steps: Sequence[int]
    ) -> None:
        for step, p_m in zip(steps, path_m, strict=True):
            stamp_ns = START_NS + step * STEP_NS
            T = se3.transform_from(np.array([1.0, 0, 0, 0]), np.asarray(p_m, dtype=np.float64))
            sample = messages.PoseSample(stamp_ns=stamp_ns, frame_id="base_link", T_frame_body=T)
            self.raw(topic, schema.POSE_STAMPED, sample.to_cdr(), stamp_ns)

    def joints(self, position: Float[np.ndarray, "num_steps num_joints"]) -> None:
        """Write the joints of the arm."""
        for step, row in enumerate(position):
            stamp_ns = START_NS + step * STEP_NS
            none = np.zeros(0)
            sample = messages.JointSample(
                stamp_ns=stamp_ns, names=ARM_JOINTS, position=row, velocity=none, effort=none
            )
            self.raw("joint_states", schema.JOINT_STATE, sample.to_cdr(), stamp_ns)

    def localised(
        self, trial: Trial, phase: str, places: Mapping[str, np.ndarray], stamp_ns: int
    ) -> None:
        """Write where the twin saw every object, before or after the execution."""
        for name, model in trial.task.objects.items():
            found = trial.found or phase == "start" or name not in trial.task.manipulated
            p_m = places[name]
            record: dict[str, object] = {
                "object": name,
                "found": found,
                "T_base_object": {"p_m": p_m.tolist(), "q_wxyz": [1.0, 0, 0, 0]} if found else None,
                "method": "drawn",
                "reason": None if found else "hidden by the arm",
                "phase": phase,
                "plan_id": trial.plan_id,
            }
            if model.soft is not None and found:
                record["soft_shape"] = {
                    "centroid_m": p_m.tolist(),
                    "axes": np.eye(3).tolist(),
                    "extents_m": (np.array(model.size_m) * [1.0, 1.0, 0.95]).tolist(),
                    "extents_sigma_m": [0.004] * 3,
                }
            self.json("localisation", schema.LOCALISATION, stamp_ns, **record)

    def picture(self, camera: str, name: str, image_u8: np.ndarray, stamp_ns: int) -> None:
        """Write one image, lossless."""
        buffer = io.BytesIO()
        Image.fromarray(image_u8).save(buffer, format="png")
        image = messages.CompressedColor(
            stamp_ns=stamp_ns, frame_id=camera, format="png", data=buffer.getvalue()
        )
        self.raw(f"cam/{camera}/{name}", schema.COMPRESSED_IMAGE, image.to_cdr(), stamp_ns)

    def depth(
        self, camera: str, name: str, depth_m: Float[np.ndarray, "height width"], stamp_ns: int
    ) -> None:
        """Write one depth image."""
        depth_mm = np.rint(1000 * depth_m).astype(np.uint16)
        image = messages.DepthImage(stamp_ns=stamp_ns, frame_id=camera, depth_mm=depth_mm)
        self.raw(f"cam/{camera}/{name}", schema.IMAGE, image.to_cdr(), stamp_ns)
