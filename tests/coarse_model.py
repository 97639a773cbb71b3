"""The model of agreement with few nodes: for tests of what is said, not of how exactly."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from evaluator.statistics.hierarchical import AgreementModel


@contextmanager
def coarse_model() -> Iterator[None]:
    """Integrate coarsely, some ten times as fast."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(AgreementModel, "_enough", lambda _: 512)
        yield
