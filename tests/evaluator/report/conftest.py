"""One browser for all tests of reports."""

from collections.abc import Iterator

import pytest
from headless import CHROMIUM, NO_CHROMIUM, Browser, chromium


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Start Chromium once for all tests of a session."""
    if CHROMIUM is None:
        pytest.skip(NO_CHROMIUM)
    with chromium(tmp_path_factory.mktemp("browser")) as tab:
        yield tab
