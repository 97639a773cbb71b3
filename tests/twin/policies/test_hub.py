"""An exported environment, as LeRobot's loader and its rollout function use one."""

import json
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from scripted_plans import scene_of_test

import robot_gst
from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, UsageError
from twin.policies.hub import write_env
from twin.scene.localise import episode as localising
from twin.scene.localise.result import LocalisedObject
from twin.scene.store.folder import scene_hash_of

LEROBOTS_USE = """
import hashlib, importlib.util, json, sys
import gymnasium
import numpy as np

def used(make_env, use_async_envs):
    vector = make_env(n_envs=2, use_async_envs=use_async_envs)
    assert isinstance(vector, gymnasium.vector.VectorEnv)
    seen, _ = vector.reset(seed=[1, 2])
    assert vector.observation_space.contains(seen)
    assert not np.array_equal(*seen["pixels"]["side"])  # each has its own start
    first, digest = seen["agent_pos"], hashlib.sha256()
    for action in (first, first + np.array([[0.0] * 7, [3.0] + [0.0] * 6])):
        seen, reward, over, cut, info = vector.step(action.astype(np.float32))
        for name in sorted(seen["pixels"]):
            digest.update(seen["pixels"][name].tobytes())
    found = {
        "pixels": {key: [*value.shape, str(value.dtype)] for key, value in seen["pixels"].items()},
        "agent_pos": [*seen["agent_pos"].shape, str(seen["agent_pos"].dtype)],
        "task": [*vector.call("task"), *vector.call("task_description")],
        "steps": vector.call("_max_episode_steps"), "over": over.tolist(), "cut": cut.tolist(),
        "final": {key: info["final_info"][key].tolist() for key in ("is_success", "stopped")},
        "begun_anew": float(np.abs(seen["agent_pos"] - first).max()),
        "pictures": digest.hexdigest(), "rendered": [len(frame) for frame in vector.call("render")],
    }
    vector.close()
    return found

if __name__ == "__main__":
    spec = importlib.util.spec_from_file_location("hub_env", sys.argv[1])
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    print(json.dumps([used(module.make_env, which) for which in (False, True)]))
"""


def localised(run: RunFolder) -> None:
    """Write down where the objects of every trial were, as looking for them would."""
    with pytest.MonkeyPatch.context() as patch:
        about = {"confidence": 1.0, "method": "measured", "reason": None, "stamp_ns": 1}
        places = scene_of_test().Ts_base_object.items()
        found = [LocalisedObject(object_id=key, T_base_object=T, **about) for key, T in places]
        records = [(1, {**each.to_record(), "phase": "start", "plan_id": None}) for each in found]
        patch.setattr(localising, "_localised_phases", lambda *_: records)
        for path in run.episodes():
            episode = Episode.open(path)
            task, scene = streams.task_file(episode).task(), scene_hash_of(run)
            localising.write_localised(run, episode, task, scene_hash=scene)


def test_another_interpreter_loads_it_and_uses_it_as_lerobot_does(
    run: RunFolder, tmp_path: Path
) -> None:
    localised(run)
    assert robot_gst.run(["export", "env", str(run.path), str(tmp_path / "env")]) == 0
    (tmp_path / "use.py").write_text(LEROBOTS_USE)
    words = [sys.executable, str(tmp_path / "use.py"), str(tmp_path / "env" / "env.py")]
    told = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    assert told.returncode == 0, told.stderr
    one, apart = json.loads(told.stdout.splitlines()[-1])
    assert one == apart  # in one process, and each in its own
    shape = [2, 120, 160, 3, "uint8"]  # channels last
    assert one["pixels"] == {"side": shape, "wrist": shape}
    assert one["agent_pos"] == [2, 7, "float32"]
    assert one["task"] == ["cube_into_box"] * 2 + ["Put the red cube into the box."] * 2
    assert one["steps"] == [300, 300]
    assert (one["over"], one["cut"]) == ([False, True], [False, False])
    assert one["final"]["is_success"] == [False, False]
    assert one["final"]["stopped"][1].startswith("limits: shoulder_pan_joint moves at")
    assert one["begun_anew"] < 0.01
    assert one["rendered"] == [120, 120]


def test_it_finds_its_run_beside_it_or_where_it_was(run: RunFolder, tmp_path: Path) -> None:
    write_env(run, tmp_path / "envs" / "one")
    shutil.copytree(tmp_path / "envs" / "one", tmp_path / "far" / "away" / "one")
    alone = tmp_path / "far" / "away" / "one" / "env.py"
    runpy.run_path(str(alone))["make_env"]().close()
    (tmp_path / "moved").mkdir()
    for name in ("run", "envs"):
        shutil.move(tmp_path / name, tmp_path / "moved" / name)
    make = runpy.run_path(str(tmp_path / "moved" / "envs" / "one" / "env.py"))["make_env"]
    make(cfg=SimpleNamespace(task=None)).close()
    with pytest.raises(GstError, match="no trial of task 'fold'"):
        make(cfg=SimpleNamespace(task="fold"))
    with pytest.raises(GstError, match=r"its run is neither in .*run nor in .*run\. Change RUN in"):
        runpy.run_path(str(alone))["make_env"]()


def test_a_run_without_a_scene_and_a_folder_that_is_there_are_refused(
    run: RunFolder, tmp_path: Path
) -> None:
    write_env(run, tmp_path / "env")
    with pytest.raises(UsageError, match=r"env\.py is there: change it, or choose another folder"):
        write_env(run, tmp_path / "env")
    shutil.rmtree(run.scene_dir)
    with pytest.raises(GstError, match=r"scene not found: .* Make it: robot-gst rebuild"):
        write_env(run, tmp_path / "other")
    with pytest.raises(GstError, match=r"scene not found: .* Make it: robot-gst rebuild"):
        runpy.run_path(str(tmp_path / "env" / "env.py"))["make_env"]()
    assert not (tmp_path / "other").exists()
