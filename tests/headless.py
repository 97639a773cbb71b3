"""Chromium without a window, for tests of pages, driven over its DevTools pipe."""

import base64
import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BufferedReader
from pathlib import Path
from typing import IO, Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
NO_CHROMIUM = "no chromium on this machine (Debian: chromium)"
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
)
"""It draws on the processor, asks nobody for anything, and may be run as root."""

ACCESSIBLE = Path(__file__).with_name("accessible.js")
"""What keeps somebody from reading a page: an expression for ``Browser.ask``."""

SOFTWARE_WEBGL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Instead of --disable-gpu, without which there is no WebGL on a machine without a GPU."""


@dataclass
class Browser:
    """One tab. What the page asks for and complains of is kept."""

    commands: IO[bytes]
    answers: BufferedReader
    session: str | None = None
    asked: list[str] = field(default_factory=list)
    """Every address that was requested since the page was opened."""
    complaints: list[str] = field(default_factory=list)
    _number: int = 0
    _frame: str = ""
    """Of the tab itself; pages in pages have their own."""
    _loaded: list[str] = field(default_factory=list)
    """Documents that have been loaded. A load event alone does not say of which document it is."""

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Give one command and wait for its answer."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        if self.session is not None:
            message["sessionId"] = self.session
        self.commands.write(json.dumps(message).encode() + b"\0")
        self.commands.flush()
        while True:
            answer = self._read()
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return dict(answer["result"])

    def _read(self) -> dict[str, Any]:
        data = bytearray()
        while not data.endswith(b"\0"):
            waiting = self.answers.peek()
            assert waiting, "the browser ended"
            data += self.answers.read(waiting.find(b"\0") + 1 or len(waiting))
        answer = dict(json.loads(data[:-1]))
        self._note(answer.get("method", ""), answer.get("params", {}))
        return answer

    def _note(self, method: str, params: dict[str, Any]) -> None:
        if (
            method == "Page.lifecycleEvent"
            and params["name"] == "load"
            and params["frameId"] == self._frame
        ):
            self._loaded.append(params["loaderId"])
        elif method == "Network.requestWillBeSent":
            self.asked.append(params["request"]["url"])
        elif method == "Runtime.consoleAPICalled":
            self.complaints.append(str(params["args"]))
        elif method == "Runtime.exceptionThrown":
            self.complaints.append(str(params["exceptionDetails"]))
        elif method == "Log.entryAdded":
            self.complaints.append(f"{params['entry']['source']}: {params['entry']['text']}")
        elif method == "Audits.issueAdded":
            self.complaints.append(str(params["issue"]["code"]))

    def show(self, address: str, *, width: int, dark: bool) -> None:
        """Open an address at this width [px] and wait until it is there."""
        self.asked.clear()
        self.complaints.clear()
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=900,
            deviceScaleFactor=1,
            mobile=False,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", media="screen", features=[scheme])
        to = self.call("Page.navigate", url=address)
        while "loaderId" in to and to["loaderId"] not in self._loaded:
            self._read()

    def ask(self, expression: str) -> Any:
        """Return the value of a JavaScript expression; the page's own policy does not bind it."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def ask_when(self, condition: str) -> None:
        """Wait until a JavaScript condition holds, looked at before each repaint."""
        expression = (
            "new Promise((done) => { const look = () =>"
            f" ({condition}) ? done() : requestAnimationFrame(look); look(); }})"
        )
        self.call("Runtime.evaluate", expression=expression, awaitPromise=True)

    def press(self, key: str) -> None:
        """Press a key as a person would."""
        told = {"text": key} if len(key) == 1 else {}
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key, **told)

    def picture(self) -> bytes:
        """Take a PNG of the whole page."""
        size = self.call("Page.getLayoutMetrics")["cssContentSize"]
        clip = {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}
        found = self.call("Page.captureScreenshot", captureBeyondViewport=True, clip=clip)
        return base64.b64decode(found["data"])


@contextmanager
def chromium(home: Path, *, webgl: bool = False) -> Iterator[Browser]:
    """Start Chromium with its own home folder; end it with the block."""
    assert CHROMIUM is not None
    drawing = SOFTWARE_WEBGL if webgl else ("--disable-gpu",)
    to_read, commands = os.pipe()
    answers, to_write = os.pipe()
    # Chromium reads commands from 3 and answers on 4.
    command = [CHROMIUM, *FLAGS, *drawing, f"--user-data-dir={home / 'profile'}"]
    shell = f'exec "$@" 3<&{to_read} 4>&{to_write}'
    process = subprocess.Popen(
        ["bash", "-c", shell, "bash", *command],
        pass_fds=(to_read, to_write),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "HOME": str(home)},
    )
    os.close(to_read)
    os.close(to_write)
    try:  # it ends with its pipe, at the latest
        with os.fdopen(commands, "wb") as into, os.fdopen(answers, "rb") as out:
            tab = Browser(into, out)
            target = tab.call("Target.createTarget", url="about:blank")["targetId"]
            attached = tab.call("Target.attachToTarget", targetId=target, flatten=True)
            tab.session = attached["sessionId"]
            for domain in ("Page", "Network", "Runtime", "Log", "Audits"):
                tab.call(f"{domain}.enable")
            tab.call("Page.setLifecycleEventsEnabled", enabled=True)
            tab._frame = tab.call("Page.getFrameTree")["frameTree"]["frame"]["id"]
            yield tab
            tab.session = None
            tab.call("Browser.close")
    finally:
        process.wait(timeout=20)
