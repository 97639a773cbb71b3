"""The frames of an episode with the robot's base as their root, wherever /tf says where it is."""

from collections.abc import Sequence

import numpy as np

from bridge.episode import schema
from bridge.episode.cdr.messages import FrameTransform, transforms_from_cdr
from bridge.episode.reader import Episode
from bridge.episode.transforms import TransformTree
from bridge.geometry import se3
from bridge.task.robot import BASE_FRAME

SAME = 1e-6
"""A base whose pose varies by more, in metres or in a rotation's entries, drives about."""


def base_tree(episode: Episode) -> TransformTree:
    """Collect ``/tf`` and ``/tf_static``; see ``rooted_in_base``."""
    transforms: list[FrameTransform] = []
    for message in episode.messages(episode.topics_of_type(schema.TF_MESSAGE)):
        transforms.extend(transforms_from_cdr(message.data))
    return TransformTree(rooted_in_base(transforms))


def rooted_in_base(transforms: Sequence[FrameTransform]) -> list[FrameTransform]:
    """Turn round what lies between the robot's base and the root above it.

    Drivers often hang the base on a frame ``world``. Joints, plans and objects are given in the
    base, so the scene has to be, too. A base that moves in its root keeps it: it is the room that
    stands still then.
    """
    parents = {item.child: item.parent for item in transforms}
    above: list[str] = []
    frame = BASE_FRAME
    while frame in parents and frame not in above:
        above.append(frame)
        frame = parents[frame]
    if not above or not all(_stands(transforms, child) for child in above):
        return list(transforms)
    return [
        FrameTransform(
            stamp_ns=item.stamp_ns,
            parent=item.child,
            child=item.parent,
            T_parent_child=se3.invert(item.T_parent_child),
        )
        if item.child in above
        else item
        for item in transforms
    ]


def _stands(transforms: Sequence[FrameTransform], child: str) -> bool:
    """Whether one frame always has the same place in the same parent."""
    own = [item for item in transforms if item.child == child]
    first = own[0]
    return all(
        item.parent == first.parent
        and np.allclose(item.T_parent_child, first.T_parent_child, rtol=0.0, atol=SAME)
        for item in own
    )
