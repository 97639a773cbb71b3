"""Any camera at any state of robot and objects; splats edited elsewhere come back in."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import textured_room
from seen_colors import effective_colors
from small_scene import CONFIG, QUIET

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, PathNotFoundError, UsageError
from bridge.geometry import se3
from bridge.media.color import decode_color
from bridge.robots.default import ROBOT
from twin.scene import render as compose_module
from twin.scene.gaussians import (
    GaussianCloud,
    as_float32,
    moved_cloud,
    read_ply,
    write_ply,
)
from twin.scene.rebuild.run import rebuild
from twin.scene.render import compose, object_places, render
from twin.scene.robot.splats import write_links
from twin.scene.settings import RenderConfig
from twin.scene.store.folder import (
    UnreadableSceneError,
    describe_edit,
    read_record,
    read_scene,
    take_back,
    write_record,
)

pytestmark = pytest.mark.usefixtures("few_voxels")


T_BLOB = se3.transform_from(np.array([0.9, 0.1, 0.2, 0.3]), np.array([0.05, 0.1, 0.1]))
EYE = {"eye": (0.0, -0.8, 0.6), "target": (0.0, 0.1, 0.0)}
HOME = (-0.263, -1.709, 1.365, -1.227, -1.571, 1.308)


def blob(seed: int = 0, count: int = 60) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    return GaussianCloud(
        means_m=as_float32(rng.uniform(-0.05, 0.05, (count, 3))),
        quats_wxyz=as_float32(rng.normal(size=(count, 4))),
        scales_log=as_float32(np.full((count, 3), np.log(0.01))),
        opacities_logit=as_float32(np.full(count, 3.0)),
        colors=as_float32(np.tile([0.9, 0.1, 0.1], (count, 1))),
        harmonics=as_float32(rng.normal(0, 0.1, (count, 3, 3))),
    )


@pytest.fixture(scope="module")
def rebuilt_once(rebuilt_once: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small scene with one object, which stands at T_BLOB."""
    run = RunFolder(shutil.copytree(rebuilt_once, tmp_path_factory.mktemp("blob") / "monday"))
    record = read_record(run)
    assert record is not None
    place = run.scene_dir / "objects" / "blob"
    place.mkdir(parents=True)
    write_ply(place / "gaussians.ply", blob())
    q, p = se3.split(T_BLOB)
    pose = {"p_m": p.tolist(), "q_wxyz": q.tolist()}
    (place / "object.json").write_text(json.dumps({"T_base_object": pose}))
    record["objects"] = {"blob": {"folder": "objects/blob", "files": {"gaussians.ply": ""}}}
    write_record(run, record)
    return run.path


def picture(run: RunFolder, tmp_path: Path, **settings: object) -> np.ndarray:
    render(run, RenderConfig(out=tmp_path / "out.png", **{**EYE, **settings}))
    return decode_color((tmp_path / "out.png").read_bytes()).astype(float)


def text_of(T: np.ndarray) -> str:
    q, p = se3.split(T)
    return "blob=" + ",".join(repr(float(value)) for value in [*p, *q])


def test_an_object_put_where_it_was_changes_nothing(room: RunFolder, tmp_path: Path) -> None:
    plain = picture(room, tmp_path)
    same = picture(room, tmp_path, object=(text_of(T_BLOB),))
    moved = picture(room, tmp_path, object=("blob=-0.2,0.1,0.1",))
    np.testing.assert_allclose(same, plain, atol=1)
    assert np.abs(moved - plain).max() > 60


def test_all_that_moves_with_the_camera_looks_the_same() -> None:
    """Colour depends on direction in the object: harmonics turn with it."""
    T = se3.transform_from(np.array([0.6, 0.3, -0.5, 0.2]), np.array([0.3, 0.2, 0.1]))
    eye = np.array([0.4, -0.3, 0.2])
    there = effective_colors(moved_cloud(blob(), T), se3.apply(T, eye[None])[0])
    np.testing.assert_allclose(there, effective_colors(blob(), eye), atol=1e-5)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("cup=0,0,0", "no object 'cup'. It has: blob"),
        ("blob", "is not a pose"),
        ("blob=1,2", "is not a pose"),
        ("blob=a,b,c", "is not a pose"),
        ("blob=nan,0,0", "is not a pose"),
        ("blob=0,0,0,0,0,0,0", "is not a pose"),
    ],
)
def test_a_place_that_is_none_is_refused(text: str, found: str) -> None:
    with pytest.raises(UsageError, match=found):
        object_places([text], ["blob"])


def test_joints_for_a_scene_without_robot_are_refused_in_one_sentence(
    room: RunFolder, tmp_path: Path
) -> None:
    assert "no robot splats" in render(room, RenderConfig(out=tmp_path / "a.png"))["robot"]
    with pytest.raises(UsageError, match="no robot splats"):
        render(room, RenderConfig(out=tmp_path / "a.png", joints=HOME))


def test_seconds_count_from_the_first_stamp_whenever_messages_arrived(
    room: RunFolder, tmp_path: Path
) -> None:
    textured_room.write_episode(
        room.episodes_dir / "late.mcap", num_frames=9, sent_late_ns=3_600_000_000_000
    )
    for name in ("scan", "late"):
        out = tmp_path / f"{name}.png"
        render(room, RenderConfig(episode=name, at_s=0.4, out=out))
    assert (tmp_path / "late.png").read_bytes() == (tmp_path / "scan.png").read_bytes()
    render(room, RenderConfig(episode="late", at_s=0.8, out=tmp_path / "end.png"))
    assert (tmp_path / "end.png").read_bytes() != (tmp_path / "late.png").read_bytes()


@pytest.fixture
def with_robot(room: RunFolder, monkeypatch: pytest.MonkeyPatch) -> RunFolder:
    scene = read_scene(room)
    links = {"base_link": blob(1), "tool0": blob(2)}
    write_record(room, {**scene.record, "robot": {"links": write_links(room, links)}})
    urdf = ROBOT.urdf_text()
    monkeypatch.setattr(compose_module.streams, "robot_description", lambda _episode: urdf)
    return room


def test_given_joints_move_the_hand_and_not_the_base(with_robot: RunFolder) -> None:
    episode = Episode.open(with_robot.episodes_dir / "scan.mcap")
    scene = read_scene(with_robot)

    def robot(*joints: float) -> np.ndarray:
        config = RenderConfig(joints=joints)
        composed = compose(with_robot, scene, episode, episode.start_ns, config)
        assert composed.robot == "joints given"
        return composed.cloud.means_m[-120:]

    before, after = robot(*HOME), robot(HOME[0] + 0.5, *HOME[1:])
    np.testing.assert_allclose(after[:60], before[:60], atol=1e-6)
    c, s = np.cos(0.5), np.sin(0.5)
    turned = before[60:] @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(after[60:], turned, atol=1e-5)


def test_a_robot_without_recorded_joints_is_left_out_with_a_reason(
    with_robot: RunFolder, tmp_path: Path
) -> None:
    drawn = render(with_robot, RenderConfig(out=tmp_path / "a.png"))
    assert drawn["robot"].startswith("not drawn: ")
    with pytest.raises(UsageError, match="--joints takes 6 angles"):
        render(with_robot, RenderConfig(joints=(0.0, np.nan, 0.0, 0.0, 0.0, 0.0)))


def foreign_ply(path: Path, cloud: GaussianCloud, num_rest: int) -> None:
    """As other programs write it: no normals, a comment, harmonics of any degree."""
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{index}" for index in range(num_rest)]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    lines = ["ply", "format binary_little_endian 1.0", "comment made by an editor"]
    lines += [f"element vertex {len(cloud)}", *(f"property float {name}" for name in names)]
    parts = [cloud.means_m, cloud.colors, np.zeros((len(cloud), num_rest))]
    parts += [cloud.opacities_logit[:, None], cloud.scales_log, cloud.quats_wxyz]
    table = np.concatenate(parts, axis=1).astype("<f4")
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + table.tobytes())


@pytest.mark.parametrize("num_rest", [0, 9, 24, 45])
def test_an_edited_background_makes_a_new_scene(
    room: RunFolder, tmp_path: Path, num_rest: int
) -> None:
    before = read_scene(room)
    kept = before.background.take(np.arange(100))
    foreign_ply(tmp_path / "edited.ply", kept, num_rest)
    about = take_back(room, tmp_path / "edited.ply")
    after = read_scene(room)
    assert len(after.background) == 100
    np.testing.assert_allclose(after.background.means_m, kept.means_m)
    assert after.scene_hash == about["scene_hash"] != before.scene_hash
    assert after.record["edited"][0]["from_scene"] == before.scene_hash
    assert before.scene_hash in describe_edit(about)
    assert rebuild(room, CONFIG, QUIET)["scene_hash"] == after.scene_hash  # the edit is kept


def test_names_of_gaussians_go_when_others_take_their_rows(room: RunFolder, tmp_path: Path) -> None:
    """An editor may sort them on saving: as many as before, but not the same in each row."""
    cloud = read_scene(room).background
    write_ply(tmp_path / "grey.ply", replace(cloud, colors=np.full_like(cloud.colors, 0.5)))
    take_back(room, tmp_path / "grey.ply")
    assert (room.scene_dir / "semantics.npz").is_file()
    assert "file" in read_scene(room).record["semantics"]
    write_ply(tmp_path / "sorted.ply", cloud.take(np.argsort(cloud.means_m[:, 0])))
    take_back(room, tmp_path / "sorted.ply")
    assert not (room.scene_dir / "semantics.npz").exists()
    assert "edited" in read_scene(room).record["semantics"]["remark"]
    assert rebuild(room, CONFIG, QUIET)["scene_hash"] == read_scene(room).scene_hash


def test_a_background_edited_in_place_is_taken_after_being_refused(room: RunFolder) -> None:
    path = room.scene_dir / "background.ply"
    write_ply(path, read_ply(path).take(np.arange(50)))
    with pytest.raises(UnreadableSceneError, match="robot-gst import splats"):
        read_scene(room)
    take_back(room, path)
    assert len(read_scene(room).background) == 50


def test_taking_the_background_back_unchanged_changes_nothing(room: RunFolder) -> None:
    before = (room.scene_dir / "scene.json").read_bytes()
    take_back(room, room.scene_dir / "background.ply")
    assert (room.scene_dir / "scene.json").read_bytes() == before


def test_an_edited_object_keeps_the_scene(room: RunFolder, tmp_path: Path) -> None:
    before = read_scene(room).scene_hash
    write_ply(tmp_path / "blob.ply", blob().take(np.arange(10)))
    assert take_back(room, tmp_path / "blob.ply", "blob")["scene_hash"] == before
    assert len(read_ply(room.scene_dir / "objects" / "blob" / "gaussians.ply")) == 10
    with pytest.raises(UsageError, match=r"no object 'cup'\. It has: blob"):
        take_back(room, tmp_path / "blob.ply", "cup")


def test_a_bad_file_changes_nothing(room: RunFolder, tmp_path: Path) -> None:
    background = read_scene(room).background
    bad = tmp_path / "bad.ply"
    nothing = background.take(np.zeros(0, dtype=np.int64))
    foreign_ply(tmp_path / "empty.ply", nothing, 0)
    broken = replace(background, opacities_logit=background.opacities_logit * np.float32("nan"))
    foreign_ply(tmp_path / "nan.ply", broken, 0)
    contents = {
        "no PLY header": b"not a splat file",
        "bytes of data": (room.scene_dir / "background.ply").read_bytes()[:-7],
        "no Gaussians": (tmp_path / "empty.ply").read_bytes(),
        "not finite": (tmp_path / "nan.ply").read_bytes(),
    }
    before = (room.scene_dir / "scene.json").read_bytes()
    for found, data in contents.items():
        bad.write_bytes(data)
        with pytest.raises(GstError, match=found):
            take_back(room, bad)
    with pytest.raises(PathNotFoundError):
        take_back(room, tmp_path / "missing.ply")
    assert (room.scene_dir / "scene.json").read_bytes() == before
    assert len(read_scene(room).background) == len(background)
