"""A recorder in this process, told what to do by calls instead of over the wire."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from bridge.episode.run_folder import RunFolder
from bridge.record import live
from bridge.record.config import RecorderConfig
from bridge.record.control import parse_info, parse_outcome
from bridge.wire.config import WireConfig
from bridge.wire.session import open_session


class LiveRecorder(live.LiveRecorder):
    def start(self, episode_id: str, **about: Any) -> dict[str, Any]:
        return self.core.start(parse_info(episode_id, about))

    def stop(self, result: str | None = None, detail: str | None = None) -> dict[str, Any]:
        return self.core.stop(outcome=_outcome(result, detail))

    def label(self, result: str, *, episode: str) -> dict[str, Any]:
        return self.core.label(outcome=_outcome(result, None), episode=episode)

    def status(self) -> dict[str, Any]:
        return self.core.status()


def _outcome(result: str | None, detail: str | None) -> Any:
    if result is None:
        return None
    return parse_outcome(
        {"result": result, "k": int(result == "success"), "n": 1, "detail": detail}
    )


@contextlib.contextmanager
def open_recorder(
    run: Path,
    *,
    wire: WireConfig,
    config: RecorderConfig | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Iterator[LiveRecorder]:
    with open_session(wire) as session:
        recorder = LiveRecorder(session, RunFolder.create(run), config or RecorderConfig(), say)
        try:
            yield recorder
        finally:
            recorder.close()
        if recorder.core.error is not None:
            raise recorder.core.error
