"""Soft bodies in the twin: speed per core and quality of pick-and-place.

One fixed setting for everything: ``PhysicsConfig()`` as it is. Quality draws Young's modulus of
1e4-1e5 Pa, 20-100 g, friction 0.3-1.0, grasps that miss by up to 4 mm and 4.6 degrees. The sloth
also as a rebuilt scene has it: a lattice of 9 mm, which physics takes at the task's spacing. First
argument: trials per toy; second: first seed.
"""

import statistics
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from measure import Target, report_targets

from bridge.robots.default import ROBOT
from bridge.sources.standin.cell import HOME_SEED_RAD
from bridge.sources.standin.cell_file import load_cell
from bridge.sources.standin.kinematics import arm_kinematics, tool_down
from bridge.sources.standin.planner import GraspError, plan_pick_and_place
from bridge.task.meshes.catalogue import toy_mesh
from bridge.task.task_file import ObjectModel, Task, load_task
from twin.physics.config import PhysicsConfig
from twin.physics.soft import SoftModel
from twin.physics.world import World
from twin.replay.dynamics import mesh_hulls
from twin.replay.path import JointPath, path_of_plan
from twin.robot.collision import hulls_of
from twin.robot.model import load_robot
from twin.scene.shape.lattice import lattice
from twin.scene.shape.reconstruct import shape_of_mesh

TRIALS, FIRST_SEED = 24, 0
NOTE = "UR5 + gripper in PyBullet, scripted plan, CPU time of one core, physics only"
AS_SCENE = "sloth of a scene"
SPEED = {"duck": 15.0, "sloth": 10.0, AS_SCENE: 10.0, "five ducks": 4.0}
NEEDED = 22 / 24
SETTLE_S = 1.0
LIFTED_M = 0.08
GRIP_N = (6.0, 12.0)
"""What the toys' cell file draws the gripper from: a stronger one crushes the softest toys."""
JOINT_SPEED_RAD_S = 1.6


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Everything that a replay needs."""

    task: Task
    Ts_base_object: dict[str, np.ndarray]
    path: JointPath
    physics: PhysicsConfig
    as_scene: bool = False
    """The toys as a rebuilt scene has them, of 9 mm; otherwise as the task has them."""


@dataclass(frozen=True, kw_only=True)
class Toy:
    """How one toy ended."""

    held: bool
    placed: bool
    num_inverted: int
    extents_off: float
    """Largest change of an extent, as a fraction."""
    shape_error_m: float
    """Largest distance of a node from where the rigid body would have it."""


def one_duck() -> Task:
    """The ducks' task with its first duck alone."""
    task = load_task("five_ducks_into_basket")
    key, kept = "duck_1", {"duck_1", "basket"}
    return replace(
        task,
        manipulated=(key,),
        objects={name: task.objects[name] for name in task.objects if name in kept},
        start={name: task.start[name] for name in task.start if name in kept},
        stages=tuple(stage for stage in task.stages if stage["id"].endswith("_1")),
        success=tuple(item for item in task.success if item["object"] == key),
    )


def draw_trial(task: Task, seed: int, *, varied: bool, as_scene: bool = False) -> Trial:
    """Draw a start, and with ``varied`` material, friction and a grasp that misses a little."""
    rng = np.random.default_rng([808, seed])
    starts = task.draw_start(rng)
    objects = dict(task.objects)
    errors = []
    for key in task.manipulated:
        shift, turn = rng.uniform(-0.004, 0.004, 2), rng.uniform(-0.08, 0.08)
        young, mass = np.exp(rng.uniform(np.log(1e4), np.log(1e5))), rng.uniform(0.02, 0.1)
        if varied:
            objects[key] = with_material(objects[key], float(young), float(mass))
        else:
            shift, turn = shift * 0, 0.0
        errors.append(
            GraspError(along_m=float(shift[0]), across_m=float(shift[1]), yaw_rad=float(turn),
                       height_m=0.0, release_m=(0.0, 0.0))
        )  # fmt: skip
    friction, grip = float(rng.uniform(0.3, 1.0)), float(rng.uniform(*GRIP_N))
    physics = PhysicsConfig(grip_force_N=grip if varied else sum(GRIP_N) / 2)
    if varied:
        physics = replace(physics, object_friction=friction)
    task = replace(task, objects=objects)
    return Trial(
        task=task,
        Ts_base_object=starts,
        path=planned_path(task, starts, errors),
        physics=physics,
        as_scene=as_scene,
    )


def with_material(model: ObjectModel, young_pa: float, mass_kg: float) -> ObjectModel:
    """The same toy of other stuff."""
    if model.soft is None:
        return model
    return replace(model, mass_kg=mass_kg, soft=replace(model.soft, young_pa=young_pa))


def planned_path(
    task: Task, starts: Mapping[str, np.ndarray], errors: list[GraspError]
) -> JointPath:
    """What the scripted planner would do, as joints."""
    kinematics = arm_kinematics()
    home_m = np.array(load_cell(task.cell).home_m)
    home = kinematics.joints_for(tool_down(home_m, 0.0), np.array(HOME_SEED_RAD))
    plan = plan_pick_and_place(
        task, starts, errors, kinematics=kinematics, joints_start_rad=home,
        max_joint_speed_rad_s=JOINT_SPEED_RAD_S, plan_id="bench", condition="ungated",
        start_id="0",
    )  # fmt: skip
    path, failures, unreachable = path_of_plan(plan, load_robot(ROBOT.urdf_text()))
    if failures or unreachable is not None:
        message = f"the scripted plan cannot be followed: {failures}"
        raise RuntimeError(message)
    return path


def body_of(trial: Trial, key: str) -> SoftModel:
    """What physics gets of one toy."""
    model = trial.task.objects[key]
    if not trial.as_scene:
        return SoftModel.from_task(model)
    return SoftModel.from_lattice(scene_lattice(model.mesh or "", model.size_m), model)


@cache
def scene_lattice(mesh: str, size_m: tuple[float, float, float]) -> dict[str, np.ndarray]:
    """The lattice of a toy that was seen from all sides."""
    surface = toy_mesh(mesh, size_m)
    return lattice(shape_of_mesh(surface.vertices_m, surface.triangles).sdf)


def furnished(trial: Trial) -> World:
    """The twin's world with the trial's objects."""
    hulls = hulls_of(load_robot(ROBOT.urdf_text()))
    world = World(hulls.robot.urdf, mesh_hulls(hulls), trial.physics)
    world.add_table(0.0)
    for key in trial.task.containers:
        world.add_static(trial.task.objects[key].panels(), trial.Ts_base_object[key])
    for key in trial.task.soft_objects:
        world.soft_bodies().add(key, body_of(trial, key), trial.Ts_base_object[key])
    return world


def replayed(trial: Trial) -> tuple[dict[str, Toy], float, float]:
    """Run a trial in the twin: how the toys ended, simulated seconds, CPU seconds."""
    with furnished(trial) as world:
        path, dt = trial.path, 1.0 / trial.physics.rate_hz
        steps = int((path.end_ns() * 1e-9 + SETTLE_S) / dt)
        times = (np.arange(steps + 1) * dt * 1e9).astype(np.int64)
        targets, widths = path.joints_at(times), path.width_at(times)
        velocities = np.diff(targets, axis=0) / dt
        world.reset_robot(targets[0], float(widths[0]))
        highest = dict.fromkeys(trial.task.soft_objects, 0.0)
        before = time.process_time()
        spent = 0.0
        for step in range(steps):
            world.robot.command(targets[step + 1], velocities[step], float(widths[step]))
            world.step()
            if step % 24 == 0:
                paused = time.process_time()
                for key in highest:
                    z = float(np.mean(world.soft_bodies().nodes_m(key)[:, 2]))
                    highest[key] = max(highest[key], z)
                spent += time.process_time() - paused
        cpu_s = time.process_time() - before - spent
        toys = {key: _judge(world, trial, key, highest[key]) for key in highest}
    return toys, steps * dt, cpu_s


def _judge(world: World, trial: Trial, key: str, highest_m: float) -> Toy:
    model = body_of(trial, key)
    nodes, T = world.soft_bodies().nodes_m(key), world.T_base_object(key)
    off = (nodes - T[:3, 3]) @ T[:3, :3] - model.nodes_m
    container = trial.task.objects[trial.task.containers[0]]
    T_box = trial.Ts_base_object[trial.task.containers[0]]
    return Toy(
        held=highest_m > trial.Ts_base_object[key][2, 3] + LIFTED_M,
        placed=inside(T, T_box, container) and not world.finger_touches(key),
        num_inverted=world.soft_bodies().health(key).num_inverted,
        extents_off=float(np.abs(world.soft_bodies().extents_m(key) / model.size_m - 1).max()),
        shape_error_m=float(np.linalg.norm(off, axis=1).max()),
    )


def inside(T: np.ndarray, T_box: np.ndarray, container: ObjectModel) -> bool:
    """Whether the middle of a toy is in the cavity."""
    local = T_box[:3, :3].T @ (T[:3, 3] - T_box[:3, 3])
    centre = np.array([0.0, 0.0, container.wall_m + container.inner_m[2] / 2])
    return bool(np.all(np.abs(local - centre) <= np.array(container.inner_m) / 2))


def main() -> None:
    """Speed, then quality."""
    trials = int(sys.argv[1]) if len(sys.argv) > 1 else TRIALS
    first = int(sys.argv[2]) if len(sys.argv) > 2 else FIRST_SEED
    sloth = load_task("sloth_into_basket")
    tasks = {
        "duck": one_duck(),
        "sloth": sloth,
        AS_SCENE: sloth,
        "five ducks": load_task("five_ducks_into_basket"),
    }
    targets = []
    for name, task in tasks.items():
        trial = draw_trial(task, first, varied=False, as_scene=name == AS_SCENE)
        rates = []
        for _ in range(3 if name != "five ducks" else 2):
            toys, simulated_s, cpu_s = replayed(trial)
            rates.append(simulated_s / cpu_s)
        placed = sum(toy.held and toy.placed for toy in toys.values())
        targets.append(
            Target(what=f"{name}: times real time", measured=statistics.median(rates),
                   limit=SPEED[name], unit="x", at_most=False,
                   reference=f"{placed} of {len(toys)} held and placed, {simulated_s:.0f} s")
        )  # fmt: skip
    for name in ("duck", "sloth", AS_SCENE):
        targets += quality(name, [
            next(iter(replayed(
                draw_trial(tasks[name], seed, varied=True, as_scene=name == AS_SCENE)
            )[0].items()))[1]
            for seed in range(first, first + trials)
        ])  # fmt: skip
    report_targets("replay_soft", targets, note=NOTE)


def quality(name: str, toys: list) -> list[Target]:
    """The lines for one toy."""
    done = [toy for toy in toys if toy.held and toy.placed]
    return [
        Target(what=f"{name}: held and placed", measured=len(done) / len(toys), limit=NEEDED,
               at_most=False, reference=f"{len(done)} of {len(toys)}"),
        Target(what=f"{name}: inverted elements", limit=0,
               measured=float(sum(toy.num_inverted for toy in toys))),
        Target(what=f"{name}: extents off, largest", limit=0.10,
               measured=max(toy.extents_off for toy in toys)),
        Target(what=f"{name}: shape error, largest", limit=5.0, unit="mm",
               measured=max(toy.shape_error_m for toy in toys) * 1e3),
    ]  # fmt: skip


if __name__ == "__main__":
    main()
