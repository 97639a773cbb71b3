"""Soft toys in the stand-in cell: physics, plans, pictures, truth, and sessions with them."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from standin_hidden import nominal_hidden
from standin_plans import planned

from bridge.episode import schema
from bridge.episode.cdr.messages import PointCloudSample, PoseSample
from bridge.episode.metadata import Outcome
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.sources.standin import planner
from bridge.sources.standin.cell import StandinCell, TruthLog
from bridge.sources.standin.cell_file import CellFile, HiddenParameters, draw_hidden, load_cell
from bridge.sources.standin.destination import release_slots
from bridge.sources.standin.kinematics import yaw_of
from bridge.sources.standin.operator import Operator, execute_plan, label_trial, void_trial
from bridge.sources.standin.render import Renderer
from bridge.sources.standin.session import describe, run_session
from bridge.sources.standin.settings import SessionConfig
from bridge.sources.standin.streams import Streams
from bridge.sources.standin.surfaces import clutter_surfaces, lab_surfaces, object_surfaces
from bridge.sources.standin.world import World
from bridge.task.task_file import Task, load_task
from bridge.terminal import Output

SEED = 9_000_000
HOME = np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308])
TOYS = ("sloth_into_basket", "five_ducks_into_basket")


def only(task: Task, kept: tuple[str, ...]) -> Task:
    """The same task with fewer toys; a trial of five takes a quarter of a minute."""
    keys = (*kept, *task.containers)
    return replace(
        task,
        objects={key: task.objects[key] for key in keys},
        manipulated=kept,
        start={key: task.start[key] for key in keys},
        stages=tuple(
            stage
            for stage in task.stages
            if any(stage.get(verb) in kept for verb in ("grasp", "carry", "release"))
        ),
        success=tuple(spec for spec in task.success if spec["object"] in kept),
    )


def trial(task: Task, file: CellFile, session: Any) -> tuple[Outcome, StandinCell]:
    cell = StandinCell(
        file,
        task,
        draw_hidden(file, SEED),
        Streams(session, "standin"),
        rate_hz=0.0,
        seed=SEED,
        start_ns=0,
    )
    Ts = task.draw_start(np.random.default_rng(SEED))
    cell.reset(Ts)
    cell.wait(0.2)
    execute_plan(cell, planned(task, Ts))
    return label_trial(task, cell.truth, executed=True), cell


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
def test_a_sloth_taken_at_its_waist_ends_up_in_the_basket_in_its_own_shape(
    sloth: Task, toys_cell: CellFile, make_session: Callable[..., Any]
) -> None:
    session = make_session()
    outcome, cell = trial(sloth, toys_cell, session)
    assert (outcome.result, outcome.unit, outcome.k, outcome.n) == ("success", "trial", 1, 1)
    assert [stage["result"] for stage in outcome.stages] == ["success"] * 3
    squeezed = min(float(extents[1]) for extents in cell.truth.extents_m["sloth"])
    assert squeezed < 0.098, "the grip deforms it"
    assert max(cell.truth.contact["sloth"]), "and is noticed"
    # Truth: pose and points at 30 Hz, the points around the pose.
    poses = session.of("truth/object/sloth/pose")
    clouds = session.of("truth/object/sloth/nodes")
    assert len(poses) == len(clouds) == len(cell.truth.stamps_ns)
    assert {item.type_name for item in clouds} == {schema.POINT_CLOUD}
    for pose, cloud in list(zip(poses, clouds, strict=True))[::60]:
        T = PoseSample.from_cdr(pose.data).T_frame_body
        local = se3.apply(se3.invert(T), PointCloudSample.from_cdr(cloud.data).points_m)
        assert np.abs(local).max() < 0.1
        assert np.linalg.norm(local.mean(axis=0)) < 0.02


@pytest.mark.parametrize("end", [0, 1])
@pytest.mark.parametrize("name", TOYS)
def test_toys_stand_still_and_stay_finite_at_either_end_of_every_range(
    name: str, end: int, toys_cell: CellFile
) -> None:
    task = load_task(name)
    limits = {key: pair[end] for key, pair in toys_cell.uniform.items()}
    world = World(task, replace(nominal_hidden(toys_cell), **limits), toys_cell.clutter)
    starts = task.draw_start(np.random.default_rng(SEED))
    world.reset(HOME, starts)
    for _ in range(60):
        world.step()
    for key, T in world.Ts_base_object().items():
        assert np.isfinite(T).all()
        assert np.abs(T - starts[key]).max() < 0.02
    for key in task.soft_objects:
        extents = world.extents_m(key, world.Ts_base_object()[key])
        np.testing.assert_allclose(extents, task.objects[key].size_m, rtol=0.05)
    assert not any(world.finger_contact().values())


def test_the_same_seed_gives_the_same_squeeze(
    toys_cell: CellFile, ducks: Task, make_session: Callable[..., Any]
) -> None:
    task = only(ducks, ("duck_5",))

    def log(seed: int) -> str:
        session = make_session()
        cell = StandinCell(
            toys_cell,
            task,
            draw_hidden(toys_cell, seed),
            Streams(session, "standin"),
            seed=seed,
            start_ns=0,
        )
        cell.reset(task.draw_start(np.random.default_rng(SEED)))
        cell.wait(0.2)
        return hashlib.sha256(b"".join(item.data for item in session.of("/nodes"))).hexdigest()

    assert log(9_000_001) == log(9_000_001)
    assert log(9_000_001) != log(9_000_002)


def test_a_soft_body_tells_the_pose_it_was_given(sloth: Task, toys_cell: CellFile) -> None:
    world = World(sloth, nominal_hidden(toys_cell))
    rng = np.random.default_rng(4)
    for _ in range(20):
        q = rng.normal(size=4)
        T = se3.transform_from(q / np.linalg.norm(q), rng.uniform(-0.5, 0.5, 3))
        world.reset(np.zeros(6), {"sloth": T})
        np.testing.assert_allclose(world.Ts_base_object()["sloth"], T, atol=1e-9)
        np.testing.assert_allclose(
            world.extents_m("sloth", T), sloth.objects["sloth"].size_m, atol=1e-9
        )


def test_a_turn_the_wrist_cannot_make_is_made_the_other_way_round(sloth: Task) -> None:
    Ts = sloth.draw_start(np.random.default_rng(SEED))
    turned = -1.4  # over the basket the wrist would pass its limit with this turn
    Ts["sloth"][:2, :2] = [[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]]
    closed = next(waypoint for waypoint in planned(sloth, Ts).tau if waypoint.g == 1)
    T = se3.transform_from(np.array(closed.q_wxyz), np.array(closed.p_m))
    assert yaw_of(T @ np.diag([-1.0, 1.0, -1.0, 1.0])) == pytest.approx(turned + np.pi, abs=1e-6)


def test_each_object_has_its_own_error_and_the_first_keeps_the_old_one(
    toys_cell: CellFile,
) -> None:
    noise = toys_cell.noise_for("five_ducks_into_basket")
    errors = [
        planner.draw_error(noise, start_seed=SEED, round_=1, index=index) for index in range(5)
    ]
    assert errors[0] == planner.draw_error(noise, start_seed=SEED, round_=1)
    assert len({error.along_m for error in errors}) == 5
    assert noise.release_m < toys_cell.noise_for("sloth_into_basket").release_m


def test_slots_lie_apart_in_the_cavity(ducks: Task) -> None:
    basket = ducks.objects["basket"]
    slots = np.array(release_slots(5, basket.inner_m[:2]))
    assert (np.abs(slots) < np.array(basket.inner_m[:2]) / 2 - 0.03).all()
    distance = np.linalg.norm(slots[:, None] - slots[None], axis=2)[~np.eye(5, dtype=bool)]
    assert distance.min() > 0.07
    assert release_slots(1, basket.inner_m[:2])[0].tolist() == [0.0, 0.0]


def test_a_camera_sees_the_toys_where_and_how_they_are(sloth: Task, toys_cell: CellFile) -> None:
    world = World(sloth, nominal_hidden(toys_cell), toys_cell.clutter)
    Ts = sloth.draw_start(np.random.default_rng(SEED))
    world.reset(HOME, Ts)
    camera = Camera(width=80, height=60, fx=120.0, fy=120.0, cx=40.0, cy=30.0)
    p = Ts["sloth"][:3, 3]
    eye = p + np.array([0.0, -0.001, 0.4])
    T = se3.look_at(eye, p, np.array([0.0, 0.0, 1.0]))
    lab = [*lab_surfaces(SEED), *clutter_surfaces(toys_cell.clutter)]
    renderer = Renderer([*object_surfaces(sloth), *lab])
    skins = world.skins_m()
    seen = renderer.render(camera, T, world.Ts_base_object(), None, skins)
    assert 0.33 < seen.depth_m[30, 40] < 0.39, "on the sloth's back"
    lifted = {"sloth": skins["sloth"] + [0.0, 0.0, 0.1]}
    higher = renderer.render(camera, T, world.Ts_base_object(), None, lifted)
    assert seen.depth_m[30, 40] - higher.depth_m[30, 40] == pytest.approx(0.1, abs=0.005)
    wide = {"sloth": (skins["sloth"] - p) * [1.0, 1.3, 1.0] + p}
    stretched = renderer.render(camera, T, world.Ts_base_object(), None, wide)
    assert (stretched.depth_m < 0.395).sum() > 1.15 * (seen.depth_m < 0.395).sum()


def test_a_duck_beside_the_basket_costs_one_of_five(ducks: Task) -> None:
    truth = TruthLog()
    basket = np.eye(4)
    basket[:3, 3] = [0.48, 0.22, 0.0]
    for step in range(40):
        truth.stamps_ns.append(step * 33_000_000)
        truth.poses.setdefault("basket", []).append(basket)
        for key in ducks.manipulated:
            T = basket.copy()
            T[2, 3] = 0.04 if step != 20 else 0.2
            if key == "duck_4":
                T[0, 3] += 0.3
            truth.poses.setdefault(key, []).append(T)
            truth.contact.setdefault(key, []).append(False)
            size = np.array(ducks.objects[key].size_m)
            truth.extents_m.setdefault(key, []).append(size)
    outcome = label_trial(ducks, truth, executed=True)
    assert (outcome.result, outcome.unit, outcome.k, outcome.n) == ("failure", "object", 4, 5)
    assert outcome.detail is not None
    assert "duck_4" in outcome.detail
    assert "duck_1" not in outcome.detail
    results = {stage["id"]: stage["result"] for stage in outcome.stages}
    assert results["pick_4"] == "success"
    assert results["carry_4"] == results["release_4"] == "failure"
    assert results["carry_1"] == results["release_1"] == "success"
    assert (void_trial(ducks, "nobody").unit, void_trial(ducks, "nobody").n) == ("object", 5)


def test_toys_need_their_own_cell_and_a_session_takes_the_one_its_task_names(
    make_session: Callable[..., Any],
) -> None:
    assert load_task("cube_into_box").cell == "standin"
    assert {load_task(name).cell for name in TOYS} == {"standin_toys"}
    session = make_session()
    config = SessionConfig(task="sloth_into_basket", seed=9_000, scan=False, trials=1, rate_hz=0.0)
    stop_after = 200
    summary = run_session(
        session, config, Output(quiet=True), should_stop=lambda: len(session.sent) > stop_after
    )
    assert summary["task"] == "sloth_into_basket"
    parameters = session.of("truth/parameters")
    assert "stiffness_scale" in parameters[0].data.decode(errors="replace")
    assert session.control[-1][1]["outcome"]["unit"] == "trial"


def test_a_summary_counts_objects_where_they_are_the_unit() -> None:
    summary = {
        "cell": "standin",
        "scan": False,
        "outcomes": {"without_replanning": {"failure": 2}},
        "objects": {"without_replanning": {"k": 7, "n": 10}},
        "retries": {},
        "unknown": {},
        "stopped": False,
    }
    assert "2 trials, 2 failure; 7 of 10 objects" in describe(json.loads(json.dumps(summary)))


def test_the_operator_puts_toys_down_a_little_off(
    toys_cell: CellFile, sloth: Task, make_session: Callable[..., Any]
) -> None:
    session = make_session()
    cell = StandinCell(
        toys_cell,
        sloth,
        nominal_hidden(toys_cell),
        Streams(session, "standin"),
        seed=SEED,
        start_ns=0,
    )
    operator = Operator(cell, session, SessionConfig(task=sloth.name, seed=9_000))
    declared = sloth.draw_start(np.random.default_rng(SEED))
    for key, T in operator.start_poses(SEED, "without_replanning").items():
        assert 0 < np.linalg.norm(T[:3, 3] - declared[key][:3, 3]) < 0.01


def test_hidden_stiffness_is_drawn_only_where_a_cell_has_it(toys_cell: CellFile) -> None:
    drawn: HiddenParameters = draw_hidden(toys_cell, SEED)
    assert drawn.stiffness_scale is not None
    assert 0.6 <= drawn.stiffness_scale <= 1.6
    assert "stiffness_scale" in drawn.to_record()
    assert "stiffness_scale" not in draw_hidden(load_cell("standin"), SEED).to_record()
