"""A second process that runs one module of this program, and ends when its owner does.

It speaks over its own standard streams alone. So it ends with the object that stands for it, and
with the program that holds that object, however that ends: the stream it listens to closes.
"""

import importlib
import os
import pickle
import queue
import selectors
import signal
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import IO, Any, BinaryIO

LENGTH_BYTES = 8
"""Before each message: how long it is."""
PATIENCE_S = 60.0
"""With a process that takes nothing of what it is sent, although it listens before all else."""

Read = Callable[[int], bytes | None]
"""Returns at most so many bytes of a stream, none at its end."""


class ChildProcess:
    """The process as its owner sees it."""

    def __init__(self, module: str, environment: Mapping[str, str] | None = None) -> None:
        """Start it; it begins to import at once.

        Args:
            module: Its ``serve(receive, outbox)`` is called. ``receive`` waits for a message that
                was sent here; ``outbox`` leads to ``process.stdout``.
            environment: Added to this process's own.

        Raises:
            OSError: When the system gives no further process.
        """
        places = os.pathsep.join(place or os.getcwd() for place in sys.path)  # noqa: PTH109
        self.process = subprocess.Popen(
            # The program's own main module stays unloaded.
            [sys.executable, "-P", "-m", __name__, module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **(environment or {}), "PYTHONPATH": places},
        )
        assert self.process.stdin is not None  # noqa: S101  # for the type checker
        os.set_blocking(self.process.stdin.fileno(), False)
        self.end = weakref.finalize(self, _end, self.process)
        """End the process and wait for it; does nothing the second time."""

    def send(self, message: object) -> None:
        """Hand over a message, and go on; one that has ended is found out when it should answer.

        One that does not listen, because it was stopped say, is ended.
        """
        assert self.process.stdin is not None  # noqa: S101  # for the type checker
        inlet, left = self.process.stdin.fileno(), memoryview(_packed(message))
        with suppress(OSError), selectors.DefaultSelector() as room:
            room.register(inlet, selectors.EVENT_WRITE)
            while left:
                if not room.select(PATIENCE_S):
                    self.process.kill()
                    return
                left = left[os.write(inlet, left) :]


def _end(process: "subprocess.Popen[bytes]") -> None:
    process.kill()
    with suppress(OSError), process:  # closes the pipes, one perhaps half written, and waits
        pass


def send(stream: IO[bytes], message: object) -> None:
    """Write one message.

    Raises:
        OSError: When nobody listens any more.
    """
    stream.write(_packed(message))
    stream.flush()


def _packed(message: object) -> bytes:
    data = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
    return len(data).to_bytes(LENGTH_BYTES, "big") + data


def receive(read: Read) -> bytes:
    """Wait for the next message, and read not a byte beyond it.

    Raises:
        EOFError: When nobody is left to speak.
        OSError: When the stream breaks.
    """
    return _exactly(read, int.from_bytes(_exactly(read, LENGTH_BYTES), "big"))


def _exactly(read: Read, size: int) -> bytes:
    found = bytearray()
    while len(found) < size:
        more = read(size - len(found))
        if not more:
            raise EOFError
        found += more
    return bytes(found)


def _listen(inbox: BinaryIO, arrived: "queue.SimpleQueue[bytes]") -> None:
    with suppress(EOFError, OSError):
        while True:
            arrived.put(receive(inbox.read))
    os._exit(0)  # in the middle of anything: nobody waits for it


def _serve(module: str, inbox: BinaryIO, outbox: BinaryIO) -> None:
    arrived: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(inbox, arrived), daemon=True).start()
    serve: Callable[[Callable[[], Any], BinaryIO], None] = importlib.import_module(module).serve
    serve(lambda: pickle.loads(arrived.get()), outbox)


def _main() -> None:
    # The owner decides when to stop; Ctrl-C reaches every process of the terminal.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    to_owner = os.dup(1)
    with open(os.devnull, "wb") as nowhere:  # noqa: PTH123
        os.dup2(nowhere.fileno(), 1)  # a library that prints must not speak to the owner
    with open(0, "rb", closefd=False) as inbox, open(to_owner, "wb") as outbox:  # noqa: PTH123
        _serve(sys.argv[1], inbox, outbox)


if __name__ == "__main__":
    _main()
