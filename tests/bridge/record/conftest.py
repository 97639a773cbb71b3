"""Samples and recorders for these tests."""

import itertools
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from joint_samples import at_positions

from bridge.clock import AnchoredClock
from bridge.episode import schema
from bridge.episode.run_folder import RunFolder
from bridge.record.config import RecorderConfig
from bridge.record.recorder import Recorder
from bridge.wire.session import WireSample

MakeSample = Callable[..., WireSample]
MakeRecorder = Callable[..., Recorder]


@pytest.fixture
def make_sample() -> MakeSample:
    counter = itertools.count()
    clock = AnchoredClock()

    def make(**changes: object) -> WireSample:
        number = next(counter)
        joint = at_positions(number, ("a",), np.array([float(number)]))
        values: dict[str, object] = {
            "topic": "/cell/joint_states",
            "type_name": schema.JOINT_STATE,
            "message_encoding": "cdr",
            "data": joint.to_cdr(),
            "source_ns": 1_000 + number,
            "sequence": number,
            "source_gid": b"g" * 16,
            "received_ns": clock.now_ns(),
        }
        return WireSample(**{**values, **changes})  # type: ignore[arg-type]

    return make


@pytest.fixture
def recorder(run: RunFolder) -> Iterator[Recorder]:
    made = Recorder(run, now_ns=AnchoredClock().now_ns)
    yield made
    made.close()


@pytest.fixture
def make_recorder(run: RunFolder) -> Iterator[MakeRecorder]:
    made: list[Recorder] = []

    def make(
        *, run: RunFolder = run, wall_ns: Callable[[], int] = time.time_ns, **settings: object
    ) -> Recorder:
        clock = AnchoredClock()
        config = RecorderConfig(**settings)  # type: ignore[arg-type]
        made.append(Recorder(run, now_ns=clock.now_ns, config=config, wall_ns=wall_ns))
        return made[-1]

    yield make
    for recorder in made:
        recorder.close()
