"""What is believed of errors whose size nobody knows: the twin's own, and localisation's noise.

Probabilities over a few sizes, as logarithms. Episodes turn one belief into the next by Bayes'
rule, so held-out episodes are judged with what the training episodes taught.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

NOISE_SHARE = (1.0, 0.5, 0.25, 0.125)
"""Of the error that localisation states, as standard deviations: what changes from pose to pose.
The rest all poses of a run have in common, because it comes from where the cameras are; the bias
explains that. Each is as likely as the next beforehand."""
POSE_DISCREPANCY_M = (0.00025, 0.0005, 0.001, 0.002, 0.004, 0.008, 0.016)
"""Sizes that are tried; the turn has the same at the edge of a 3 cm object."""
WIDTH_DISCREPANCY_M = (0.0003, 0.0006, 0.0012, 0.0024, 0.0048)
EXPECTED_M = 0.001
"""Discrepancy believed in beforehand; twice or half of it is one standard deviation away."""
EXPECTED_OF_KIND_M = {"slide": 0.003}
"""Of the kinds of which more is known. Three slides may agree by chance; at the true friction they
are off by 2.4 mm along their way and 5 mm beside it (19 slides, the scale of a Student's t)."""


def log_total(logs: Float[np.ndarray, "*rows num"]) -> Float[np.ndarray, "*rows"]:
    """Logarithm of the sum of exponentials; SciPy's checks cost more than the sum of so few."""
    top = logs.max(axis=-1)
    return np.asarray(top + np.log(np.exp(logs - top[..., None]).sum(axis=-1)))


def _normalised(logs: Float[np.ndarray, "*rows num"]) -> Float[np.ndarray, "*rows num"]:
    return np.asarray(logs - log_total(logs)[..., None])


def _beforehand(
    sizes_m: tuple[float, ...], expected_m: float = EXPECTED_M
) -> Float[np.ndarray, " num_sizes"]:
    return _normalised(-0.5 * np.log2(np.array(sizes_m) / expected_m) ** 2)


_SHARE = _normalised(np.zeros(len(NOISE_SHARE)))
_WIDTH = _beforehand(WIDTH_DISCREPANCY_M)
_POSE = np.tile(_beforehand(POSE_DISCREPANCY_M), (len(NOISE_SHARE), 1))
_POSE_OF_KIND = {
    kind: np.tile(_beforehand(POSE_DISCREPANCY_M, expected_m), (len(NOISE_SHARE), 1))
    for kind, expected_m in EXPECTED_OF_KIND_M.items()
}


@dataclass(frozen=True, kw_only=True)
class Beliefs:
    """Log-probabilities; as built, those before any episode."""

    share: Float[np.ndarray, " num_shares"] = field(default_factory=lambda: _SHARE)
    pose: Mapping[str, Float[np.ndarray, "num_shares num_sizes"]] = field(default_factory=dict)
    """Of the twin's discrepancy per kind of episode, given the share."""
    width: Float[np.ndarray, " num_width_sizes"] = field(default_factory=lambda: _WIDTH)

    def of_kind(self, kind: str) -> Float[np.ndarray, "num_shares num_sizes"]:
        """Of a kind that no episode has shown yet, what is believed beforehand."""
        return self.pose.get(kind, _POSE_OF_KIND.get(kind, _POSE))

    def after(
        self,
        poses: Mapping[str, Float[np.ndarray, "num_shares num_sizes"]],
        widths: Float[np.ndarray, " num_width_sizes"],
    ) -> tuple["Beliefs", float]:
        """Learn from the log-likelihoods of observations.

        Args:
            poses: Per kind of episode, for every share and size.
            widths: For every size.

        Returns:
            The belief afterwards, and the log-likelihood of everything under the one before.
        """
        share, pose = self.share, dict(self.pose)
        if poses:
            joint = np.stack([table + self.of_kind(kind) for kind, table in poses.items()])
            each = log_total(joint)
            share = share + each.sum(axis=0)
            pose.update(zip(poses, joint - each[..., None], strict=True))
        width = self.width + widths
        of_share, of_width = log_total(share), log_total(width)
        after = Beliefs(share=share - of_share, pose=pose, width=width - of_width)
        return after, float(of_share + of_width)

    def most_likely(self) -> dict[str, float | dict[str, float]]:
        """The likeliest share of the noise, and discrepancies [m] given it, as plain numbers."""
        share = int(np.argmax(self.share))
        return {
            "noise_share": NOISE_SHARE[share],
            "pose_m": {
                kind: POSE_DISCREPANCY_M[int(np.argmax(table[share]))]
                for kind, table in self.pose.items()
            },
            "width_m": WIDTH_DISCREPANCY_M[int(np.argmax(self.width))],
        }
