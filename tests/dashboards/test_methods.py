"""Renders of several methods: side by side, worst first, and where the cameras were."""

import io
import json
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from headless import CHROMIUM, NO_CHROMIUM, chromium
from PIL import Image
from serving import dashboard
from test_review_index import HOSTILE
from visible import words

import robot_gst
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.geometry import se3
from dashboards.comparison import judge
from dashboards.frames import camera_tracks, read_frame
from dashboards.guard import COOKIE, Admission
from dashboards.library import Library
from dashboards.methods_page import build_methods
from dashboards.view_poses import poses_beside
from evaluator.compare.run import compare_run
from evaluator.metrics.image_protocol import ImageOptions
from evaluator.result import write_results

SIZE = (48, 64)
NOISE = {"good": (2, 4, 3, 5), "poor": (30, 12, 60, 20)}
"""Standard deviation in each view; the worst of poor is 0002, of good 0003."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def picture(seed: int) -> np.ndarray:
    blocks = np.random.default_rng(seed).integers(40, 215, (6, 8, 3))
    return np.kron(blocks, np.ones((8, 8, 1))).astype(np.uint8)


def noisy(image: np.ndarray, sigma: float) -> np.ndarray:
    noise = np.random.default_rng(7).normal(0, sigma, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


def look(angle: float) -> np.ndarray:
    """A camera on a circle of 1 m, half a metre up, that looks at the middle."""
    eye = np.array([np.cos(angle), np.sin(angle), 0.5])
    return se3.look_at(eye, np.zeros(3), np.array([0.0, 0.0, 1.0]))


@pytest.fixture
def folders(tmp_path: Path) -> Path:
    """Four views by two methods, with ``transforms.json`` beside them."""
    frames = []
    for index in range(4):
        save(tmp_path / "gt" / f"{index:04}.png", picture(index))
        for method, sigmas in NOISE.items():
            save(tmp_path / method / f"{index:04}.png", noisy(picture(index), sigmas[index]))
        T = look(np.pi / 2 * index) @ OPENGL
        frames.append({"file_path": f"gt/{index:04}.png", "transform_matrix": T.tolist()})
    lens = {"w": SIZE[1], "h": SIZE[0], "fl_x": 60.0}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return tmp_path


def evaluated(folders: Path) -> RunFolder:
    """Compare them as a user does."""
    run = folders / "run"
    renders = [f"--renders={name}={folders / name}" for name in NOISE]
    command = ["evaluate", "--reference", str(folders / "gt"), *renders, "--out"]
    assert robot_gst.run([*command, str(run / "results")]) == 0
    return RunFolder.open(run)


def test_views_come_worst_first_by_any_metric_of_any_method(folders: Path) -> None:
    run = evaluated(folders)
    found = judge(run)
    page = build_methods(run, found, {})
    assert page.methods == ("good", "poor")
    assert [view.name for view in page.views] == ["0003", "0001", "0002", "0000"]
    assert page.choice.view == "0003"
    page = build_methods(run, found, {"method": "poor", "metric": "gmsd", "view": "0000"})
    values = [view.values["poor"] for view in page.views]
    assert page.metric is not None
    assert not page.metric.higher_is_better
    assert values == sorted(values, reverse=True)
    assert (page.views[0].name, page.before, page.after) == ("0002", "0002", "0003")
    wrong = build_methods(run, found, {"method": "x", "metric": "y", "view": "z", "first": "99"})
    assert wrong.views == build_methods(run, found, {}).views


def test_the_map_shows_where_the_cameras_stood_and_where_the_error_is(folders: Path) -> None:
    run = evaluated(folders)
    drawn = build_methods(run, judge(run), {"method": "poor"}).map
    assert drawn is not None
    assert drawn.where == str(folders)
    cameras = {each.view: each for each in drawn.cameras}
    middle = np.mean([[each.x, each.y] for each in drawn.cameras], axis=0)
    for each in drawn.cameras:  # all look at the middle
        away = middle - [each.x, each.y]
        turn = np.deg2rad(each.turn_deg)
        assert np.dot(away, [np.cos(turn), np.sin(turn)]) == pytest.approx(
            np.hypot(*away), rel=0.01
        )
    across = [cameras["0000"].x - cameras["0002"].x, cameras["0000"].y - cameras["0002"].y]
    ahead = [cameras["0001"].x - cameras["0003"].x, cameras["0001"].y - cameras["0003"].y]
    assert np.hypot(*across) == pytest.approx(np.hypot(*ahead), rel=0.01)
    assert np.dot(across, ahead) == pytest.approx(0, abs=10)
    # Anticlockwise from above, as they stand; pixels count downwards.
    assert across[0] * ahead[1] - across[1] * ahead[0] < 0
    assert [cameras[f"000{i}"].error for i in range(4)] == [2, 0, 4, 1]
    assert drawn.cameras[-1].view == "0002", "the worst is drawn over the others"


def test_without_poses_the_page_says_what_it_looked_for(folders: Path) -> None:
    (folders / "transforms.json").unlink()
    run = evaluated(folders)
    page = build_methods(run, judge(run), {})
    assert page.map is None
    assert "transforms.json" in page.why_no_map


def test_renders_of_gaussian_splatting_are_numbered_as_its_held_out_cameras(tmp_path: Path) -> None:
    cameras = []
    for name, angle in (("IMG_8", 0.0), ("IMG_16", 1.0), ("IMG_1", 2.0)):
        T = look(angle)
        cameras.append(
            {"img_name": name, "position": T[:3, 3].tolist(), "rotation": T[:3, :3].tolist()}
        )
    model = tmp_path / "model"
    for part in ("test", "train"):
        (model / part / "ours_7000" / "gt").mkdir(parents=True)
    (model / "cameras.json").write_text(json.dumps(cameras))
    folder = model / "test" / "ours_7000" / "gt"
    found, where = poses_beside([folder], ["00000", "00001"])
    assert where == str(model)
    np.testing.assert_allclose(found["00001"], look(1.0))
    found, _ = poses_beside([model / "train" / "ours_7000" / "gt"], ["00000"])
    np.testing.assert_allclose(found["00000"], look(2.0))
    found, _ = poses_beside([folder], ["IMG_1"])
    np.testing.assert_allclose(found["IMG_1"], look(2.0))
    (model / "cameras.json").write_text("[{}]")
    found, why = poses_beside([folder], ["00000"])
    assert not found
    assert "no list of cameras" in why


def test_images_are_those_that_were_scored_and_no_others(
    folders: Path, synthetic: ModuleType
) -> None:
    (folders / "gt" / "secret.png").write_bytes((folders / "gt" / "0000.png").read_bytes())
    run = evaluated(folders)
    browser = synthetic.browser_of(run)

    def get(method: str, view: str) -> object:
        return browser.get("/methods/image?" + f"method={method}&view={view}")

    for method, name in (("-", "gt"), ("poor", "poor")):
        answer = get(method, "0002")
        assert answer.content == (folders / name / "0002.png").read_bytes()
        assert answer.headers["content-type"] == "image/png"
    for method, view in (("-", "secret"), ("x", "0000"), ("-", "../gt/0000"), ("-", "/etc/passwd")):
        assert get(method, view).status_code == 404
    (folders / "good" / "0001.png").unlink()
    (folders / "good" / "0001.png").symlink_to(folders / "transforms.json")
    assert "points outside" in get("good", "0001").text
    page = build_methods(run, judge(run), {"view": "0000"})
    assert [each.note for each in page.shown] == ["", "", ""]
    save(folders / "poor" / "0000.png", picture(9))
    page = build_methods(run, judge(run), {"view": "0000"})
    assert [each.note for each in page.shown] == ["", "", "changed since it was scored"]


def test_images_beside_the_run_are_shown_on_the_loopback_address_alone(
    folders: Path, synthetic: ModuleType
) -> None:
    run = evaluated(folders)
    browser = synthetic.browser_of(run, admission=Admission(host="192.0.2.1", token="t"))
    cookie = {"cookie": f"{COOKIE}=t"}
    assert browser.get("/methods", headers=cookie).status_code == 200
    answer = browser.get("/methods/image?method=-&view=0000", headers=cookie)
    assert answer.status_code == 404
    assert "loopback" in answer.text


def test_the_page_of_a_run_shows_its_own_renders_beside_others(
    own_run: RunFolder, synthetic: ModuleType, tmp_path: Path
) -> None:
    views = synthetic.write_views(own_run)
    stamps = camera_tracks(views)["side"].stamps_ns
    for stamp in stamps:
        data, _ = read_frame(views, "side", stamp)
        with Image.open(io.BytesIO(data)) as image:
            pixels = np.asarray(image.convert("RGB"))
        save(tmp_path / "mine" / f"side_{stamp}.png", noisy(pixels, 8))
    options = ImageOptions(renders=(f"mine={tmp_path / 'mine'}",))
    compared = compare_run(own_run, images=options)
    write_results(compared.results(), own_run.results_dir / "results.json")
    page = build_methods(own_run, judge(own_run), {})
    assert page.methods == ("twin", "mine")
    assert page.why_no_map
    browser = synthetic.browser_of(own_run)
    view = f"side/{stamps[0]}"
    for method in ("-", "twin", "mine"):
        answer = browser.get(f"/methods/image?method={method}&view={view}")
        assert answer.headers["content-type"] in ("image/jpeg", "image/png")
    seen = words(browser.get("/twin").text)
    assert "methods side by side" in seen


def test_hostile_names_are_text_and_a_run_without_renders_says_what_to_do(
    folders: Path, synthetic: ModuleType, shared_run: RunFolder
) -> None:
    name = HOSTILE.replace("/", "")[:60].replace("=", "")
    (folders / "poor").rename(folders / "x")
    command = ["evaluate", "--reference", str(folders / "gt"), f"--renders={name}={folders / 'x'}"]
    assert robot_gst.run([*command, "--out", str(folders / "run" / "results")]) == 0
    text = synthetic.browser_of(RunFolder.open(folders / "run")).get("/methods").text
    assert "<script>alert" not in text
    assert re.search(r"<option value=\"-\"", text)
    seen = words(synthetic.browser_of(shared_run).get("/methods").text)
    assert "robot-gst evaluate --reference" in seen


def test_results_without_a_run_folder_say_how_to_show_them(folders: Path) -> None:
    command = ["evaluate", "--reference", str(folders / "gt"), f"--renders={folders / 'good'}"]
    assert robot_gst.run([*command, "--out", str(folders / "gt_results")]) == 0
    with pytest.raises(UsageError, match="gt_results/results"):
        Library.open([folders / "gt_results"])


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
def test_the_wipe_shows_one_method_on_each_side_and_keys_choose_which(
    folders: Path, tmp_path: Path
) -> None:
    run = evaluated(folders)
    with dashboard(run) as (_, url), chromium(tmp_path) as tab:
        tab.show(f"{url}methods?method=poor", width=1440, dark=False)
        tab.ask_when("[...document.images].slice(0, 2).every((i) => i.complete && i.naturalWidth)")
        tab.ask("document.getElementById('wipe').value = 50")
        tab.ask("document.getElementById('wipe').dispatchEvent(new Event('input'))")
        box = tab.ask(
            "(({ x, y, width, height }) => [x, y + scrollY, width, height])"
            "(document.querySelector('.wipe .difference').getBoundingClientRect())"
        )
        with Image.open(io.BytesIO(tab.picture())) as image:
            x, y, width, height = (round(value) for value in box)
            crop = image.convert("RGB").crop((x, y, x + width, y + height)).resize(SIZE[::-1], 0)
        shown = np.asarray(crop).astype(int)
        gt, poor = picture(2), noisy(picture(2), 60)
        near = [np.abs(shown[:, half] - wanted[:, half]).mean()
                for half, wanted in ((slice(3, 29), gt), (slice(35, 61), poor))]  # fmt: skip
        apart = np.abs(gt.astype(int) - poor)[:, 3:29].mean()
        assert max(near) < apart / 3
        tab.press("1", loads=True)
        assert tab.ask("document.querySelector('[name=right]').value") == "good"
        tab.press("]", loads=True)
        assert "view=0000" in tab.ask("location.search")
        assert tab.ask("document.documentElement.scrollWidth <= innerWidth")
        assert tab.complaints == []
