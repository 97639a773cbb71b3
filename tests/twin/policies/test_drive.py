"""Keys move the arm in the twin: of a file, and of a page in Chromium."""

import json
import threading
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from headless import CHROMIUM, NO_CHROMIUM, chromium
from test_rollouts import QUIET

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import PathNotFoundError, UsageError
from bridge.exchange.lerobot.export import export_lerobot, select_episodes
from bridge.exchange.lerobot.layout import LeRobotConfig
from twin.policies.config import RolloutConfig
from twin.policies.drive import RATE_HZ, SPEED, KeyFile, KeyPage, KeyPolicy
from twin.policies.errors import PolicyError
from twin.policies.mapping import is_end
from twin.policies.policy import open_policy
from twin.policies.runs import roll_out_run

PICTURE = np.zeros((24, 32, 3), dtype=np.uint8)


def observation(width_m: float = 0.08) -> dict[str, Any]:
    return {"side": PICTURE, "width_m": np.array([width_m]), "prompt": "put it there"}


def key_file(tmp_path: Path, text: str) -> Path:
    (tmp_path / "keys.txt").write_text(text)
    return tmp_path / "keys.txt"


def driven(path: Path, start: str) -> RolloutConfig:
    return RolloutConfig(policy=f"keys:{path}", name="me", max_s=20.0, starts=start)


def rows(path: Path) -> np.ndarray:
    """All that a file of keys asks for."""
    policy, found = open_policy(f"keys:{path}", 1.0), []
    while not is_end(answer := policy.infer(observation())):
        found.append(answer[0])
    return np.array(found)


def test_the_tool_starts_and_stops_gently_and_goes_as_far_as_the_keys_say(tmp_path: Path) -> None:
    found = rows(key_file(tmp_path, "w+d 2  # away and to the right\n\nwait 0.6\nq 0.2\n"))
    assert len(found) == round(2.8 * RATE_HZ)
    speed = found[:, :6] * RATE_HZ
    assert np.abs(speed[:30, 0] - SPEED[0]).argmin() > 3
    assert speed.max() <= SPEED.max()
    assert np.abs(np.diff(speed[:, 0], prepend=0.0)).max() <= SPEED[0] / 0.3 / RATE_HZ + 1e-12
    np.testing.assert_allclose(found[:, 0].sum(), 2.0 * SPEED[0], rtol=1e-9)
    np.testing.assert_allclose(found[:, 1], -found[:, 0])
    assert not found[:, 2:5].any()
    assert found[-1, 5] > 0
    np.testing.assert_allclose(speed[38, :2], 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("key", "back", "entry"),
    [
        ("w", "s", 0),
        ("a", "d", 1),
        ("r", "f", 2),
        ("right", "left", 3),
        ("up", "down", 4),
        ("q", "e", 5),
    ],
)
def test_each_key_moves_one_way_and_another_one_back(
    tmp_path: Path, key: str, back: str, entry: int
) -> None:
    there = rows(key_file(tmp_path, f"{key} 1\nwait 0.6\n")).sum(axis=0)[:6]
    home = rows(key_file(tmp_path, f"{back} 1\nwait 0.6\n")).sum(axis=0)[:6]
    assert there[entry] > 0
    assert not np.delete(there, entry).any()
    np.testing.assert_allclose(home, -there)


def test_each_press_turns_the_gripper_round(tmp_path: Path) -> None:
    widths = rows(key_file(tmp_path, "wait 0.2\nspace 1\nwait 0.2\nspace\nwait 1.5\n"))[:, 6]
    assert widths[2] == 0.08  # as it was
    assert widths[17] == pytest.approx(0.0, abs=1e-12)
    assert widths[-1] == 0.08
    assert np.abs(np.diff(widths)).max() <= 0.1 / RATE_HZ + 1e-12


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("w 1\nx 2\n", "line 2: 'x 2'"),
        ("w one", "line 1: 'w one'"),
        ("w 1 2", "line 1"),
        ("w -1", "line 1"),
        ("w 1e9", "line 1"),
        ("w nan", "line 1"),
    ],
)
def test_a_line_that_is_no_key_is_named(tmp_path: Path, text: str, found: str) -> None:
    with pytest.raises(PolicyError, match=rf"{found}.* is not keys and seconds; keys: a, d, down"):
        KeyFile(key_file(tmp_path, text))


def test_a_file_that_is_not_there_and_flags_that_do_not_go_together(tmp_path: Path) -> None:
    with pytest.raises(PathNotFoundError, match="file of keys"):
        KeyFile(tmp_path / "none")
    with pytest.raises(UsageError, match="drives the twin"):
        RolloutConfig(policy="keys", cell="lab")


def test_a_rollout_by_keys_is_an_episode_that_lerobot_takes(run: RunFolder, tmp_path: Path) -> None:
    pytest.importorskip("av")
    path = key_file(tmp_path, "r 0.8\nwait 0.6\nspace 0.4\n")
    start = driven(path, "start 2")
    (row,) = roll_out_run(run, start, QUIET)["rows"]
    assert (row["start_id"], row["success"], row["problem"]) == ("start 2", False, "")
    assert row["asked"] == round(1.8 * RATE_HZ)
    assert row["shutters"]["side"]["period_ns"] == 1  # who drives sees now
    made = Episode.open(run.derived_dir / row["file"])
    path.write_text("r 0.4\n")  # other keys in the same place are another rollout
    (other,) = roll_out_run(run, start, QUIET)["rows"]
    assert (other["file"] != row["file"], other["asked"]) == (True, round(0.4 * RATE_HZ))
    (run.derived_dir / other["file"]).unlink()
    poses = streams.joint_track(made).position
    assert np.abs(poses[-1] - poses[0]).max() > 0.02
    choice = LeRobotConfig(episodes=("*.rollout.me.*",))
    report = export_lerobot(
        run.path, tmp_path / "ds", config=choice, force=False, advance=lambda *_: None
    )
    assert (report.episodes, report.fps, report.labelled) == (1, RATE_HZ, True)
    assert report.action == "next_state"
    features = json.loads((tmp_path / "ds/meta/info.json").read_text())["features"]
    assert {"observation.images.side", "observation.images.wrist"} <= features.keys()
    assert "acted in the twin (simulated" in (tmp_path / "ds/README.md").read_text()
    with pytest.raises(UsageError, match=r"has no episode \*\.rollout\.you"):
        select_episodes(run.path, LeRobotConfig(episodes=("*.rollout.you.*",)))


def test_a_limit_slows_the_arm_down_and_does_not_end_the_rollout(
    run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = key_file(tmp_path, "w 9\nr 0.6\n")  # farther than the arm reaches
    start = driven(path, "start 1")
    (row,) = roll_out_run(run, start, QUIET)["rows"]
    assert (row["stopped"], row["problem"], row["asked"]) == ("", "", round(9.6 * RATE_HZ))
    assert "the arm does not bring the tool to" in capsys.readouterr().err


@pytest.fixture
def page() -> Any:
    served = KeyPage()
    served.show({"side": PICTURE + 200}, "put it there")
    yield served
    served.close()


def answer(address: str, **more: Any) -> tuple[int, bytes]:
    try:
        with urllib.request.urlopen(urllib.request.Request(address, **more), timeout=10) as found:
            return found.status, found.read()
    except urllib.error.HTTPError as error:
        return error.code, b""


def test_only_who_knows_the_address_may_drive(page: KeyPage) -> None:
    where = page.address
    assert answer(f"{where}keys", data=b'["w"]')[0] == 200
    assert page.held() == {"w"}
    head = where[: where.index("/", 8)]
    assert answer(f"{head}/keys", data=b'["s"]')[0] == 404
    assert answer(f"{head}/", headers={})[0] == 404
    assert answer(f"{where}keys", data=b'["s"]', headers={"Host": "evil.example"})[0] == 404
    assert answer(f"{where}keys", data=b" " * 1001)[0] == 404
    assert answer(f"{where}keys", data=b"7")[0] == 400
    assert answer(f"{where}other.mjpg")[0] == 404
    assert page.held() == {"w"}


def test_keys_of_a_page_that_fell_silent_are_let_go(page: KeyPage) -> None:
    page.press(frozenset({"w"}))
    page._heard_s -= 1.0
    assert page.held() == frozenset()


@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
def test_keys_in_chromium_reach_the_arm_and_pictures_come_back(
    page: KeyPage, tmp_path: Path
) -> None:
    policy = KeyPolicy(page)
    policy.refused("limits: too fast")
    moved = []

    def drive() -> None:
        for _ in range(600):
            found = policy.infer(observation())
            if is_end(found):
                return
            moved.append(found[0])

    with chromium(tmp_path) as tab:
        tab.show(page.address, width=390, dark=True)
        thread = threading.Thread(target=drive)
        thread.start()
        tab.ask_when("document.images[0].complete && document.images[0].naturalWidth === 32")
        tab.ask_when("document.getElementById('told').textContent === 'limits: too fast'")
        tab.call("Input.dispatchKeyEvent", type="keyDown", key="w", code="KeyW", text="w")
        tab.ask_when("document.getElementById('task').textContent === 'put it there'")
        while not any(row[0] > 0 for row in moved):
            tab.ask("1")
        assert tab.ask("document.documentElement.scrollWidth <= 390") is True
        tab.call("Input.dispatchKeyEvent", type="keyDown", key="Enter", code="Enter")
        thread.join(timeout=60)
        assert not thread.is_alive()
        assert tab.complaints == []
