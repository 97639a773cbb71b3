"""``open``: what a stranger's input is, what it lacks, and the way to a page with a number."""

import json
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
import stranger_inputs as strangers
from commands import run
from lerobot_dataset import Dataset
from starlette.testclient import TestClient

from bridge.data_files import datasets_folder
from bridge.episode.reader import Episode
from bridge.episode.streams import recorded_robot
from dashboards.app import create_app
from dashboards.library import Library

MakeTrial = Callable[..., Path]
Say = Callable[..., str]
Rates = Callable[[Path], dict[str, float]]


@pytest.fixture
def say(capsys: pytest.CaptureFixture[str]) -> Say:
    """Run ``open`` and return what it says."""

    def said(*words: object, code: int = 0) -> str:
        capsys.readouterr()
        assert run("open", *words) == code
        shown = capsys.readouterr()
        return shown.out + shown.err

    return said


@pytest.fixture
def rates(capsys: pytest.CaptureFixture[str]) -> Rates:
    """Evaluate something; the success rate of each task."""

    def found(source: Path) -> dict[str, float]:
        capsys.readouterr()
        assert run("evaluate", source, "--json") == 0
        measured = json.loads(capsys.readouterr().out)["measurements"]
        rates = [item for item in measured if item["id"].startswith("rate.recorded.")]
        return {item["id"].split(".")[2]: item["value"] for item in rates}

    return found


def first_page(made: Path) -> str:
    app = create_app(Library.open([made]))
    with TestClient(app, base_url="http://127.0.0.1") as browser:
        return browser.get("/").text


@pytest.mark.parametrize("driver", strangers.DRIVERS)
def test_a_bag_of_a_camera_driver_can_be_rebuilt_and_says_whose_arm_is_missing(
    make_trial: MakeTrial, tmp_path: Path, say: Say, driver: str
) -> None:
    bag = strangers.camera_bag(make_trial, tmp_path / "b.mcap", driver)
    text = say(bag)
    assert "color image 30" in text
    assert "depth info" in text
    assert f"{strangers.DRIVERS[driver][0]} will be /cam/" in text
    assert "robot: none of the robot files; a, b, c, d, e and 1 more" in text
    assert "rebuild: ready" in text
    assert "replay needs a robot file with its joints" in text
    assert f"next: robot-gst open {bag} RUN" in text
    text = say(bag, tmp_path / "new")
    assert "rebuild: ready" in text
    assert f"next: robot-gst rebuild {tmp_path / 'new'}" in text


def test_a_bag_of_an_arm_in_a_database_becomes_a_trial_with_a_rate(
    make_trial: MakeTrial, tmp_path: Path, say: Say, rates: Rates
) -> None:
    bag = strangers.franka(make_trial, tmp_path / "franka")
    text = say(bag)
    assert "robot: panda, by the names of its joints (another: --map); panda_joint1" in text
    assert "and 2 more at 125 Hz on /franka/joint_states" in text
    assert "rebuild needs a calibrated camera with colour and depth" in text
    assert "replay needs the gripper's width" in text
    made = tmp_path / "new"
    step = f"label {made} franka --task NAME --result success"
    assert f"next: robot-gst {step}" in say(bag, made)
    assert run(*step.replace("NAME", "cube_into_box").split()) == 0
    assert rates(made) == {"cube_into_box": 1.0}


def test_a_bag_of_an_xarm_and_a_realsense_is_named(tmp_path: Path, say: Say) -> None:
    text = say(strangers.xarm(tmp_path / "seven", 7))
    assert (
        "robot: xarm7_parallel_gripper, by the names of its joints (another: --map); joint1" in text
    )
    assert "at 100 Hz on /xarm/joint_states" in text
    assert "camera camera_camera: color image 10 Hz, color info, depth image 10 Hz" in text
    assert "rebuild: ready" in text
    assert "a map for" not in text


def test_a_gripper_that_has_joint_states_of_its_own_is_there(tmp_path: Path, say: Say) -> None:
    bag = strangers.xarm(tmp_path / "seven", 7, gripper="/xarm_gripper")
    assert "replay: ready" in say(bag)


def test_a_map_names_what_a_bag_does_not_say(tmp_path: Path, say: Say) -> None:
    bag = strangers.xarm(
        tmp_path / "six", 6, arm="/ufactory", camera=("/head/seen", "/head/depth_seen")
    )
    text = say(bag)
    assert "robot: z1, by the names of its joints (another: --map); joint1, joint2" in text
    assert "rebuild needs" in text
    _, _, told = text.partition("a map for --map FILE, to be corrected:\n")
    proposed, _, _ = told.partition("  record needs")
    proposal = tomllib.loads(proposed)
    assert proposal["robot"] == "z1"
    names, stem = proposal["topics"], "/head/depth_seen"
    assert names[f"{stem}/image_raw"] == "/cam/head/depth/image"
    assert names[f"{stem}/camera_info"].endswith("/depth/info")
    robots, robot = datasets_folder() / "robots", tmp_path / "mine.toml"
    robot.write_text((robots / "z1.toml").read_text().replace('name = "z1"', 'name = "six"'))
    (tmp_path / "z1_tcp.urdf").write_bytes((robots / "z1_tcp.urdf").read_bytes())
    lines = [f'robot = "{robot}"', 'task = "cube_into_box"', "[topics]"]
    lines += [f'"{old}" = "{name}"' for old, name in names.items()]
    file = tmp_path / "map.toml"
    file.write_text("\n".join(lines))
    text = say(bag, tmp_path / "run", "--map", file)
    assert "robot: six; joint1" in text
    assert "camera head: color image" in text
    assert f"next: robot-gst rebuild {tmp_path / 'run'}" in text
    (path,) = (tmp_path / "run" / "episodes").iterdir()
    assert Episode.open(path).info.task == "cube_into_box"
    assert recorded_robot(Episode.open(path)).name == "six"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("topics = 3", "--map"),
        ("task = [", "Invalid value"),
        ('tasks = "a"', "unexpected keyword argument 'tasks'"),
        (None, "No such file"),
    ],
)
def test_a_map_that_is_none_is_a_clear_sentence(
    tmp_path: Path, say: Say, text: str | None, sentence: str
) -> None:
    bag, file = strangers.xarm(tmp_path / "bag", 7), tmp_path / "map.toml"
    if text is not None:
        file.write_text(text)
    said = say(bag, tmp_path / "run", "--map", file, code=2)
    assert f"robot-gst: --map {file} is not understood (" in said
    assert sentence in said
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("version", ["v3.0", "v2.1"])
def test_a_lerobot_dataset_ends_in_a_rate_of_each_of_its_tasks(
    dataset: Dataset, tmp_path: Path, say: Say, rates: Rates, version: str
) -> None:
    folder = dataset.write() if version == "v3.0" else dataset.write_v2()
    text = say(folder)
    assert f"a LeRobot dataset {version}: 3 episodes at 10 Hz" in text
    assert "robot: so100, pan, lift, grip" in text
    assert "cameras: observation.images.front, observation.images.still" in text
    assert "tasks: fold the towel, pick the cube" in text
    assert "rebuild needs depth images" in text
    assert "evaluate: ready" in text
    text = say(folder, tmp_path / "new")
    assert "a run of 3 episodes" in text
    assert "label" not in text
    assert f"next: robot-gst evaluate {tmp_path / 'new'}" in text
    assert rates(tmp_path / "new") == {"pick_the_cube": 0.5, "fold_the_towel": 1.0}
    assert "1 of 2" in first_page(tmp_path / "new")


def test_a_tum_folder_is_rebuilt_next(make_trial: MakeTrial, tmp_path: Path, say: Say) -> None:
    assert run("export", "tum", make_trial(), tmp_path / "tum") == 0
    assert "TUM layout with its own times: 12 frames" in say(tmp_path / "tum")
    (tmp_path / "tum" / "camera.json").unlink()
    assert f"import rgbd {tmp_path / 'tum'} RUN" in say(tmp_path / "tum", code=2)


def test_a_map_names_cell_and_camera_of_a_folder(
    make_trial: MakeTrial, tmp_path: Path, say: Say
) -> None:
    assert run("export", "tum", make_trial(), tmp_path / "tum") == 0
    (tmp_path / "map.toml").write_text('cell = "lab"\ncamera = "overhead"\n')
    say(tmp_path / "tum", tmp_path / "new", "--map", tmp_path / "map.toml")
    (path,) = (tmp_path / "new" / "episodes").iterdir()
    assert "/lab/cam/overhead/color/image" in Episode.open(path).topics()


def test_posed_images_are_rgbd_images_and_a_colmap_model_is_named(tmp_path: Path, say: Say) -> None:
    text = say(strangers.posed(tmp_path / "garden"))
    assert "RGB-D images, transforms.json layout without times: 2 frames" in text
    (tmp_path / "model" / "sparse").mkdir(parents=True)
    (tmp_path / "model" / "sparse" / "points3D.bin").touch()
    text = say(tmp_path / "model")
    assert "a COLMAP model, not read here" in text
    assert "rebuild needs depth images and transforms.json" in text
    assert "evaluate: ready" not in text


def test_a_spreadsheet_ends_in_a_rate(tmp_path: Path, say: Say, rates: Rates) -> None:
    book = strangers.workbook(tmp_path / "lab.xlsx")
    assert "a table of 4 trials\n  understood as lab.xlsx: " in say(book)
    text = say(book, tmp_path / "new")
    assert "a run of 0 episodes\n  a table of trials" in text
    assert rates(tmp_path / "new") == {"stack": 0.75}
    assert "3 of 4" in first_page(tmp_path / "new")
    assert "exists already" in say(book, tmp_path / "new", code=2)
    other = tmp_path / "other.csv"
    other.write_text("width,height\n1,2\n")
    assert f"Options go to: robot-gst evaluate {other}" in say(other, code=2)
    shares = tmp_path / "shares.csv"
    shares.write_text("policy,task,real,sim,n\na,stack,0.5,0.6,10\nb,stack,0.7,0.9,10\n")
    assert f"next: robot-gst evaluate {shares}" in say(shares)
    assert "It cannot be imported." in say(shares, tmp_path / "other", code=2)


def test_a_splat_says_what_it_is_compared_with(tmp_path: Path, say: Say) -> None:
    text = say(strangers.splat(tmp_path / "s.ply"))
    assert "a splat of 5 Gaussians" in text
    assert "evaluate --reference DIR --renders NAME=DIR" in text
    points = strangers.splat(tmp_path / "p.ply", fields="x y z")
    assert "a PLY file without Gaussians" in say(points)
    whole = (tmp_path / "s.ply").read_bytes()
    (tmp_path / "s.ply").write_bytes(whole[:-9])
    assert "ends early or has no PLY header" in say(tmp_path / "s.ply", code=2)


def test_what_is_not_read_is_named_with_what_converts_it(tmp_path: Path, say: Say) -> None:
    text = say(strangers.rlds(tmp_path / "bridge"))
    assert "an RLDS dataset, not read here" in text
    assert "openx2lerobot of any4lerobot makes one" in text
    assert "It cannot be imported." in say(tmp_path / "bridge", tmp_path / "new", code=2)
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(99))
    assert "rosbags-convert --src" in say(tmp_path / "a.bag")
    (tmp_path / "episode_0.hdf5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(99))
    assert "a LeRobot dataset; convert_aloha_data" in say(tmp_path / "episode_0.hdf5")


def test_a_run_says_what_comes_next(make_trial: MakeTrial, tmp_path: Path, say: Say) -> None:
    make_trial(result=None)
    text = say(tmp_path / "run")
    assert "a run of 1 episode\n" in text
    assert f"next: robot-gst rebuild {tmp_path / 'run'}" in text
    assert "evaluate needs task and outcome of 1 of 1 trials" in text
    assert f"next: robot-gst label {tmp_path / 'run'} trial_0001 --result success" in text
    assert f"open {tmp_path / 'run'}" in say(tmp_path / "run" / "episodes", code=2)
    (tmp_path / "run" / "episodes" / "broken.mcap").write_bytes(b"\x89MCAP0\r\n")
    assert "unreadable: broken" in say(tmp_path / "run")


def unfinished(folder: Path) -> Path:
    (folder / "x.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(20))
    return folder / "x.mcap"


def nothing(folder: Path) -> Path:
    (folder / "x.mcap").write_bytes(b"")
    return folder / "x.mcap"


def two_things(folder: Path) -> Path:
    (folder / "x.mcap").write_bytes(b"x")
    strangers.posed(folder)
    return folder


def things_inside(folder: Path) -> Path:
    strangers.posed(folder / "garden")
    strangers.splat(folder / "s.ply")
    return folder


def pickled(folder: Path) -> Path:
    (folder / "demo.pkl").write_bytes(b"\x80\x04N.")
    return folder / "demo.pkl"


def huge(path: Path) -> Path:
    with path.open("wb") as stream:
        stream.write(b"a,b")
        stream.truncate(1 << 40)
    return path


@pytest.mark.parametrize(
    ("make", "code", "sentence"),
    [
        (lambda folder: folder / "gone", 2, "file or folder not found"),
        (lambda folder: folder, 2, "is empty. Known are: run, bag"),
        (nothing, 2, "is empty. Known are"),
        (unfinished, 1, "robot-gst recover makes a finished copy"),
        (two_things, 2, "is a bag and a RGB-D folder at once"),
        (things_inside, 2, "holds garden (RGB-D folder), s.ply (splat). Open one"),
        (pickled, 2, "is nothing known here"),
        (lambda folder: huge(folder / "huge.bin"), 2, "is nothing known here"),
        (lambda folder: huge(folder / "huge.csv"), 2, "is larger than any table of trials"),
    ],
)
def test_bad_input_is_a_clear_sentence(
    tmp_path: Path, say: Say, make: Callable[[Path], Path], code: int, sentence: str
) -> None:
    (tmp_path / "in").mkdir()
    text = say(make(tmp_path / "in"), code=code)
    assert sentence in text
    assert len(text.splitlines()) == 1
