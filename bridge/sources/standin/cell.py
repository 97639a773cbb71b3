"""The cell at work: physics, sensors and clock together, publishing as they go."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from bridge.clock import ns_from_s
from bridge.errors import BridgeError
from bridge.robots.default import MAX_WIDTH_M, ROBOT
from bridge.robots.stop import PressedStop
from bridge.sources.standin.cell_file import CellFile, HiddenParameters, draw_hidden
from bridge.sources.standin.kinematics import arm_kinematics, tool_down
from bridge.sources.standin.render import Layer, Renderer, measure_color, measure_depth
from bridge.sources.standin.streams import Streams
from bridge.sources.standin.surfaces import (
    clutter_surfaces,
    lab_surfaces,
    object_surfaces,
    robot_surfaces,
)
from bridge.sources.standin.world import World
from bridge.task.causes import Cause
from bridge.task.predicate import Rollout
from bridge.task.task_file import Task

TICK_NS = ns_from_s(0.008)
"""The robot's 125 Hz."""
GRIPPER_NS = ns_from_s(1 / 50)
FRAMES_NS = ns_from_s(1 / 60)
"""Of ``/tf``; the wrist camera moves less than a millimetre off a straight line in between."""
TRUTH_NS = ns_from_s(1 / 30)
FINGER_SPEED_M_S = 0.15
"""How fast the gripper's controller closes the opening."""
HOME_SEED_RAD = (-0.263, -1.709, 1.365, -1.227, -1.571, 1.308)
SENSOR_STREAM = 303


class StoppedError(BridgeError):
    """Somebody asked the session to end."""

    def __init__(self) -> None:
        """Say so."""
        super().__init__("the session was stopped before its end; what was recorded is complete.")


@dataclass
class TruthLog:
    """What really happened since the last reset, at 30 Hz; the operator looks at this."""

    stamps_ns: list[int] = field(default_factory=list)
    poses: dict[str, list[Float[np.ndarray, "4 4"]]] = field(default_factory=dict)
    contact: dict[str, list[bool]] = field(default_factory=dict)
    extents_m: dict[str, list[Float[np.ndarray, "3"]]] = field(default_factory=dict)
    """Of soft objects."""

    def rollout(self) -> Rollout:
        """Return the record in the form the predicates read."""
        return Rollout(
            stamps_ns=np.array(self.stamps_ns, dtype=np.int64),
            Ts_base_object={key: np.array(rows) for key, rows in self.poses.items()},
            finger_contact={key: np.array(rows, dtype=bool) for key, rows in self.contact.items()},
            extents_m={key: np.array(rows) for key, rows in self.extents_m.items()},
        )


class StandinCell:
    """A laboratory with its own clock, which starts at ``start_ns`` and moves with the physics."""

    def __init__(
        self,
        cell: CellFile,
        task: Task,
        hidden: HiddenParameters,
        streams: Streams,
        *,
        seed: int,
        start_ns: int,
        first_start: int = 0,
        rate_hz: float = 5.0,
        scale: float = 1.0,
        should_stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Build the laboratory and wait at home.

        Args:
            rate_hz: Frames per second of each camera during trials; 0 takes none.
            scale: Of images, times what the cell file says (320 x 240).
        """
        self.file, self.task, self.hidden, self.streams = cell, task, hidden, streams
        self.rate_hz = rate_hz
        self.world = World(task, hidden, cell.clutter)
        self._steps_per_tick = round(TICK_NS * 1e-9 / self.world.step_s)
        self.kinematics = arm_kinematics()
        home = tool_down(np.array(cell.home_m), 0.0)
        self.home_rad = self.kinematics.joints_for(home, np.array(HOME_SEED_RAD))
        self.truth = TruthLog()
        self.now_ns = start_ns
        self._cameras = {key: mount.camera.scaled(scale) for key, mount in cell.cameras.items()}
        self._lenses = self._cameras  # what takes the pictures; published is what it should be
        if hidden.deviations is not None:
            self._lenses = {
                key: hidden.deviations.lens(key, camera) for key, camera in self._cameras.items()
            }
        self._seed = seed
        self._backdrops: dict[str, Layer] = {}
        # A session that begins at a later start has other noise than one that begins at the first.
        begins = [first_start] if first_start else []
        self._rng = np.random.default_rng([SENSOR_STREAM, seed, *begins])
        self._should_stop = should_stop
        self.target_rad, self._width_m = self.home_rad, MAX_WIDTH_M
        self._width_target_m = MAX_WIDTH_M
        self.stopped, self._pressed = "", PressedStop(ROBOT.contact_force_N)
        self._due = dict.fromkeys(("gripper", "truth", "camera", "frames"), start_ns)
        self.cameras_running = False

    @cached_property
    def _renderer(self) -> Renderer:
        """Made with the first picture; a cell that takes none saves a second."""
        deviations = self.hidden.deviations
        clutter = clutter_surfaces(self.world.clutter)
        lab = [*lab_surfaces(self._seed, deviations), *clutter]
        robot = robot_surfaces(deviations)
        return Renderer([*robot, *object_surfaces(self.world.task, deviations), *lab])

    def take_objects(self, start_seed: int) -> None:
        """Work with the objects of a start, where each has its own of their kind."""
        if self.file.each_start:
            self.hidden = draw_hidden(self.file, self._seed, self.task, start_seed)
            self.world = World(self.task, self.hidden, self.file.clutter)
            vars(self).pop("_renderer", None)

    def reset(self, Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]]) -> None:
        """Bring the arm home with an open gripper and put the objects down where declared.

        In a cell that hides its table and its containers' poses they lie elsewhere.
        """
        if self.hidden.deviations is not None:
            Ts_base_object = self.hidden.deviations.put_down(self.world.task, Ts_base_object)
        self.target_rad = self.home_rad
        self._width_m = self._width_target_m = MAX_WIDTH_M
        self.stopped, self._pressed = "", PressedStop(ROBOT.contact_force_N)
        self.world.reset(self.home_rad - self.hidden.joint_offset_rad, Ts_base_object)
        self.truth = TruthLog()

    def announce(self) -> None:
        """Publish what a listener needs before anything else: URDF, calibration, frames."""
        self.streams.description(ROBOT.urdf_text(), self.now_ns)
        for camera_id, camera in self._cameras.items():
            self.streams.camera_info(camera_id, camera, self.now_ns)
        fixed = {
            key: mount.T_parent_camera
            for key, mount in self.file.cameras.items()
            if not mount.moving
        }
        self.streams.camera_poses(fixed, self.now_ns, static=True)
        self.streams.depth_frames(self.file.cameras, self.now_ns)
        self.streams.truth_parameters(self.hidden.to_record(), self.now_ns)

    def wait(self, duration_s: float) -> None:
        """Hold still."""
        for _ in range(round(ns_from_s(duration_s) / TICK_NS)):
            self._tick()

    def skip(self, duration_s: float) -> None:
        """Let time pass in which nobody looks, for example between two trials."""
        self.now_ns += ns_from_s(duration_s)

    def follow(
        self,
        times_ns: Int[np.ndarray, " num_waypoints"],
        joints_rad: Float[np.ndarray, "num_waypoints 6"],
    ) -> None:
        """Send joint targets, interpolated between waypoints, from now on; a stop ends it."""
        ticks_ns = np.arange(1, round(int(times_ns[-1]) / TICK_NS) + 1) * TICK_NS
        columns = [np.interp(ticks_ns, times_ns, joints_rad[:, joint]) for joint in range(6)]
        for row in np.stack(columns, axis=1):
            if self.stopped:
                return
            self.target_rad = row
            self._tick()

    def grip(self, width_m: float) -> None:
        """Tell the gripper which opening to go to; it moves while time passes."""
        self._width_target_m = width_m

    def _tick(self) -> None:
        if self._should_stop():
            raise StoppedError
        step = FINGER_SPEED_M_S * TICK_NS * 1e-9
        self._width_m += float(np.clip(self._width_target_m - self._width_m, -step, step))
        # The controller closes its loop on encoder readings, which are off by a constant.
        self.world.command(self.target_rad - self.hidden.joint_offset_rad, self._width_m)
        efforts_Nm, pressed_N = np.zeros(6), np.zeros(3)
        for _ in range(self._steps_per_tick):
            self.world.step()
            efforts_Nm += self.world.joint_efforts_Nm / self._steps_per_tick
            pressed_N += self.world.arm_force_N() / self._steps_per_tick
        self.now_ns += TICK_NS
        self._stop_where_pressed(float(np.linalg.norm(pressed_N)))
        self._publish_robot(efforts_Nm)
        if self._is_due("truth", TRUTH_NS):
            self._publish_truth()
        rate = self.rate_hz
        if self.cameras_running and rate > 0 and self._is_due("camera", ns_from_s(1 / rate)):
            self.capture()

    def _stop_where_pressed(self, force_N: float) -> None:
        """The protective stop: the arm holds where it is until the next reset, and says so."""
        detail = self._pressed.found(force_N, TICK_NS)
        if self.stopped or not detail:
            return
        self.target_rad = self.encoders_rad
        self.stopped = f"{Cause.CONTACT_FORCE}: {detail}"
        about = {"force_N": round(force_N, 1), "limit_N": ROBOT.contact_force_N}
        data = {"cause": Cause.CONTACT_FORCE, **about}
        self.streams.event("mark", self.now_ns, text=f"protective stop: {detail}", data=data)

    @property
    def encoders_rad(self) -> Float[np.ndarray, "6"]:
        """Where the controller believes the arm to be, but for the noise of its encoders."""
        world = self.world
        return np.asarray(world.joints_rad + world.slack_rad + self.hidden.joint_offset_rad)

    def _is_due(self, name: str, period_ns: int) -> bool:
        if self.now_ns < self._due[name]:
            return False
        self._due[name] = max(self._due[name] + period_ns, self.now_ns - period_ns // 2)
        return True

    def _publish_robot(self, efforts_Nm: Float[np.ndarray, "6"]) -> None:
        world, streams = self.world, self.streams
        noise = self._rng.normal(0.0, self.file.sensors.encoder_noise_rad, 6)
        encoders = self.encoders_rad + noise
        streams.joints(encoders, world.joint_speeds_rad_s, efforts_Nm, self.now_ns)
        streams.tcp(self.kinematics.T_base_tcp(encoders), self.now_ns)
        if self._is_due("frames", FRAMES_NS):
            streams.camera_poses(self._believed(encoders), self.now_ns, static=False)
        if self._is_due("gripper", GRIPPER_NS):
            streams.gripper(world.width_m, self.now_ns)

    def _believed(self, encoders_rad: Float[np.ndarray, "6"]) -> dict[str, np.ndarray]:
        """Poses of the moving cameras."""
        return {
            key: self.kinematics.T_base_frame(encoders_rad, mount.parent) @ mount.T_parent_camera
            for key, mount in self.file.cameras.items()
            if mount.moving
        }

    def _publish_truth(self) -> None:
        contact = self.world.finger_contact()
        self.truth.stamps_ns.append(self.now_ns)
        for object_id, T in self.world.Ts_base_object().items():
            self.streams.truth_object(object_id, T, self.now_ns)
            self.truth.poses.setdefault(object_id, []).append(T)
            self.truth.contact.setdefault(object_id, []).append(contact[object_id])
        for object_id in self.task.soft_objects:
            self.streams.truth_nodes(object_id, self.world.lattice_m(object_id), self.now_ns)
            extents = self.world.extents_m(object_id, self.truth.poses[object_id][-1])
            self.truth.extents_m.setdefault(object_id, []).append(extents)

    def true_camera(self, camera_id: str) -> Float[np.ndarray, "4 4"]:
        """Where a camera really is: true joints, true mounting."""
        mount = self.file.cameras[camera_id]
        T_base_parent = np.eye(4)
        if mount.moving:
            T_base_parent = self.world.T_base_body(mount.parent)
        T_base_nominal = T_base_parent @ mount.T_parent_camera
        return np.asarray(T_base_nominal @ self.hidden.camera_errors[camera_id])

    def capture(self) -> None:
        """Take and publish one frame of every camera, now."""
        bodies = {**self.world.Ts_base_link(), **self.world.Ts_base_object()}
        skins = self.world.skins_m()
        for camera_id, camera in self._lenses.items():
            T_base_camera = self.true_camera(camera_id)
            backdrop = None
            if not self.file.cameras[camera_id].moving:
                backdrop = self._backdrops.get(camera_id)
                if backdrop is None:
                    backdrop = self._renderer.backdrop(camera, T_base_camera)
                    self._backdrops[camera_id] = backdrop
            picture = self._renderer.render(camera, T_base_camera, bodies, backdrop, skins)
            depth = measure_depth(picture, self.file.sensors, self.hidden, self._rng)
            color = measure_color(picture, self.file.sensors, self.hidden, self._rng)
            self.streams.frame(camera_id, color, depth, self.now_ns)
