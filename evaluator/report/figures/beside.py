"""Draw the figures of a large run in a second process, while the first compares and writes.

Loading matplotlib and drawing take three seconds that nothing else of an evaluation waits for.
Whatever becomes of the process, the same figures can be drawn without it.
"""

import os
import pickle
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from evaluator.child_process import ChildProcess
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


class Beside(ChildProcess):
    """A second process that draws; it ends with this object, or with the program."""

    def __init__(self) -> None:
        """Start it; it loads matplotlib at once.

        Raises:
            OSError: When the system gives no further process.
        """
        super().__init__(__name__)

    def take(self, drawn: Sequence[Drawing]) -> list[Rendered] | None:
        """Wait for the figures and end the process.

        Args:
            drawn: What the data that was sent is drawn as.

        Returns:
            The figures in this order, or None when the process did not bring them to an end.
        """
        assert self.process.stdout is not None  # noqa: S101  # for the type checker
        limit = threading.Timer(MAX_WAIT_S, self.process.kill)
        limit.start()
        try:
            found: dict[str, Forms] = pickle.load(self.process.stdout)
            return [_rendered(drawing, found[drawing.id]) for drawing in drawn]
        except (EOFError, OSError, pickle.UnpicklingError):
            return None
        finally:
            limit.cancel()
            self.end()


def beside(source: Path | None) -> Beside | None:
    """Start a process for the figures of a large run; None where drawing here is as quick."""
    if source is None or (os.cpu_count() or 1) < 2:
        return None
    try:
        files = sum(len(os.listdir(source / name)) for name in ("episodes", "derived"))  # noqa: PTH208
        return Beside() if files >= MIN_FILES else None
    except OSError:  # no run folder, or no process to be had
        return None


def _rendered(drawing: Drawing, forms: Forms) -> Rendered:
    svg, pdf, inline = forms
    return Rendered(drawing=drawing, svg=svg, pdf=pdf, inline=inline)


def serve(receive: Callable[[], "Drawable"], outbox: BinaryIO) -> None:
    """Load what drawing needs, then draw what arrives.

    Args:
        receive: Brings what the figures show.
        outbox: Takes a pickled dictionary: the forms of each figure by its id.
    """
    from evaluator.report.figures.render import render, warm_up  # noqa: PLC0415  # and matplotlib
    from evaluator.report.figures.selection import drawings_of  # noqa: PLC0415  # loads the numbers

    warm_up()
    found: dict[str, Forms] = {}
    for drawing in drawings_of(receive())[0]:
        item = render(drawing)
        found[drawing.id] = (item.svg, item.pdf, item.inline)
    outbox.write(pickle.dumps(found))
    outbox.flush()
