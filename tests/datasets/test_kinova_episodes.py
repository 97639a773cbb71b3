"""The Kinova runs: values equal to the files, and the conventions settled by numbers."""

import csv
import os
from pathlib import Path

import numpy as np
import pytest
from kinova_data import episodes as kinova

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import pose_track
from bridge.errors import PathNotFoundError
from bridge.geometry import se3
from bridge.task.scripted_motion import RECORD_NAME, ScriptedMotion

CUBE_TOPIC, TCP_TOPIC = kinova.CUBE_TOPIC, kinova.TCP_TOPIC
KinovaFormatError = kinova.KinovaFormatError
find_runs, import_runs = kinova.find_runs, kinova.import_runs
read_real_run, read_sim_run = kinova.read_real_run, kinova.read_sim_run
scripted_motion = kinova.scripted_motion

BESIDE = Path(__file__).parents[3] / "shared" / "data"
DATA = Path(os.environ.get("GST_SHARED_DATA", BESIDE))
FOLDER = DATA / "robot_realitygap_kinova_real_vs_sim"
needs_data = pytest.mark.skipif(
    not FOLDER.is_dir(), reason=f"{FOLDER} is not on this machine (set GST_SHARED_DATA)"
)


def body(x: float, seen: bool = True) -> list[str]:
    rotation = np.eye(3).ravel() if seen else np.zeros(9)
    return [str(v) for v in (x, 2.0, 3.0, 0.0, 0.0, 0.0, 0.5, *rotation)] + [""]


def write_folder(folder: Path, rows: int = 3, seen: bool = True) -> Path:
    real = folder / "real" / "Experiment1"
    sim = folder / "sim" / "Experiment1"
    real.mkdir(parents=True)
    sim.mkdir(parents=True)
    lines = []
    for n in range(rows):
        cells = [str(n + 1), f"{n * 0.01:.5f}", *body(0.0), *body(100.0 + n), *body(500.0, seen)]
        lines.append("\t".join(cells))
    (real / "Single0001_6D.tsv").write_text("\n".join(lines) + "\n")
    (sim / "Single_PyBullet_3.csv").write_text("0 0 1 0 0 0 1 0 0 0 0 0 0 1\n" * 5)
    (sim / "Single_Mujoco_3.csv").write_text("0,0,1,1,0,0,0,0,0,0,1,0,0,0\n" * 5)
    return folder


def test_a_made_folder_becomes_episodes_that_say_what_they_are(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run")
    files = [path for path, _ in import_runs(write_folder(tmp_path / "data"), run)]
    real, *simulated = [Episode.open(path) for path in files]
    assert (real.path.name, real.info.kind, real.info.task) == (
        "single_0001.mcap",
        "imported",
        "single",
    )
    np.testing.assert_allclose(pose_track(real, TCP_TOPIC).p_m[:, 0], [0.1, 0.101, 0.102])
    assert pose_track(real, TCP_TOPIC).stamps_ns.tolist() == [0, 10_000_000, 20_000_000]
    assert sorted(str(episode.derived.engine) for episode in simulated) == ["mujoco", "pybullet"]
    for episode in simulated:
        derived = episode.derived
        assert derived is not None
        assert (derived.kind, derived.trajectory, derived.mode) == ("replay", "planned", "dynamic")
        assert derived.source_episode == ""
        assert derived.settings["pairing"] == "unpaired, no time column: normalised time"
        assert episode.path.parent.name == "derived"
        track = pose_track(episode, TCP_TOPIC)
        assert track.stamps_ns.tolist() == [0, 5_000_000, 10_000_000, 15_000_000, 20_000_000]
        np.testing.assert_allclose(track.q_wxyz, [[1, 0, 0, 0]] * 5)


def test_importing_twice_changes_nothing(tmp_path: Path, run: RunFolder) -> None:
    folder = write_folder(tmp_path / "data")
    first = {path: path.read_bytes() for path, _ in import_runs(folder, run)}
    assert {path: path.read_bytes() for path, _ in import_runs(folder, run)} == first


def test_samples_in_which_a_body_was_not_seen_are_left_out(tmp_path: Path, run: RunFolder) -> None:
    folder = write_folder(tmp_path / "data", seen=False)
    path, made = next(import_runs(folder, run))
    assert made.num_lost[CUBE_TOPIC] == 3
    assert CUBE_TOPIC not in Episode.open(path).topics()
    assert Episode.open(path).metadata_records["source"]["samples_left_out"][CUBE_TOPIC] == 3


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "data")
    (path,) = (folder / "real" / "Experiment1").iterdir()
    whole = path.read_text()
    path.write_text(whole + "4\t0.03\n")
    with pytest.raises(KinovaFormatError, match=r"Single0001_6D.tsv: line 4 has 2 columns"):
        read_real_run(path)
    path.write_text(whole.replace("101.0", "abc"))
    with pytest.raises(KinovaFormatError, match="line 2: could not convert"):
        read_real_run(path)
    path.write_text("")
    with pytest.raises(KinovaFormatError, match="0 rows of data"):
        read_real_run(path)
    with pytest.raises(PathNotFoundError, match="real runs not found"):
        find_runs(tmp_path)


def test_a_file_that_cannot_be_used_is_listed_and_the_others_are_imported(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "data")
    sim = folder / "sim" / "Experiment1"
    (sim / "Single_VRepODE_0.csv").write_text("1e15 0 1 0 0 0 1 0 0 0 0 0 0 1\n" * 5)
    (sim / "Single_Gazebo_0.csv").write_text("0 0 1 0 0 0 1 0 0 0 0 0 0 1\n" * 5)
    (sim / "CubeExp_PyBullet_0.csv").write_text("0 0 1 0 0 0 1 0 0 0 0 0 0 1\n" * 5)
    (folder / "real" / "Experiment1" / "Single0002_6D.tsv").write_text("")
    skipped: list[Exception] = []
    files = list(import_runs(folder, RunFolder.create(tmp_path / "run"), skipped))
    assert len(files) == 3
    assert [fault.path.name for fault in skipped] == [
        "Single0002_6D.tsv",
        "CubeExp_PyBullet_0.csv",
        "Single_Gazebo_0.csv",
        "Single_VRepODE_0.csv",
    ]
    assert "1e+15 m: the simulation exploded" in str(skipped[-1])
    (folder / "real" / "Experiment1" / "Single0001_6D.tsv").write_text("")
    with pytest.raises(KinovaFormatError, match="0 rows of data"):
        list(import_runs(folder, RunFolder.create(tmp_path / "none")))


@needs_data
@pytest.mark.slow
def test_recorded_values_equal_the_rows_of_the_file(run: RunFolder) -> None:
    path, _ = next(import_runs(FOLDER, run))
    source = FOLDER / "real" / "Experiment1" / "Single0001_6D.tsv"
    with source.open(newline="") as stream:
        rows = list(csv.reader(stream, delimiter="\t"))
    for topic, start in ((TCP_TOPIC, 19), (CUBE_TOPIC, 36)):
        track = pose_track(Episode.open(path), topic)
        assert len(track) == len(rows)
        for k in (0, 100, len(rows) - 1):
            expected_m = [float(cell) / 1000 for cell in rows[k][start : start + 3]]
            np.testing.assert_allclose(track.p_m[k], expected_m, atol=1e-12)
            assert track.stamps_ns[k] == round(float(rows[k][1]) * 1e9)
            # Roll, pitch and yaw stand in other columns than the matrix we read.
            angles = np.deg2rad([float(cell) for cell in rows[k][start + 3 : start + 6]])
            R = se3.rotation_from_quaternion(track.q_wxyz[k])
            np.testing.assert_allclose(R, rotation_of(angles), atol=2e-5)


def rotation_of(roll_pitch_yaw_rad: np.ndarray) -> np.ndarray:
    made = np.eye(3)
    for axis, angle in enumerate(roll_pitch_yaw_rad):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        R = np.eye(3)
        R[i, i] = R[j, j] = np.cos(angle)
        R[j, i], R[i, j] = np.sin(angle), -np.sin(angle)
        made = made @ R
    return made


def spread_deg(Ts_world_sim: np.ndarray, Ts_world_real: np.ndarray) -> float:
    """How much the simulated and the real orientation differ beside a constant offset.

    Samples are paired by the share of the path already travelled; the files have no common clock.
    """
    along = []
    for T in (Ts_world_sim, Ts_world_real):
        steps = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
        along.append(np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum())
    nearest = np.abs(along[1][None, :] - along[0][:, None]).argmin(axis=1)
    R_sim_real = np.swapaxes(Ts_world_sim[:, :3, :3], 1, 2) @ Ts_world_real[nearest][:, :3, :3]
    u, _, v = np.linalg.svd(R_sim_real.mean(axis=0))
    mean = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    angles = np.arccos(((np.einsum("nij,ij->n", R_sim_real, mean) - 1) / 2).clip(-1, 1))
    return float(np.rad2deg(np.median(angles)))


@needs_data
@pytest.mark.parametrize(
    "engine", ["PyBullet", "Mujoco", "VRepBullet278", "VRepBullet283", "VRepNewton", "VRepVortex"]
)
def test_the_quaternion_order_is_the_one_that_agrees_with_the_real_robot(engine: str) -> None:
    real = read_real_run(FOLDER / "real" / "Experiment1" / "Single0001_6D.tsv")
    path = FOLDER / "sim" / "Experiment1" / f"Single_{engine}_0.csv"
    simulated = read_sim_run(path, 7.5).Ts_world_body
    assert spread_deg(simulated[TCP_TOPIC], real.Ts_world_body[TCP_TOPIC]) < 5.0
    if engine != "Mujoco":  # the other order is far off
        rows = np.array(
            [
                [float(cell) for cell in line.replace(",", " ").split()]
                for line in path.read_text().splitlines()
            ]
        )
        other = se3.transform_from(rows[:, 3:7], rows[:, :3])
        assert spread_deg(other, real.Ts_world_body[TCP_TOPIC]) > 15.0
    else:  # by the turn alone both orders agree; the tool's axis and the lying cube decide
        z_real, z_sim = (T[TCP_TOPIC][0, :3, :3] for T in (real.Ts_world_body, simulated))
        assert np.einsum("ij,ij->j", z_real, z_sim).min() > 0.99
    # V-REP writes its first row after a step, in which the cube settles by a few microradians
    atol = 1e-5 if engine.startswith("VRep") else 1e-6
    np.testing.assert_allclose(simulated[CUBE_TOPIC][0, :3, :3], np.eye(3), atol=atol)


def test_real_runs_say_what_the_arm_was_told_and_the_robot_comes_along(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "data")
    meshes = folder / "robot" / "meshes"
    meshes.mkdir(parents=True)
    (folder / "robot" / "m1n6s300.urdf").write_text("<robot name='m'/>")
    (meshes / "base.STL").write_bytes(b"solid")
    (meshes / "base.STL").chmod(0o444)
    run = RunFolder.create(tmp_path / "run")
    [(real, _), *simulated] = import_runs(folder, run)
    motion = ScriptedMotion.from_record(Episode.open(real).record(RECORD_NAME))
    assert motion == scripted_motion("single")
    assert (run.path / motion.robot).read_text() == "<robot name='m'/>"
    copied = run.path / "robot" / "meshes" / "base.STL"
    assert copied.read_bytes() == b"solid"
    assert copied.stat().st_mode & 0o200
    for path, _ in simulated:
        assert Episode.open(path).record(RECORD_NAME) == {}
    # Before the robot was given, a run is imported all the same.
    bare = RunFolder.create(tmp_path / "bare")
    list(import_runs(write_folder(tmp_path / "without"), bare))
    assert not (bare.path / "robot").exists()


def test_the_schedule_ends_where_the_authors_sent_the_joints() -> None:
    motion = scripted_motion("cubeexp")
    assert motion is not None
    _, joints = motion.joint_path_rad()
    np.testing.assert_allclose(np.rad2deg(joints[-1]), [0, -67, 30, 90, 0, 0], atol=1e-6)
    assert motion.boxes["cube"].mass_kg == 0.0884
    assert scripted_motion("juggling") is None


def test_the_script_says_what_it_made_and_draws_the_bands(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, run, bands = write_folder(tmp_path / "data"), tmp_path / "run", tmp_path / "bands.svg"
    assert kinova.main([str(folder), str(run), "--bands", str(bands)]) == 0
    assert "1 real and 2 simulated runs" in capsys.readouterr().out
    assert b"</svg>" in bands.read_bytes()
    assert kinova.main([str(tmp_path / "none"), str(run)]) == 1
    assert "real runs not found" in capsys.readouterr().err


def test_a_band_reaches_two_root_mean_squares_and_lies_as_far_as_the_mean_curves() -> None:
    line = np.linspace(0.0, 1.0, 101)[:, None] * np.array([1.0, 0.0, 0.0])
    recorded = np.stack([line + np.array([0, 0.01, 0]), line - np.array([0, 0.01, 0])])
    distance_m, reach_m = kinova.band_of(recorded, line[None] + np.array([0, 0, 0.03]))
    np.testing.assert_allclose(distance_m, 0.03)
    np.testing.assert_allclose(reach_m, 2 * np.sqrt(2 * 0.01**2))
