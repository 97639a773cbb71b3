"""Replay the first plan of a recorded trial in simulation and read its verdict.

The objects start where the planner saw them. ``robot-gst replay`` localises them itself.

Run: python examples/replay_plan.py runs/demo/episodes/trial_0001.mcap
"""

import sys
from pathlib import Path

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.geometry import se3
from twin.replay.config import ReplayConfig
from twin.replay.scene import ReplayScene
from twin.replay.verdict import replay_plan


def main(path: Path) -> None:
    """Print verdict, factors and where each object ended."""
    episode = Episode.open(path)
    _, plan = streams.plans(episode)[0]
    urdf = streams.robot_description(episode)
    if urdf is None:
        sys.exit(f"{path} holds no robot description")
    poses = {name: se3.pose_from_record(pose) for name, pose in plan.entities.items()}
    scene = ReplayScene(task=streams.task_file(episode).task(), Ts_base_object=poses, urdf=urdf)
    result = replay_plan(plan, scene, ReplayConfig())

    verdict = result.verdict
    print(f"{plan.id}: accepted {verdict.accepted}")
    for name in ("ik", "clearance", "terminal"):
        factor = getattr(verdict, name)
        print(f"  {name}: {factor.value} {factor.cause or ''} {factor.detail or ''}".rstrip())
    for name, Ts in result.Ts_base_object.items():
        print(f"  {name} ends at {Ts[-1, :3, 3].round(3)} m")
    print(f"  smallest clearance {1000 * result.clearance_m.min():.1f} mm")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
