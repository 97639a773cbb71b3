"""Drive the arm in the twin by keys: of a page in the browser, or of a file.

The page lies on the loopback address under a path nobody can guess, and is left without keys when
it has not been heard for half a second.
"""

import json
import secrets
import threading
import time
from collections.abc import Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from bridge.errors import PathNotFoundError
from bridge.media.color import encode_jpeg
from bridge.terminal import Output
from twin.policies.errors import PolicyError
from twin.policies.mapping import END, Actions, Picture, PolicyMap

RATE_HZ, SIZE = 15.0, (320, 240)
SPEED = np.array([0.12, 0.12, 0.12, 0.6, 0.6, 0.6])
"""Of the tool, along and about the axes of the base [m/s, rad/s]."""
RISES = SPEED / 0.3
"""How fast a speed changes."""
PADS_M_S = 0.1
AXES = {
    "w": (0, 1),
    "s": (0, -1),
    "a": (1, 1),
    "d": (1, -1),
    "r": (2, 1),
    "f": (2, -1),
    "right": (3, 1),
    "left": (3, -1),
    "up": (4, 1),
    "down": (4, -1),
    "q": (5, 1),
    "e": (5, -1),
}
"""What a held key moves: which entry of the speed, and which way."""
GRIPPER, DONE, WAIT = "space", "enter", "wait"
SILENT_S = 0.5
OPENED_S = 600.0
"""How long it waits for somebody to open the page."""
MOST_BYTES, BOUNDARY = 1000, "picture"


def drive_mapping(cameras: tuple[str, ...]) -> PolicyMap:
    """What keys are sent, and how their answer is read."""
    return PolicyMap(
        rate_hz=RATE_HZ,
        horizon=1,
        images={name: Picture(camera=name, size=SIZE) for name in cameras},
        state={"width_m": ("width_m",)},
        actions=Actions(kind="ee_delta"),
    )


class KeyFile:
    """Keys of a file: a line is names joined by ``+`` and how long they are held [s]."""

    def __init__(self, path: Path) -> None:
        """Read it.

        Raises:
            PolicyError: A line that is none, with its number.
        """
        if not path.is_file():
            hint = "A line is a key and seconds: w 1.2."
            raise PathNotFoundError(path=path, what="file of keys", hint=hint)
        self._steps = iter(list(_steps(path)))
        self._told = ""

    def held(self) -> frozenset[str] | None:
        """The next step of the file."""
        return next(self._steps, None)

    def show(self, pictures: dict[str, UInt8[np.ndarray, "height width 3"]], prompt: str) -> None:
        """Nobody looks."""

    def tell(self, text: str) -> None:
        """Say which limit it is, once for each."""
        if text.partition(":")[0] != self._told:
            Output().say(text)
        self._told = text.partition(":")[0]

    def close(self) -> None:
        """Nothing is open."""


def _steps(path: Path) -> Iterator[frozenset[str]]:
    known = {*AXES, GRIPPER, DONE, WAIT}
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        keys = frozenset(words[0].lower().split("+"))
        try:
            seconds = float(words[1]) if len(words) > 1 else 1.0 / RATE_HZ
        except ValueError:
            seconds = -1.0
        if len(words) > 2 or not keys <= known or not 0 <= seconds <= 600:
            raise PolicyError(
                f"{path}, line {number}: {line.strip()[:60]!r} is not keys and seconds; "
                f"keys: {', '.join(sorted(known))}"
            )
        yield from (keys for _ in range(max(1, round(seconds * RATE_HZ))))


class KeyPage:
    """A page on this machine that shows the cameras and sends the keys that are held."""

    def __init__(self) -> None:
        """Serve it, and say where."""
        self._token = secrets.token_urlsafe(16)
        self._changed = threading.Condition()
        self._keys: frozenset[str] = frozenset()
        self._heard_s = 0.0
        self._due_s = 0.0
        self.jpegs: dict[str, bytes] = {}
        self._count = 0
        self._told, self._prompt = "", ""
        self.allowed = (
            "default-src 'none'; img-src 'self' data:; connect-src 'self'; "
            "style-src 'unsafe-inline'; "
            f"script-src 'nonce-{self._token}'; frame-ancestors 'none'; base-uri 'none'"
        )
        handler = type("Handler", (_Handler,), {"served": self})
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self._server.daemon_threads = True
        self.address = f"http://127.0.0.1:{self._server.server_port}/{self._token}/"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        Output().say(f"drive it: {self.address}")

    def held(self) -> frozenset[str] | None:
        """Wait for the time of the next step; keys of a page that fell silent are let go."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._heard_s > 0, timeout=OPENED_S):
                raise PolicyError(f"nobody opened the page {self.address}")
        now = time.monotonic()
        self._due_s = max(self._due_s + 1.0 / RATE_HZ, now)
        time.sleep(self._due_s - now)
        silent = time.monotonic() - self._heard_s > SILENT_S
        return frozenset() if silent else self._keys

    def show(self, pictures: dict[str, UInt8[np.ndarray, "height width 3"]], prompt: str) -> None:
        """Send the pictures to whoever looks."""
        jpegs = {name: encode_jpeg(picture) for name, picture in pictures.items()}
        with self._changed:
            self.jpegs, self._prompt, self._count = jpegs, prompt, self._count + 1
            self._changed.notify_all()

    def tell(self, text: str) -> None:
        """Show it under the pictures."""
        self._told = text

    def close(self) -> None:
        """Stop serving."""
        with self._changed:
            self._count = -1
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()

    def asked(self, path: str, host: str) -> str | None:
        """What a request asks of this page; None where it was not sent to it by its own address."""
        names = {f"{name}:{self._server.server_port}" for name in ("127.0.0.1", "localhost")}
        head = f"/{self._token}/"
        return path[len(head) :] if host in names and path.startswith(head) else None

    def html(self) -> str:
        """The page, with the cameras that there are."""
        with self._changed:
            self._changed.wait_for(lambda: self._count != 0, timeout=OPENED_S)
        template = Template(Path(__file__).with_name("drive.html").read_text())
        figures = "".join(f'<img data-stream="{n}.mjpg" alt="camera {n}">' for n in self.jpegs)
        return template.substitute(figures=figures, nonce=self._token)

    def press(self, keys: frozenset[str]) -> dict[str, str]:
        """Remember what is held; returns what there is to read."""
        with self._changed:
            self._keys, self._heard_s = keys, time.monotonic()
            self._changed.notify_all()
        told, self._told = self._told, ""
        return {"told": told, "task": self._prompt}

    def frames(self, camera: str) -> Iterator[bytes]:
        """One JPEG after another."""
        seen = 0
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._count != seen)  # noqa: B023  # waits here
                if self._count < 0 or camera not in self.jpegs:
                    return
                seen, jpeg = self._count, self.jpegs[camera]
            yield jpeg


class KeyPolicy:
    """Turns held keys into motions of the tool that begin and end gently."""

    def __init__(self, source: KeyFile | KeyPage) -> None:
        """Nothing moves yet."""
        self.metadata: dict[str, Any] = {"name": "keys"}
        self._source = source
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Begin at rest, with the pads as they are."""
        del seed
        self._speed: Float[np.ndarray, 6] = np.zeros(6)
        self._width_m: float | None = None
        self._opens, self._pressed = True, False

    def infer(self, observation: dict[str, Any]) -> Any:
        """One step of the tool, or the end."""
        pictures = {name: item for name, item in observation.items() if np.ndim(item) == 3}
        self._source.show(pictures, str(observation["prompt"]))
        held = self._source.held()
        if held is None or DONE in held:
            return END
        wanted = np.zeros(6)
        for key in held & AXES.keys():
            axis, way = AXES[key]
            wanted[axis] += way * SPEED[axis]
        most = RISES / RATE_HZ
        self._speed = self._speed + np.clip(wanted - self._speed, -most, most)
        return np.append(self._speed / RATE_HZ, self._pads(held, observation))[None]

    def _pads(self, held: frozenset[str], observation: dict[str, Any]) -> float:
        """Each press of the gripper's key turns the pads round."""
        widest = float(observation["width_m"][0])
        if self._width_m is None:
            self._width_m = self._widest_m = widest
        if GRIPPER in held and not self._pressed:
            self._opens = not self._opens
        self._pressed = GRIPPER in held
        step = PADS_M_S / RATE_HZ * (1 if self._opens else -1)
        self._width_m = float(np.clip(self._width_m + step, 0.0, self._widest_m))
        return self._width_m

    def refused(self, text: str) -> bool:
        """The arm slows down, whoever drives reads why, and goes on."""
        self._speed = np.zeros(6)
        self._source.tell(text)
        return True

    def close(self) -> None:
        """Close the page."""
        self._source.close()


class _Handler(BaseHTTPRequestHandler):
    """Answers the page; everything else is not found."""

    served: KeyPage

    def do_GET(self) -> None:  # the name of the library
        """The page and its pictures."""
        asked = self._asked()
        if asked == "":
            self._send(self.served.html().encode(), "text/html; charset=utf-8")
        elif asked is not None and asked.removesuffix(".mjpg") in self.served.jpegs:
            self._head(f"multipart/x-mixed-replace; boundary={BOUNDARY}")
            for jpeg in self.served.frames(asked.removesuffix(".mjpg")):
                head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}"
                self.wfile.write(head.encode() + b"\r\n\r\n" + jpeg + b"\r\n")
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:  # the name of the library
        """Keys that are held."""
        length = self.headers.get("Content-Length", "")
        if self._asked() != "keys" or not length.isdigit() or int(length) > MOST_BYTES:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        try:
            keys = json.loads(self.rfile.read(int(length)))
            held = frozenset(str(key) for key in keys)
        except (ValueError, TypeError):
            self.send_error(HTTPStatus.BAD_REQUEST)
            return
        self._send(json.dumps(self.served.press(held)).encode(), "application/json")

    def _asked(self) -> str | None:
        """What of the page; None: nothing of it, or by another name for this machine."""
        return self.served.asked(self.path, self.headers.get("Host", ""))

    def _head(self, kind: str, length: int | None = None) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", self.served.allowed)
        if length is not None:
            self.send_header("Content-Length", str(length))
        self.end_headers()

    def _send(self, data: bytes, kind: str) -> None:
        self._head(kind, len(data))
        self.wfile.write(data)

    def log_message(self, format: str, *args: object) -> None:  # the library's
        """Say nothing."""
