"""The nodes of a soft object as a replay wrote them, for the page's 3D view."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from bridge.episode import streams
from bridge.episode.cdr.messages import PointCloudSample
from bridge.episode.reader import Episode
from bridge.geometry import se3
from bridge.geometry.trajectory import PoseTrajectory
from dashboards.recording import Recording
from twin.scene.skinning import NUM_NEIGHBOURS, NUM_NODES, node_rotations

MAX_NODE_POSES = 40_000
"""Of one soft object in one replay, 28 bytes each: with many nodes they are sampled less often."""
MAX_NODES = 1500
"""A finer lattice is not drawn bent: the page tells no more parts than that from each other."""


@dataclass(frozen=True, kw_only=True)
class SoftNodes:
    """Where the nodes of one soft object were, in the frame of its pose."""

    stamps_ns: Int[np.ndarray, " num_states"]
    points_m: Float[np.ndarray, "num_states num_nodes 3"]
    """At rest in the first state: as the replay began."""

    def at(self, stamp_ns: float) -> Float[np.ndarray, "num_nodes 3"]:
        """Interpolate between states; before the first and after the last it is that one."""
        place = float(np.interp(stamp_ns, self.stamps_ns, np.arange(len(self.stamps_ns))))
        before, share = int(place), place - int(place)
        after = min(before + 1, len(self.stamps_ns) - 1)
        return np.asarray((1 - share) * self.points_m[before] + share * self.points_m[after])


def read_soft_nodes(replay: Recording, name: str) -> SoftNodes | None:
    """Read the nodes of a soft object; None where the replay holds none that can be drawn."""
    track = replay.objects.get(name)
    episode = Episode.open(replay.path)
    topic = streams.object_pose_topics(episode).get(name)
    if track is None or topic is None:
        return None
    messages = episode.messages([f"{topic.removesuffix('pose')}nodes"])
    samples = [PointCloudSample.from_cdr(message.data) for message in messages]
    sizes = {len(sample.points_m) for sample in samples}
    if len(sizes) != 1 or not NUM_NODES + 1 < max(sizes) <= MAX_NODES:
        return None
    points_m = np.stack([sample.points_m for sample in samples]).astype(np.float64)
    # Later states of one that burst are left out.
    whole = np.asarray(np.isfinite(points_m).all(axis=(1, 2)))
    if not whole[0]:
        return None
    count = len(whole) if whole.all() else int(whole.argmin())
    stamps_ns = np.array([sample.stamp_ns for sample in samples[:count]], dtype=np.int64)
    states = zip(track.at(stamps_ns).transforms(), points_m[:count], strict=True)
    own_m = np.stack([se3.apply(se3.invert(T), places_m) for T, places_m in states])
    return SoftNodes(stamps_ns=stamps_ns, points_m=own_m)


Bent = tuple[Float[np.ndarray, "num_nodes 3"], Float[np.ndarray, "num_states num_nodes 4 4"]]
"""Nodes unbent [m], and ``T_base_node`` at each instant."""


def bent(
    replay: Recording,
    name: str,
    track: PoseTrajectory,
    own_ns: Int[np.ndarray, " num_samples"],
) -> Bent | None:
    """Move an object's nodes to where they are, at as many of the samples as there is room for.

    Args:
        own_ns: The page's samples on the replay's clock, evenly spaced.

    Returns:
        None where there are no nodes that can be drawn.
    """
    nodes = read_soft_nodes(replay, name)
    if nodes is None:
        return None
    rest_m = nodes.points_m[0]
    num_nodes = len(rest_m)
    _, around = cKDTree(rest_m).query(rest_m, k=min(NUM_NEIGHBOURS + 1, num_nodes))
    count = int(np.clip(MAX_NODE_POSES // num_nodes, 2, len(own_ns)))
    times_ns = np.linspace(own_ns[0], own_ns[-1], count)
    Ts = np.tile(np.eye(4), (count, num_nodes, 1, 1))
    for row, (time_ns, T) in enumerate(
        zip(times_ns, track.at(times_ns.astype(np.int64)).transforms(), strict=True)
    ):
        seen_m = se3.apply(T, nodes.at(time_ns))
        R = node_rotations(rest_m, seen_m, around[:, 1:])
        Ts[row, :, :3, :3] = R
        Ts[row, :, :3, 3] = seen_m - np.einsum("nij,nj->ni", R, rest_m)
    return rest_m, Ts
