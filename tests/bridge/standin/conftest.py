"""A wire in memory, and laboratories from the seeds that are kept for tests."""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from standin_hidden import nominal_hidden

from bridge.sources.standin.cell import StandinCell
from bridge.sources.standin.cell_file import CellFile, HiddenParameters, draw_hidden, load_cell
from bridge.sources.standin.streams import Streams
from bridge.task.task_file import Task, load_task
from bridge.wire.errors import NoReplyError
from bridge.wire.qos import Qos

sys.path.insert(0, str(Path(__file__).parent))

START_NS = 1_700_000_000_000_000_000


@dataclass
class Sent:
    topic: str
    type_name: str
    data: bytes
    source_ns: int
    episode: str | None


@dataclass
class FakeSession:
    """Has the methods of ``WireSession`` that the cell uses; plays recorder and gate."""

    gate: Callable[[dict], dict] | None = None
    sent: list[Sent] = field(default_factory=list)
    control: list[tuple[str, dict]] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)
    there: list[dict] = field(default_factory=list)
    """Episodes that the recorder lists."""
    episode: str | None = None

    def publisher(self, topic: str, type_name: str, *, qos: Qos = Qos.RELIABLE) -> "FakePublisher":
        return FakePublisher(self, topic, type_name)

    def query(self, key: str, payload: bytes, *, timeout_s: float) -> bytes:
        if not payload and self.gate is not None:
            return b'{"scene_hash": null, "calibration_id": null}'
        request = json.loads(payload)
        if key.startswith("rec/main/ctl/"):
            verb = key.rsplit("/", 1)[-1]
            if verb == "list":
                return json.dumps({"of": len(self.there), "episodes": self.there}).encode()
            self.control.append((verb, request))
            self.episode = request["id"] if verb == "start" else None
            return b'{"ok": true}'
        if key == "standin/gate/verdict" and self.gate is not None:
            self.asked.append(request["id"])
            return json.dumps(self.gate(request)).encode()
        raise NoReplyError(key=key, timeout_s=timeout_s)

    def subscribe(self, key_expression: str, callback: object) -> None:
        """Nobody else sends."""

    def of(self, ending: str) -> list[Sent]:
        return [item for item in self.sent if item.topic.endswith(ending)]

    def events(self) -> list[dict]:
        return [json.loads(item.data) for item in self.of("/event")]


@dataclass
class FakePublisher:
    session: FakeSession
    topic: str
    type_name: str

    def put(self, data: bytes, *, source_ns: int) -> None:
        self.session.sent.append(
            Sent(self.topic, self.type_name, bytes(data), source_ns, self.session.episode)
        )


@pytest.fixture(scope="session")
def make_session() -> type[FakeSession]:
    return FakeSession


@pytest.fixture(scope="session")
def cell_file() -> CellFile:
    return load_cell("standin")


@pytest.fixture(scope="session")
def task() -> Task:
    return load_task("cube_into_box")


@pytest.fixture(scope="session")
def push() -> Task:
    return load_task("push_cube_to_mark")


@pytest.fixture(scope="session")
def reserved_seed(cell_file: CellFile) -> int:
    return cell_file.test_seeds[0]


@pytest.fixture(scope="session")
def nominal(cell_file: CellFile) -> HiddenParameters:
    return nominal_hidden(cell_file)


@pytest.fixture(scope="session")
def starts(task: Task, reserved_seed: int) -> dict[str, np.ndarray]:
    poses = task.draw_start(np.random.default_rng(reserved_seed))
    for T in poses.values():
        T.flags.writeable = False
    return poses


@pytest.fixture(scope="session")
def make_cell(cell_file: CellFile, task: Task, reserved_seed: int) -> Callable[..., StandinCell]:
    def make(
        session: FakeSession,
        *,
        hidden: HiddenParameters | None = None,
        seed: int = reserved_seed,
        rate_hz: float = 0.0,
        **more: object,
    ) -> StandinCell:
        return StandinCell(
            cell_file,
            task,
            draw_hidden(cell_file, seed) if hidden is None else hidden,
            Streams(session, "standin"),
            rate_hz=rate_hz,
            scale=0.25,
            seed=seed,
            start_ns=START_NS,
            **more,
        )

    return make


@pytest.fixture(scope="session")
def lab() -> CellFile:
    return load_cell("lab")


@pytest.fixture(scope="session")
def toys_cell() -> CellFile:
    return load_cell("standin_toys")


@pytest.fixture(scope="session")
def sloth() -> Task:
    return load_task("sloth_into_basket")


@pytest.fixture(scope="session")
def ducks() -> Task:
    return load_task("five_ducks_into_basket")
