"""The frames of an episode over time: ``/tf`` and ``/tf_static`` as one tree."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Int

from bridge.episode.cdr.messages import FrameTransform
from bridge.errors import BridgeError
from bridge.geometry import se3
from bridge.geometry.trajectory import PoseTrajectory


def _ambiguous(frame: str, parents: list[str]) -> BridgeError:
    """Say of a frame that it has several parents, or is its own ancestor."""
    return BridgeError(
        f"frame {frame!r} hangs on {' and '.join(map(repr, parents))}; where it is cannot be "
        "said. Two publishers of /tf disagree: record again with one of them."
    )


class TransformTree:
    """Answers ``T_root_frame`` at any stamp, interpolating moving frames."""

    def __init__(self, transforms: Iterable[FrameTransform]) -> None:
        """Collect transforms in any order; static ones are those seen once."""
        collected: dict[str, tuple[str, dict[int, Float[np.ndarray, "4 4"]]]] = {}
        claims: dict[str, set[str]] = {}
        for item in transforms:
            claims.setdefault(item.child, set()).add(item.parent)
            _, samples = collected.setdefault(item.child, (item.parent, {}))
            samples[item.stamp_ns] = item.T_parent_child
        self._disputed = {
            child: sorted(parents) for child, parents in claims.items() if len(parents) > 1
        }
        self._parents = {child: parent for child, (parent, _) in collected.items()}
        self._tracks: dict[str, PoseTrajectory] = {}
        for child, (_, samples) in collected.items():
            stamps = sorted(samples)
            q, p = se3.split(np.stack([samples[stamp] for stamp in stamps]))
            self._tracks[child] = PoseTrajectory(np.array(stamps, dtype=np.int64), p, q)

    def frames(self) -> list[str]:
        """All frames, parents included."""
        return sorted(set(self._parents) | set(self._parents.values()))

    def root_of(self, frame: str) -> str:
        """Follow parents up to the frame that has none."""
        if frame not in self._parents and frame not in self._parents.values():
            known = f"Frames in this episode: {', '.join(self.frames()) or 'none'}."
            raise BridgeError(f"no transform for frame {frame!r}. {known}")
        seen: list[str] = []
        while frame in self._parents:
            if frame in self._disputed:
                raise _ambiguous(frame, self._disputed[frame])
            if frame in seen:
                raise _ambiguous(frame, ["itself", *seen])
            seen.append(frame)
            frame = self._parents[frame]
        return frame

    def stamps_ns(self, frame: str) -> Int[np.ndarray, " num_stamps"]:
        """When a frame's pose was stated; in between it is interpolated.

        Of several transforms on the way to the root, the one that was stated most often counts.
        """
        root, stamps = self.root_of(frame), np.zeros(0, dtype=np.int64)
        while frame != root:
            stamps = max(stamps, self._tracks[frame].stamps_ns, key=len)
            frame = self._parents[frame]
        return stamps

    def T_root_frame(self, frame: str, stamp_ns: int) -> Float[np.ndarray, "4 4"]:
        """Pose of a frame in its root at one instant."""
        T: Float[np.ndarray, "4 4"] = self.Ts_root_frame(frame, np.array([stamp_ns]))[0]
        return T

    def Ts_root_frame(
        self, frame: str, stamps_ns: Int[np.ndarray, " num_stamps"]
    ) -> Float[np.ndarray, "num_stamps 4 4"]:
        """Poses of a frame in its root at many instants; raises as ``T_root_frame``."""
        root = self.root_of(frame)
        Ts = np.broadcast_to(np.eye(4), (len(stamps_ns), 4, 4))
        while frame != root:
            Ts = self._tracks[frame].at(stamps_ns).transforms() @ Ts
            frame = self._parents[frame]
        return np.array(Ts)
