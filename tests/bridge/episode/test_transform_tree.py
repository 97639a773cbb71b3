"""Laws of the frames of an episode: chains multiply from the root down, motion is interpolated."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.episode.cdr.messages import FrameTransform
from bridge.episode.transforms import TransformTree
from bridge.geometry import se3


def pose(rng: np.random.Generator) -> np.ndarray:
    return se3.transform_from(rng.normal(size=4), rng.normal(size=3))


def transform(parent: str, child: str, T: np.ndarray, stamp_ns: int = 0) -> FrameTransform:
    return FrameTransform(parent=parent, child=child, stamp_ns=stamp_ns, T_parent_child=T)


@given(st.integers(0, 10**6), st.permutations([0, 1, 2]))
def test_a_chain_is_the_product_from_the_root_down(seed: int, order: list[int]) -> None:
    rng = np.random.default_rng(seed)
    T_base_hand, T_hand_camera, T_camera_lens = (pose(rng) for _ in range(3))
    items = [
        transform("base", "hand", T_base_hand),
        transform("hand", "camera", T_hand_camera),
        transform("camera", "lens", T_camera_lens),
    ]
    tree = TransformTree([items[index] for index in order])
    p_lens = rng.normal(size=(5, 3))
    p_hand = se3.apply(T_hand_camera, se3.apply(T_camera_lens, p_lens))
    np.testing.assert_allclose(
        se3.apply(tree.T_root_frame("lens", 0), p_lens), se3.apply(T_base_hand, p_hand), atol=1e-9
    )
    np.testing.assert_allclose(tree.T_root_frame("base", 0), np.eye(4))


def test_a_camera_in_a_moving_hand_moves_with_it() -> None:
    """Half way between two stamps the hand is half way, and the camera beside it."""
    end = np.eye(4)
    end[0, 3] = 2.0
    T_hand_camera = se3.transform_from(np.array([0.8, 0.0, 0.6, 0.0]), np.array([0.0, 0.1, 0.0]))
    tree = TransformTree(
        [
            transform("base", "hand", np.eye(4), 0),
            transform("base", "hand", end, 100),
            transform("hand", "camera", T_hand_camera),
        ]
    )
    for stamp_ns, x in ((-50, 0.0), (0, 0.0), (50, 1.0), (100, 2.0), (900, 2.0)):
        T = tree.T_root_frame("camera", stamp_ns)
        assert T[0, 3] == pytest.approx(x)
        np.testing.assert_allclose(T[:3, :3], T_hand_camera[:3, :3], atol=1e-12)
