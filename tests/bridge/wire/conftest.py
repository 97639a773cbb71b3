"""A router and a client of it over real TCP on the loopback address."""

from collections.abc import Iterator

import pytest

from bridge.wire.config import WireConfig
from bridge.wire.session import WireSession, open_session


@pytest.fixture
def router(endpoint: str) -> Iterator[WireSession]:
    with open_session(WireConfig(mode="router", connect=(), listen=(endpoint,))) as session:
        yield session


@pytest.fixture
def client(router: WireSession, endpoint: str) -> Iterator[WireSession]:
    with open_session(WireConfig(connect=(endpoint,))) as session:
        yield session
