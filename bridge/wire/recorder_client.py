"""Asking a recorder from another process."""

import json
from typing import Any

from bridge.wire.errors import WireError
from bridge.wire.session import WireSession


def control_key(recorder: str, verb: str) -> str:
    """The key that one command of a recorder is sent to."""
    return f"rec/{recorder}/ctl/{verb}"


class RecorderClient:
    """Start, stop, mark, label and status of one recorder over the wire."""

    def __init__(
        self, session: WireSession, recorder: str = "main", *, timeout_s: float = 60.0
    ) -> None:
        """Choose the recorder by name."""
        self._session = session
        self._recorder = recorder
        self._timeout_s = timeout_s

    def ask(self, verb: str, request: dict[str, Any] | None = None) -> dict[str, Any]:
        """Send one command and return the recorder's answer.

        Raises:
            RemoteError: When the recorder refused.
            NoReplyError: When no recorder of that name answered.
        """
        key = control_key(self._recorder, verb)
        payload = json.dumps(request or {}).encode()
        answer = json.loads(self._session.query(key, payload, timeout_s=self._timeout_s))
        if not isinstance(answer, dict):
            raise WireError(f"{key} answered {answer!r:.80}, expected a JSON object.")
        return answer

    def start(self, episode_id: str, info: dict[str, Any] | None = None) -> dict[str, Any]:
        """Begin an episode."""
        return self.ask("start", {"id": episode_id, "info": info or {}})

    def stop(
        self, outcome: dict[str, Any] | None = None, *, discard: bool = False
    ) -> dict[str, Any]:
        """Finish it after everything this session has sent so far."""
        return self.ask("stop", {"outcome": outcome, "discard": discard})

    def status(self) -> dict[str, Any]:
        """Ask what is going on."""
        return self.ask("status")
