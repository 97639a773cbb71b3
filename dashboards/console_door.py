"""Who is at the operator's console: codes that work once, sessions, and which phone holds it."""

import fcntl
import hmac
import os
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bridge.errors import UsageError
from bridge.task.protocol import FILE_NAME, Protocol, read_protocol

CODE_DIGITS = 8
MOST_WRONG = 5
"""Wrong codes after which the code is replaced and nobody is let in for a while."""
CLOSED_S = 60.0
MOST_SESSIONS = 8
"""Phones at once; one more, and the first of those that do not hold it has to enter again."""


@dataclass(frozen=True, kw_only=True)
class Operator:
    """One phone that was let in."""

    session: str
    """What its cookie holds."""
    name: str
    """What the person at it is called."""


class ConsoleDoor:
    """Lets phones in by codes, and knows which of them holds the console."""

    def __init__(
        self,
        tell: Callable[[str], None] = lambda _: None,
        *,
        now_s: Callable[[], float] = time.monotonic,
        digits: Callable[[], str] = lambda: f"{secrets.randbelow(10**CODE_DIGITS):08d}",
    ) -> None:
        """Draw the first code.

        Args:
            tell: Shows a new code in the terminal, nowhere else.
            now_s: A clock that never jumps.
        """
        self._tell, self._now_s, self._digits = tell, now_s, digits
        self.code = digits()
        """Lets the next phone in; shown in the terminal only."""
        self._wrong = 0
        self._closed_until_s = 0.0
        self._operators: dict[str, Operator] = {}
        self._holder: str | None = None
        self._lock = threading.Lock()

    def closed_s(self) -> float:
        """Seconds for which no code is looked at, after too many wrong ones."""
        with self._lock:
            return max(0.0, self._closed_until_s - self._now_s())

    def enter(self, code: str, name: str) -> Operator | None:
        """Let a phone in, None with a wrong code; a code that let one in is used up.

        Args:
            code: What was typed; blanks in it do not count.
        """
        typed = "".join(code.split())
        with self._lock:
            if self._now_s() < self._closed_until_s:
                return None
            if not hmac.compare_digest(typed.encode(), self.code.encode()):
                self._wrong += 1
                if self._wrong >= MOST_WRONG:
                    self._closed_until_s = self._now_s() + CLOSED_S
                    self._renew(f"{MOST_WRONG} wrong codes: closed for {CLOSED_S:.0f} s. Then")
                return None
            operator = Operator(session=secrets.token_urlsafe(24), name=name)
            while len(self._operators) >= MOST_SESSIONS:
                del self._operators[next(s for s in self._operators if s != self._holder)]
            self._operators[operator.session] = operator
            self._holder = self._holder or operator.session
            self._renew(f"{name} is at the console. For another phone")
            return operator

    def _renew(self, why: str) -> None:
        self._wrong, self.code = 0, self._digits()
        self._tell(f"{why}: code {spaced(self.code)}")

    def operator(self, session: str) -> Operator | None:
        """Return who has a session, None where nobody has."""
        with self._lock:
            return self._operators.get(session)

    def holder(self) -> Operator | None:
        """Return who holds the console."""
        with self._lock:
            return None if self._holder is None else self._operators[self._holder]

    def take(self, operator: Operator) -> None:
        """Give the console to a phone; the one that held it is told at its next look."""
        with self._lock:
            if operator.session in self._operators:
                self._holder = operator.session


def locked_protocol(run_path: Path) -> Protocol:
    """Return the protocol that the console goes through.

    Raises:
        UsageError: When there is none, or it was edited after it was written.
    """
    protocol = read_protocol(run_path)
    if protocol is None:
        message = (
            f"{run_path} has no {FILE_NAME}: the console goes through the trials of a protocol. "
            f"Make one: robot-gst design {run_path} --starts 10"
        )
        raise UsageError(message)
    if protocol.edited:
        message = f"{run_path / FILE_NAME} was edited after it was written: put the text back."
        raise UsageError(message)
    return protocol


def claim_console(run_path: Path) -> int:
    """Keep other servers from the console of a run, until this process ends.

    Returns:
        The descriptor that holds it.

    Raises:
        UsageError: When another server has it, or the run has no protocol to go through.
    """
    locked_protocol(run_path)
    descriptor = os.open(run_path / FILE_NAME, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        message = f"another dashboard has the console of {run_path} open. Stop it, or use that one."
        raise UsageError(message) from error
    return descriptor


def spaced(code: str) -> str:
    """Write a code in groups of four, as people read numbers aloud."""
    return " ".join(code[at : at + 4] for at in range(0, len(code), 4))
