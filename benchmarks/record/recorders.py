"""The recorders under test: ours, and the reference, each a real process."""

import time
from pathlib import Path
from typing import Any

from bridge.errors import BridgeError
from bridge.record.control import RecorderClient
from bridge.wire.config import WireConfig
from bridge.wire.session import WireSession, open_session
from record.children import WAIT_S, Child, free_endpoint, wait_until

QUIET_S = 0.5


class OurRecorder(Child):
    """``robot-gst record`` as a person starts it, controlled over the wire."""

    def __init__(self, folder: Path, *arguments: str, run: Path | None = None) -> None:
        """Start it and wait until it answers.

        Args:
            folder: For its log; also where the run folder is made.
        """
        self.run_path = run or folder / "run"
        self.endpoint = free_endpoint()
        super().__init__(
            *("robot_gst.py", "record", str(self.run_path), "--listen", self.endpoint, "--quiet"),
            *arguments,
            log=folder / "recorder.log",
        )
        self._session: WireSession | None = None
        wait_until(self._answers, f"an answer of the recorder ({self.log})")

    def _answers(self) -> bool:
        if not self.is_running():
            message = f"the recorder ended: {self.log.read_text()[-2000:]}"
            raise RuntimeError(message)
        try:
            self._session = open_session(
                WireConfig(connect=(self.endpoint,), connect_timeout_s=0.5)
            )
            self.client.status()
        except BridgeError:
            self.leave()
            return False
        return True

    @property
    def session(self) -> WireSession:
        """The benchmark's own connection to it."""
        if self._session is None:
            message = "not connected to the recorder"
            raise RuntimeError(message)
        return self._session

    @property
    def client(self) -> RecorderClient:
        """Its control keys."""
        return RecorderClient(self.session, timeout_s=WAIT_S)

    def wait_until_drained(self) -> None:
        """Wait until it has written everything that is on its way."""
        last, since_s = -1, time.monotonic()
        while time.monotonic() - since_s < QUIET_S:
            status = self.client.status()
            now = int(status.get("messages", 0)) + int(status.get("lost", 0))
            if now != last or status["queue_bytes"] > 0:
                last, since_s = now, time.monotonic()
            time.sleep(0.05)

    def stop(self) -> dict[str, Any]:
        """Finish the episode."""
        return self.client.stop()

    def leave(self) -> None:
        """Close the benchmark's connection."""
        if self._session is not None:
            self._session.close()
            self._session = None

    def end(self) -> None:
        """Leave, and kill it if it is still there."""
        self.leave()
        super().end()


class ReferenceRecorder(Child):
    """See ``reference.py``; writes one file from its start to its end."""

    def __init__(self, folder: Path) -> None:
        """Start it and wait until it listens."""
        self.endpoint = free_endpoint()
        self.path = folder / "reference.mcap"
        super().__init__(
            str(Path(__file__).with_name("reference.py")),
            *(self.endpoint, str(self.path)),
            log=folder / "reference.log",
        )
        self.expect("ready")

    def wait_until_drained(self) -> None:
        """It drains its queues itself before it finishes the file."""

    def stop(self) -> dict[str, Any]:
        """Finish the file; the process waits to be metered and then ends."""
        self.tell("stop")
        self.expect("finished")
        return {}
