"""Draw the figures of a large run in a second process, while the first compares and writes.

Loading matplotlib and drawing take three seconds that nothing else of an evaluation waits for.
Whatever becomes of the process, the same figures can be drawn without it.
"""

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from bridge.process_pool import Failed, Function, Worker, WorkerLostError
from evaluator.memory import without_collecting
from evaluator.report.figures.drawing import Drawing, Rendered

if TYPE_CHECKING:
    from evaluator.report.figures.selection import Drawable

MIN_FILES = 2000
"""Recorded and derived files from which a second process is worth it.

It needs about two seconds until it can draw; comparing 2000 kept files takes about one, and the
second core is not there for nothing: for smaller runs it would be waited for.
"""
MAX_WAIT_S = 60.0
"""For what takes three seconds; a process that hangs must not hold the report."""
Forms = tuple[bytes, bytes, str]
"""SVG, PDF and the SVG for the page."""


class Beside(Worker):
    """A second process that draws; it ends with this object, or with the program."""

    def __init__(self) -> None:
        """Start it; it loads matplotlib at once.

        Raises:
            OSError: When the system gives no further process.
        """
        super().__init__(quiet=True)
        self._begin(_load, None)

    def send(self, shown: "Drawable") -> None:
        """Hand over what the figures show, and go on."""
        self._begin(_draw, shown)

    def _begin(self, function: Function, item: object) -> None:
        with suppress(WorkerLostError):  # found out when it should answer
            self.begin(function, item)

    def take(self, drawn: Sequence[Drawing]) -> list[Rendered] | None:
        """Wait for the figures and end the process.

        Args:
            drawn: What the data that was sent is drawn as.

        Returns:
            The figures in this order, or None when the process did not bring them to an end.
        """
        try:
            self.finish(MAX_WAIT_S)  # it has loaded what it needs
            found: dict[str, Forms] | Failed = self.finish(MAX_WAIT_S)
        except WorkerLostError:
            return None
        finally:
            self.close()
        return None if isinstance(found, Failed) else [_rendered(one, found) for one in drawn]


def beside(source: Path | None) -> Beside | None:
    """Start a process for the figures of a large run; None where drawing here is as quick."""
    if source is None or (os.cpu_count() or 1) < 2:
        return None
    try:
        files = sum(len(os.listdir(source / name)) for name in ("episodes", "derived"))  # noqa: PTH208
        return Beside() if files >= MIN_FILES else None
    except OSError:  # no run folder, or no process to be had
        return None


def _rendered(drawing: Drawing, found: dict[str, Forms]) -> Rendered:
    svg, pdf, inline = found[drawing.id]
    return Rendered(drawing=drawing, svg=svg, pdf=pdf, inline=inline)


@without_collecting()
def _load(_: None) -> None:
    from evaluator.report.figures import selection  # noqa: F401, PLC0415  # loads the numbers
    from evaluator.report.figures.render import warm_up  # noqa: PLC0415  # and matplotlib

    warm_up()


@without_collecting()
def _draw(shown: "Drawable") -> dict[str, Forms]:
    from evaluator.report.figures.render import render  # noqa: PLC0415
    from evaluator.report.figures.selection import drawings_of  # noqa: PLC0415

    drawn = (render(drawing) for drawing in drawings_of(shown)[0])
    return {item.drawing.id: (item.svg, item.pdf, item.inline) for item in drawn}
