"""Read an episode into NumPy arrays: joints, colour, depth and camera poses.

Run: python examples/read_episode.py runs/demo/episodes/trial_0001.mcap
"""

import sys
from pathlib import Path

import numpy as np

from bridge.episode import streams
from bridge.episode.reader import Episode


def main(path: Path) -> None:
    """Print the shapes of everything that is read."""
    episode = Episode.open(path)
    info = episode.info
    print(f"{info.id}: {info.kind} of cell {info.cell}, {episode.duration_s:.1f} s")
    for topic, summary in episode.topics().items():
        print(f"  {topic}: {summary.count} x {summary.type_name}")

    joints = streams.joint_track(episode)
    start_ns = joints.stamps_ns[0]
    print(f"joints {joints.names}: positions {joints.position.shape} rad")
    print("at 0.5 s:", joints.at(np.array([start_ns + 500_000_000]))[0].round(3))

    for camera_id in streams.camera_ids(episode):
        frames = list(streams.rgbd_frames(episode, camera_id))
        images_u8 = np.stack([frame.image_u8 for frame in frames])
        depth_m = np.stack([frame.depth_m for frame in frames])
        Ts_base_color = np.stack([frame.T_base_color for frame in frames])
        print(f"camera {camera_id}: colour {images_u8.shape}, depth {depth_m.shape} m")
        print(f"  poses {Ts_base_color.shape}, first at {Ts_base_color[0, :3, 3].round(3)} m")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
