"""A TCP connection that carries RTDE packages, with a limit on every wait."""

import contextlib
import socket
import time
from collections import deque
from collections.abc import Callable

from bridge.sources.ur.errors import ControllerError
from bridge.sources.ur.protocol import (
    BrokenPackageError,
    Kind,
    Package,
    PackageSplitter,
    encode_package,
    text_of,
)

CONNECT_S = 3.0
AGREE_S = 5.0
"""Everything before the first sample, however slowly the answers drip in."""
SILENT_S = 2.0
"""A controller that says nothing for so long is taken for gone."""
RECEIVE_BYTES = 65_536


class RtdeLink:
    """One connection; it never waits longer than the limits above."""

    def __init__(self, host: str, port: int, *, on_text: Callable[[str], None]) -> None:
        """Connect.

        Args:
            host: Name or address of the controller.
            port: Its RTDE port.
            on_text: Told what the controller says in words.

        Raises:
            ControllerError: When nobody answers.
        """
        self.where = f"{host}:{port}"
        self._on_text = on_text
        self._splitter = PackageSplitter()
        self._waiting: deque[Package] = deque()
        try:
            self._socket = socket.create_connection((host, port), timeout=CONNECT_S)
        except OSError as error:
            raise ControllerError(
                where=self.where,
                found=f"no UR controller answers ({error.strerror or error})",
                hint="Check the address, the cable, and that the controller has started.",
            ) from error
        self._socket.settimeout(SILENT_S)
        self._agreed_by_s = time.monotonic() + AGREE_S

    def ask(self, kind: Kind, payload: bytes = b"") -> bytes:
        """Send a request and return the payload of its answer.

        Raises:
            ControllerError: When the controller goes away or takes too long.
            BrokenPackageError: When something else is answered.
        """
        try:
            self._socket.sendall(encode_package(kind, payload))
        except OSError as error:
            raise self._gone(error.strerror or str(error)) from error
        while True:
            while not self._waiting:
                self._receive()
                if time.monotonic() > self._agreed_by_s:
                    raise self._gone(f"no agreement on what to send within {AGREE_S:g} s")
            package = self._waiting.popleft()
            if package.kind == kind:
                return package.payload
            if package.kind != Kind.TEXT_MESSAGE:
                message = f"a package {chr(package.kind)!r} in answer to {chr(kind)!r}"
                raise BrokenPackageError(message)
            self._on_text(text_of(package.payload))

    def next_data(self) -> list[bytes]:
        """Wait for more and return the payloads of all data packages that are complete.

        Raises:
            ControllerError: When the controller went away.
            BrokenPackageError: When what came is no RTDE package.
        """
        if not self._waiting:
            self._receive()
        payloads = []
        while self._waiting:
            package = self._waiting.popleft()
            if package.kind == Kind.DATA:
                payloads.append(package.payload)
            elif package.kind == Kind.TEXT_MESSAGE:
                self._on_text(text_of(package.payload))
        return payloads

    def _receive(self) -> None:
        try:
            data = self._socket.recv(RECEIVE_BYTES)
        except TimeoutError as error:
            raise self._gone(f"nothing came for {SILENT_S:g} s") from error
        except OSError as error:
            raise self._gone(error.strerror or str(error)) from error
        if not data:
            raise self._gone("it closed the connection")
        self._waiting.extend(self._splitter.feed(data))

    def _gone(self, why: str) -> ControllerError:
        return ControllerError(
            where=self.where,
            found=f"the controller is gone ({why})",
            hint="Check the cable and the controller.",
        )

    def close(self) -> None:
        """Hang up."""
        with contextlib.suppress(OSError):
            self._socket.close()
