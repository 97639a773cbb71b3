"""What tests of whole runs share."""

import pytest

from twin.replay import runner


@pytest.fixture(autouse=True)
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test replaces is in this process: others start only where a test asks for them."""
    monkeypatch.setattr(runner, "default_size", lambda: 1)
