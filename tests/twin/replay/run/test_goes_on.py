"""Each kind of bad input costs one trajectory and one sentence; everything else is replayed."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from joint_samples import at_positions

from bridge.episode import schema
from bridge.episode.cdr.messages import string_to_cdr
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.robots.default import ARM_JOINTS
from bridge.task.plan import Plan
from bridge.terminal import Output
from twin.replay import runner
from twin.replay.config import ReplayConfig, ReplayRunConfig
from twin.replay.runner import replay_run
from twin.replay.scene import StartState, StartStates
from twin.replay.summary import describe_run
from twin.scene.localise.episode import Phase

T0 = 1_700_000_000_000_000_000
SECOND = 1_000_000_000
QUICK = ReplayConfig(settle_after_s=0.4, settle_before_s=0.1)


def write_trial(
    run: RunFolder,
    name: str,
    urdf: str,
    payloads: Sequence[bytes],
    *,
    executed: str = "",
    stamps_s: Sequence[float] = (),
    joints_rad: float = 0.0,
) -> None:
    """One trial: plans as they came in, and joints recorded while one of them was executed."""
    with EpisodeWriter(run.episodes_dir / f"{name}.mcap") as writer:
        writer.describe(EpisodeInfo(id=name, kind="trial", task="cube_into_box", cell="standin"))
        writer.write(
            "/robot_description", string_to_cdr(urdf), type_name=schema.STRING, log_time_ns=T0
        )
        for index, payload in enumerate(payloads):
            writer.write("/standin/plan", payload, type_name=schema.PLAN, log_time_ns=T0 + index)
        if not executed:
            return
        for kind, stamp in (
            ("execution_started", T0 + SECOND),
            ("execution_ended", T0 + 3 * SECOND),
        ):
            event = {"schema_version": 1, "stamp_ns": stamp, "type": kind, "plan_id": executed}
            writer.write_json("/standin/event", event, type_name=schema.EVENT, log_time_ns=stamp)
        for index, stamp_s in enumerate(stamps_s):
            stamp = T0 + SECOND + round(stamp_s * 1e9)
            tracks = (("joint_states", ARM_JOINTS), ("gripper/state", ("gripper_width",)))
            for topic, names in tracks:
                sample = at_positions(stamp, names, np.full(len(names), joints_rad))
                writer.write(
                    f"/standin/{topic}",
                    sample.to_cdr(),
                    type_name=schema.JOINT_STATE,
                    log_time_ns=T0 + SECOND + index,
                    publish_time_ns=stamp,
                )


def bad_plans(good: Plan) -> dict[str, tuple[Plan, str]]:
    """Plans of one trial, with what is to be said of each."""
    first, second = good.tau[:2]
    far = replace(first, p_m=(3.0, 0.0, 0.2))
    return {
        "other_robot": (replace(good, robot="panda"), r"not evaluated: .*'panda'"),
        "other_frame": (replace(good, frame="world"), r"not evaluated: .*'world'"),
        "backwards": (replace(good, tau=(second, first)), r"not evaluated: .*do not increase"),
        "too_far": (replace(good, tau=(far,), stages=()), r"ik: unreachable: no joints reach"),
    }


@pytest.fixture
def run(tmp_path: Path, script: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> RunFolder:
    """A trial for each line of the list, and one with a plan that can be judged."""
    folder, scene = RunFolder.create(tmp_path / "run"), script.scene()
    whole = script.plan(scene)
    good = replace(whole, tau=whole.tau[:1], stages=())
    plans = [
        replace(plan, id=name).to_json()
        for name, (plan, _) in bad_plans(script.plan(scene)).items()
    ]
    write_trial(folder, "plans", scene.urdf, plans)
    nan = replace(good, id="nan").to_json().replace(b'"t_ns":0', b'"t_ns":NaN')
    assert b"NaN" in nan
    write_trial(folder, "nan_in_plan", scene.urdf, [nan])
    empty = {**json.loads(good.to_json()), "tau": []}
    write_trial(folder, "empty_plan", scene.urdf, [json.dumps(empty).encode()])
    lost_mesh = scene.urdf.replace("collision/forearm.stl", "collision/gone.stl")
    write_trial(folder, "lost_mesh", lost_mesh, [good.to_json()])
    mimic = re.sub(
        r'(<joint name="gripper_right_finger_joint".*?)(</joint>)',
        r'\g<1><mimic joint="thumb"/>\g<2>',
        scene.urdf,
    )
    write_trial(folder, "mimic", mimic, [good.to_json()])
    times = np.arange(0.0, 2.0, 0.1)
    ran = {"executed": good.id, "stamps_s": times}
    write_trial(folder, "nan_in_log", scene.urdf, [good.to_json()], **ran, joints_rad=np.nan)
    ran["stamps_s"] = np.concatenate([times, times - 1.0])
    write_trial(folder, "clock", scene.urdf, [good.to_json()], **ran)
    for name in ("unseen", "inside", "judged"):
        write_trial(folder, name, scene.urdf, [good.to_json()])
    (folder.episodes_dir / "cut_off.mcap").write_bytes(b"no episode")

    def starts(_: RunFolder, episode: Episode, task: Any, **__: object) -> StartStates:
        poses, reasons = dict(scene.Ts_base_object), {}
        if episode.info.id == "unseen":
            del poses["cube"]
            reasons["cube"] = "no pixels of its colour"
        if episode.info.id == "inside":
            poses["cube"] = poses["box"].copy()
        phase = Phase(name="start", plan_id=None, after_ns=None, before_ns=None)
        return StartStates(task, [phase], [StartState(Ts_base_object=poses, reasons=reasons)])

    monkeypatch.setattr(runner, "localised_starts", starts)
    return folder


@pytest.mark.slow
def test_every_bad_input_costs_itself_and_one_sentence(
    run: RunFolder, script: SimpleNamespace
) -> None:
    summary = replay_run(run, ReplayRunConfig(replay=QUICK), Output(quiet=True))
    said: dict[tuple[str, str], str] = {}
    for row in summary["rows"]:
        said.setdefault((row["episode"], row["trajectory"]), "")
        key = (row["episode"], row["trajectory"])
        if row["episode"] == "plans":
            key = (row["episode"], row["plan"])
        said[key] = row["error"] or row["reason"] or ""
        assert row["accepted"] is not True
        assert "\n" not in said[key]
    for name, (_, expected) in bad_plans(script.plan(script.scene())).items():
        assert re.search(expected, said["plans", name]), said["plans", name]
    for key, expected in {
        ("lost_mesh", "planned"): r"not evaluated: .*gone\.stl.* is not there",
        ("mimic", "planned"): r"not evaluated: .*gripper_right_finger_joint.*thumb",
        ("nan_in_log", "executed"): r"not evaluated: .*joints that are no numbers at 0\.00 s",
        ("clock", "executed"): r"not evaluated: .*goes back by",
        ("inside", "planned"): r"not evaluated: cube starts \d+ mm inside box",
        ("unseen", "planned"): r"undecided: .*cube \(no pixels of its colour\)",
        ("judged", "planned"): r"terminal: inside: cube centre is",
    }.items():
        assert re.search(expected, said[key]), said[key]
    assert set(summary["skipped_episodes"]) == {"nan_in_plan", "empty_plan", "cut_off"}
    assert "should be non-empty" in summary["skipped_episodes"]["empty_plan"]
    assert "NaN" in summary["skipped_episodes"]["nan_in_plan"]
    text = describe_run(summary)
    assert "  cut_off: not evaluated: " in text
