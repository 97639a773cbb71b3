"""The laboratory that hides more: what is published stays wrong, frozen cells stay as they were."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from bridge.episode.topics import is_truth
from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.sources.standin.cell import StandinCell
from bridge.sources.standin.cell_file import CellFile, HiddenParameters, draw_hidden, load_cell
from bridge.sources.standin.deviations import TILTED_ABOUT_M, Lens
from bridge.sources.standin.streams import Streams
from bridge.sources.standin.world import World, build_model, robot_links, true_links
from bridge.task.task_file import Task, load_task

SEED = 9_000_000
LABS = range(SEED, SEED + 4)
COMPILED = (
    *("body_pos", "body_quat", "body_mass", "body_inertia", "body_ipos"),
    *("geom_pos", "geom_quat", "geom_size", "geom_friction", "geom_solref", "geom_solimp"),
    *("jnt_range", "dof_armature", "dof_damping", "dof_frictionloss"),
    *("actuator_gainprm", "actuator_biasprm", "actuator_forcerange"),
)
FROZEN = {
    # Made with the code before there was a laboratory.
    ("standin", "cube_into_box", 9_000_000): "901ed8c432f8ea85",
    ("standin", "cube_into_box", 9_000_001): "699f5a73d1a2383a",
    ("standin", "cube_into_box", 1_000_003): "37050c9048cd1775",
    ("standin_toys", "sloth_into_basket", 9_000_000): "1295baffc40ee073",
    ("standin_toys", "sloth_into_basket", 9_000_001): "53161799751d778c",
    ("standin_toys", "sloth_into_basket", 1_000_003): "5001762ac7c3f5ed",
    ("standin_toys_steady", "five_ducks_into_basket", 9_000_000): "a4db837615d8bfa1",
    ("standin_toys_steady", "five_ducks_into_basket", 9_000_001): "1b906df8f9fcd041",
    ("standin_toys_steady", "five_ducks_into_basket", 1_000_003): "943dc1ddc0d883cc",
}


def digest(cell_name: str, task_name: str, seed: int) -> str:
    """Of a draw of hidden parameters and of the numbers of the model compiled with it."""
    file = load_cell(cell_name)
    hidden = draw_hidden(file, seed)
    model: Any = build_model(load_task(task_name), hidden, file.clutter)
    parts = [json.dumps(hidden.to_record(), sort_keys=True).encode()]
    # Rounded: other builds of the engine may differ in the last digit. Adding 0 turns -0 into 0.
    parts += [(np.round(getattr(model, name), 9) + 0.0).tobytes() for name in COMPILED]
    parts.append(repr((model.opt.timestep, model.opt.integrator, model.opt.enableflags)).encode())
    return hashlib.sha256(b"".join(parts)).hexdigest()[:16]


@pytest.mark.parametrize("row", list(FROZEN), ids=lambda row: f"{row[0]}-{row[2]}")
def test_frozen_cells_are_what_they_were(row: tuple[str, str, int]) -> None:
    assert digest(*row) == FROZEN[row]


@pytest.fixture(scope="module")
def stack() -> Task:
    return load_task("stack_two_cubes")


def hidden_of(lab: CellFile, task: Task, seed: int = SEED) -> HiddenParameters:
    found = draw_hidden(lab, seed, task)
    assert found.deviations is not None
    return found


def cell_of(
    lab: CellFile, task: Task, session: Any, hidden: HiddenParameters, scale: float = 0.25
) -> StandinCell:
    how = {"rate_hz": 0.0, "scale": scale, "seed": SEED, "start_ns": 0}
    return StandinCell(lab, task, hidden, Streams(session, "lab"), **how)


def test_a_draw_is_the_seeds_and_the_tasks(lab: CellFile, stack: Task) -> None:
    first = hidden_of(lab, stack).to_record()
    assert first == hidden_of(lab, stack).to_record()
    assert first["deviations"] != hidden_of(lab, stack, SEED + 1).to_record()["deviations"]
    json.dumps(first)
    slippery = load_task("slippery_block_into_box")
    low, high = lab.ranges_of["slippery_block_into_box"]["finger_friction"]
    for seed in LABS:
        assert low <= draw_hidden(lab, seed, slippery).finger_friction <= high
        # What the task does not change is the same laboratory's.
        assert (
            draw_hidden(lab, seed, slippery).mass_scale == draw_hidden(lab, seed, stack).mass_scale
        )


def test_each_start_has_objects_of_its_own_in_one_laboratory(make_session: type) -> None:
    mixed, task = load_cell("lab_mixed"), load_task("heavy_block_into_box")
    cell, met = cell_of(mixed, task, make_session(), hidden_of(mixed, task)), []
    for start in (7, 8, 7):
        cell.take_objects(start)
        record = cell.hidden.to_record()
        own = [record.pop(name) for name in mixed.each_start]
        block = record["deviations"]["objects"].pop("block")
        size = np.array(task.objects["block"].size_m) * block["size_scale"]
        assert cell.world.task.objects["block"].size_m == pytest.approx(size)
        met.append((record, own, block))
    first, other, again = met
    assert first == again
    assert [a == b for a, b in zip(first, other, strict=True)] == [True, False, False]


def test_a_laboratory_hides_everything_or_nothing(tmp_path: Path) -> None:
    path = tmp_path / "half.toml"
    path.write_text(
        'schema_version = 1\nname = "half"\nlike = "standin"\n'
        "[hidden.deviations]\ntable_height_m = [0.0, 0.01]\n"
    )
    with pytest.raises(UsageError, match=r"hidden\.deviations: .*table_tilt_rad.* missing"):
        load_cell(str(path))


def test_published_values_stay_nominal_and_truth_goes_to_its_topic(
    lab: CellFile, stack: Task, make_session: Callable[..., Any]
) -> None:
    told = []
    for hidden in (hidden_of(lab, stack), replace(hidden_of(lab, stack), deviations=None)):
        session = make_session()
        cell_of(lab, stack, session, hidden).announce()
        told.append(session)
    known, plain = ([(i.topic, i.data) for i in s.sent if not is_truth(i.topic)] for s in told)
    assert known == plain
    truth = [item for item in told[0].sent if is_truth(item.topic)]
    assert any(b"table_height_m" in item.data for item in truth)


def test_the_true_task_is_the_worlds_and_the_published_one_the_planners(
    lab: CellFile, make_session: Callable[..., Any]
) -> None:
    task = load_task("slippery_block_into_box")
    hidden = hidden_of(lab, task)
    cell = cell_of(lab, task, make_session(), hidden)
    assert cell.task == task
    known = hidden.deviations.objects
    true = cell.world.task.objects
    size = np.array(true["block"].size_m) / task.objects["block"].size_m
    assert size == pytest.approx(known["block"].size_scale)
    inner = np.array(true["box"].inner_m) / task.objects["box"].inner_m
    assert inner == pytest.approx(known["box"].size_scale)
    assert true["box"].wall_m == task.objects["box"].wall_m


@pytest.mark.parametrize("seed", LABS)
def test_the_model_has_what_was_drawn(lab: CellFile, stack: Task, seed: int) -> None:
    hidden = hidden_of(lab, stack, seed)
    deviations = hidden.deviations
    model: Any = build_model(deviations.true_task(stack), hidden, ())
    for key in ("cube", "lower"):
        own, published = deviations.objects[key], stack.objects[key]
        size = np.array(published.size_m) * own.size_scale
        geoms = [model.geom(f"{key}_{k}") for k in range(3)]
        reach = np.max([g.pos + g.size for g in geoms], axis=0)
        assert reach == pytest.approx(size / 2)
        face = np.min([g.size for g in geoms], axis=0)  # the narrowest across each axis
        assert face == pytest.approx(size / 2 - own.rebate_m)
        body = model.body(key)
        assert body.mass[0] == pytest.approx(published.mass_kg * hidden.mass_scale)
        assert body.ipos == pytest.approx(np.array(own.centre_of_mass) * size / 2)
    assert model.geom("gripper_left_finger_0").solref[0] == deviations.pad_time_s
    joints = [link.joint for link in robot_links() if link.joint_type == "revolute"]
    drag = [float(model.joint(name).frictionloss[0]) for name in joints]
    assert drag == pytest.approx(deviations.joint_drag_Nm)


def test_links_and_pads_are_longer_by_what_was_drawn(lab: CellFile, stack: Task) -> None:
    deviations = hidden_of(lab, stack).deviations
    for published, true in zip(robot_links(), true_links(deviations), strict=True):
        length = [float(np.linalg.norm(x.T_parent_link[:3, 3])) for x in (published, true)]
        longer_m = deviations.link_length_m.get(published.name, 0.0)
        assert length[1] - length[0] == pytest.approx(longer_m, abs=1e-12)
    pads = {x.name: x.shapes[0] for x in true_links(deviations) if x.name.endswith("_finger")}
    inner = {
        name: float(s.T_link_shape[1, 3] - np.sign(s.T_link_shape[1, 3]) * s.box_m[1] / 2)
        for name, s in pads.items()
    }
    assert list(inner.values()) == pytest.approx([deviations.finger_shift_m] * 2)
    assert {s.box_m[2] for s in pads.values()} == {0.07 + deviations.finger_length_m}


def test_things_rest_on_the_true_table(lab: CellFile, stack: Task) -> None:
    hidden = replace(hidden_of(lab, stack, SEED + 1), object_friction=0.6)
    world = World(stack, hidden)
    T_base_table = hidden.deviations.T_base_table
    middle = se3.apply(T_base_table, np.array(TILTED_ABOUT_M))
    assert middle == pytest.approx([*TILTED_ABOUT_M[:2], hidden.deviations.table_height_m])
    poses = hidden.deviations.put_down(world.task, stack.draw_start(np.random.default_rng(SEED)))
    world.reset(np.array([0.0, -1.5, 1.5, -1.5, -1.5, 0.0]), poses)
    for _ in range(150):
        world.step()
    for key, T in world.Ts_base_object().items():
        height = se3.apply(se3.invert(T_base_table), T[:3, 3])[2]
        assert height == pytest.approx(world.task.objects[key].size_m[2] / 2, abs=3e-4)
        assert np.linalg.norm(T[:3, 3] - poses[key][:3, 3]) < 1e-3


def test_a_motor_that_turns_within_the_play_does_not_move_its_link(
    lab: CellFile, stack: Task
) -> None:
    drawn = hidden_of(lab, stack)
    play = 0.01
    hidden = replace(
        drawn, latency_s=0.0, deviations=replace(drawn.deviations, joint_backlash_rad=(play,) * 6)
    )
    world = World(stack, hidden)
    rest = np.array([0.0, -1.5, 1.5, -1.5, -1.5, 0.0])
    world.reset(rest, stack.draw_start(np.random.default_rng(SEED)))
    targets = []
    for shift in (0.004, -0.004, 0.02, 0.012, 0.008):
        world.command(rest + shift, 0.08)
        link = rest + shift - world.slack_rad
        targets.append(float(link[0]))
        assert np.abs(world.slack_rad).max() <= play / 2 + 1e-12
    # By hand: free within 5 mrad to either side, then dragged along, then free again.
    assert targets == pytest.approx([0.0, 0.0, 0.015, 0.015, 0.013])


def test_a_lens_undone_is_the_published_pinhole() -> None:
    camera = Camera(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0)
    lens = Lens(**vars(camera), k1=-0.06, k2=0.02)
    rays = lens.rays()[..., :2]
    r2 = np.sum(rays**2, axis=-1, keepdims=True)
    assert rays * (1 + lens.k1 * r2 + lens.k2 * r2**2) == pytest.approx(
        camera.rays()[..., :2], abs=1e-7
    )
    assert Lens(**vars(camera), k1=0.0, k2=0.0).rays() == pytest.approx(camera.rays())


def test_a_lip_narrows_the_opening_and_a_container_stands_askew(lab: CellFile) -> None:
    task = load_task("heavy_block_into_box")
    hidden = hidden_of(lab, task)
    own = hidden.deviations.objects["box"]
    true = hidden.deviations.true_task(task)
    model: Any = build_model(true, hidden, ())
    lips = [model.geom(f"box_{k}") for k in range(5, 9)]
    opening = min(abs(g.pos[1]) - g.size[1] for g in lips if abs(g.pos[1]) > 0.01)
    assert opening == pytest.approx(true.objects["box"].inner_m[1] / 2 - own.lip_m)
    declared = task.draw_start(np.random.default_rng(SEED))
    moved = se3.invert(declared["box"]) @ hidden.deviations.put_down(true, declared)["box"]
    assert np.linalg.norm(moved[:2, 3]) > 1e-4
    assert mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "box") > 0


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
def test_cameras_see_the_true_laboratory(
    lab: CellFile, stack: Task, make_session: Callable[..., Any]
) -> None:
    """What changes only what is hidden changes the picture, and never the calibration."""
    drawn = hidden_of(lab, stack)
    deviations = drawn.deviations
    changes = {
        "lens": replace(
            deviations, lenses=dict.fromkeys(deviations.lenses, (1.0, 0.0, 0.0, 0.0, 0.0))
        ),
        "table": replace(deviations, table_height_m=deviations.table_height_m + 0.01),
        "size": replace(
            deviations,
            objects={
                key: replace(own, size_scale=(1.2, 1.2, 1.2))
                for key, own in deviations.objects.items()
            },
        ),
    }
    seen = {}
    for name, kept in {"drawn": deviations, **changes}.items():
        session = make_session()
        cell = cell_of(lab, stack, session, replace(drawn, deviations=kept))
        cell.reset(stack.draw_start(np.random.default_rng(SEED)))
        cell.capture()
        seen[name] = session.of("/cam/side/depth/image")[0].data
    assert len(set(seen.values())) == len(seen)
