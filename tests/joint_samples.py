"""Joint states that say positions only, as most tests need them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from bridge.episode.cdr.messages import JointSample


def at_positions(
    stamp_ns: int, names: Sequence[str], position: Float[np.ndarray, "num_joints"]
) -> JointSample:
    """Joints without velocity and effort."""
    none = np.zeros(0)
    return JointSample(
        stamp_ns=stamp_ns, names=tuple(names), position=position, velocity=none, effort=none
    )
