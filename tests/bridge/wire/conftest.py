"""A client of the router."""

from collections.abc import Iterator

import pytest

from bridge.wire.config import WireConfig
from bridge.wire.session import WireSession, open_session


@pytest.fixture
def client(router: WireSession, endpoint: str) -> Iterator[WireSession]:
    with open_session(WireConfig(connect=(endpoint,))) as session:
        yield session
