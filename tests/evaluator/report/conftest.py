"""One browser for all tests of reports, and numbers that are made quickly."""

from collections.abc import Iterator

import pytest
from headless import CHROMIUM, NO_CHROMIUM, Browser, chromium

from evaluator.statistics.hierarchical import AgreementModel


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Start Chromium once for all tests of a session."""
    if CHROMIUM is None:
        pytest.skip(NO_CHROMIUM)
    with chromium(tmp_path_factory.mktemp("browser")) as tab:
        yield tab


@pytest.fixture(scope="module", autouse=True)
def few_nodes_in_reports() -> Iterator[None]:
    """Integrate the model of agreement coarsely: reports are tested for what they say."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(AgreementModel, "_enough", lambda _: 512)
        yield
