"""A recorder and a publisher as processes of their own, to be broken in every way."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from fault_account import LiveCell
from fault_cell import FaultCell


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[FaultCell]:
    """Starts processes; ends what is left of them."""
    with FaultCell(tmp_path) as made:
        yield made


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveCell]:
    """One recorder and one publisher for all tests of a file; each records an episode."""
    with FaultCell(tmp_path_factory.mktemp("live")) as made:
        made.record("--color", "as_is")
        yield LiveCell(made, made.publisher())
