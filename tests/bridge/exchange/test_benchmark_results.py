"""Other benchmarks' result files become trials, or are refused with what was found."""

import json
from pathlib import Path
from typing import Any

import pytest

import robot_gst
from bridge.errors import PathNotFoundError
from bridge.exchange.benchmark_results import read_lerobot_eval, read_polaris, read_simpler
from bridge.exchange.table_text import TableError

ROB = "rob_0.147_0.028_rot_0.000_-0.000_3.142_rgb_overlay_bridge_real_eval_1"
STATISTICS = "_moved_correct_obj_True_moved_wrong_obj_False_src_on_target_True"


def video(folder: Path, name: str, *above: str) -> None:
    place = folder.joinpath(*above)
    place.mkdir(parents=True, exist_ok=True)
    (place / f"{name}.mp4").write_bytes(b"")


def test_outcomes_are_read_from_the_names_of_simpler_videos(tmp_path: Path) -> None:
    above = ("octo-base", "bridge_table_1_v1", "arm_pd", "PutSpoonOnTableClothInScene-v0", ROB)
    video(tmp_path, f"success_obj_episode_17{STATISTICS}", *above)
    video(tmp_path, "failure_obj_episode_2", *above)
    video(tmp_path, "failure_obj_-0.1775_0.2_n_lift_significant_69_grasped_True", *above)
    video(tmp_path, "a_film_of_something_else")
    trials = {trial.start_id: trial for trial in read_simpler(tmp_path)}
    assert len(trials) == 3
    trial = trials[f"{ROB}/episode_17"]
    assert trial.sim_planned is True
    assert trial.recorded is None
    assert (trial.policy, trial.task) == ("octo-base", "PutSpoonOnTableClothInScene-v0")
    assert trials[f"{ROB}/-0.1775_0.2"].sim_planned is False


def test_a_start_with_two_outcomes_is_refused(tmp_path: Path) -> None:
    video(tmp_path, "success_obj_episode_1", "pick")
    video(tmp_path, "failure_obj_episode_1_grasped_False", "pick")
    with pytest.raises(TableError, match=r"episode_1 of pick has several videos"):
        read_simpler(tmp_path)


def test_a_folder_without_such_videos_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TableError, match="no video named success_obj_"):
        read_simpler(tmp_path)
    with pytest.raises(PathNotFoundError):
        read_simpler(tmp_path / "nowhere")


def polaris(tmp_path: Path, text: str) -> Path:
    folder = tmp_path / "stack_blocks"
    folder.mkdir(exist_ok=True)
    path = folder / "eval_results.csv"
    path.write_text(text)
    return path


def test_polaris_results_are_read(tmp_path: Path) -> None:
    text = "episode,episode_length,success,progress\n0,450,True,1.0\n1,450,False,0.33\n"
    trials = read_polaris(polaris(tmp_path, text))
    assert [(t.trial_id, t.sim_planned) for t in trials] == [
        ("stack_blocks/0", True),
        ("stack_blocks/1", False),
    ]
    assert trials[0].task == "stack_blocks"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("episode,episode_length\n0,450\n", "no column 'success'"),
        ("episode,success\n0,0.33\n", r"row 2: success is '0.33'"),
        ("episode,success\n0,True\n0,True\n", "row 3: episode 0 is there twice"),
        ("episode,success\n,True\n", "row 2: episode is empty"),
    ],
)
def test_polaris_results_that_cannot_be_are_refused(
    tmp_path: Path, text: str, message: str
) -> None:
    with pytest.raises(TableError, match=message):
        read_polaris(polaris(tmp_path, text))


def lerobot(tmp_path: Path, record: Any) -> Path:
    path = tmp_path / "eval_info.json"
    path.write_text(record if isinstance(record, str) else json.dumps(record))
    return path


def test_lerobot_results_of_one_task_and_of_several_are_read(tmp_path: Path) -> None:
    one = {
        "per_episode": [
            {"episode_ix": 0, "sum_reward": 1.0, "success": True, "seed": 1000},
            {"episode_ix": 1, "sum_reward": 0.0, "success": False, "seed": 1001},
        ],
        "aggregated": {"pc_success": 50.0},
    }
    trials = read_lerobot_eval(lerobot(tmp_path, one))
    assert [(t.start_id, t.sim_planned) for t in trials] == [("1000", True), ("1001", False)]
    several = {
        "per_task": [
            {"task_group": "libero_10", "task_id": 3, "metrics": {"successes": [True, False]}}
        ],
        "overall": {},
    }
    trials = read_lerobot_eval(lerobot(tmp_path, several))
    assert [(t.task, t.sim_planned) for t in trials] == [
        ("libero_10/3", True),
        ("libero_10/3", False),
    ]


@pytest.mark.parametrize(
    ("record", "message"),
    [
        ("{", "no JSON"),
        ([], "not as lerobot-eval writes it"),
        ({}, "no outcomes"),
        ({"per_episode": [{"episode_ix": 0}]}, "not as lerobot-eval writes it"),
        ({"per_episode": [{"episode_ix": 0, "success": 0.5}]}, "is not true or false"),
        ({"per_task": [{"task_group": "a"}]}, "not as lerobot-eval writes it"),
        ({"per_episode": [{"episode_ix": 4, "success": True}] * 2}, "episode_4 is there 2 times"),
    ],
)
def test_lerobot_results_that_cannot_be_are_refused(
    tmp_path: Path, record: Any, message: str
) -> None:
    with pytest.raises(TableError, match=message):
        read_lerobot_eval(lerobot(tmp_path, record))


def test_evaluate_takes_all_three_and_says_what_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "simpler"
    video(folder, "success_obj_episode_0", "pick")
    video(folder, "failure_obj_episode_1", "pick")
    text = "episode,episode_length,success,progress\n0,450,True,1.0\n"
    record = {"per_episode": [{"episode_ix": 0, "success": True, "seed": 1}]}
    sources = (folder, polaris(tmp_path, text), lerobot(tmp_path, record))
    for source, name in zip(sources, ("SIMPLER", "PolaRiS", "LeRobot"), strict=True):
        out = tmp_path / f"out_{name}"
        assert robot_gst.run(["evaluate", str(source), "--out", str(out)]) == 0
        assert f"{name} results are rollouts of a policy" in " ".join(
            capsys.readouterr().out.split()
        )
        results = json.loads((out / "results.json").read_text())
        assert results["stand_in"] is None
