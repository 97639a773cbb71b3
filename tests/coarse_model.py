"""A coarse model of agreement: for tests of what is said, not of how exactly."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from evaluator.statistics import hierarchical


@contextmanager
def coarse_model() -> Iterator[None]:
    """Integrate with few nodes, and draw few rates."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hierarchical.AgreementModel, "_enough", lambda _: 512)
        patch.setattr(hierarchical, "NUM_DRAWS", 400)
        yield
