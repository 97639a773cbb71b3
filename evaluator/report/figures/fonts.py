"""One cut of the font for the PDF files of all figures.

matplotlib cuts out of the font what each file needs, and fontTools takes longer for that than
everything else in a figure. Here one cut with the usual characters is made and put into every file:
ten kilobytes more in each. This reaches into matplotlib 3.11; where its insides are others, each
file has its own cut as before, and only takes longer.
"""

import inspect
import io
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from functools import cache
from typing import Any

from matplotlib.backends import _backend_pdf_ps
from matplotlib.font_manager import get_font

embedding: Any = _backend_pdf_ps

USUAL = "".join(map(chr, range(0x20, 0x7F))) + "°±²µ·×–—’…−≈≤≥→"
"""In every cut, so that figures share it; what else a figure writes is cut for it alone."""
_WANTED = ("fontfile", "glyphs")


@dataclass(frozen=True, kw_only=True)
class Cut:
    """A part of a font, as it is embedded: what matplotlib wants of it."""

    font: bytes
    glyph_index_map: dict[int, int]
    """From places in the whole font to places in the cut."""


@contextmanager
def shared_cuts() -> Iterator[None]:
    """Let PDF files that are written meanwhile share the cuts of this process."""
    original = getattr(embedding, "get_glyphs_subset", None)
    save = getattr(embedding, "font_as_file", None)
    if not (callable(original) and callable(save) and _is_known(original)):
        yield
        return

    def shared(fontfile: Any, glyphs: Iterable[int]) -> AbstractContextManager[Cut]:
        wanted = _usual_glyphs(fontfile) | frozenset(glyphs)
        if (fontfile, wanted) not in _CUTS:
            with original(fontfile, set(wanted)) as found:
                _CUTS[fontfile, wanted] = Cut(
                    font=save(found.font).getvalue(), glyph_index_map=found.glyph_index_map
                )
        return nullcontext(_CUTS[fontfile, wanted])

    embedding.get_glyphs_subset, embedding.font_as_file = shared, io.BytesIO
    try:
        yield
    finally:
        embedding.get_glyphs_subset, embedding.font_as_file = original, save


_CUTS: dict[tuple[Any, frozenset[int]], Cut] = {}
"""By font file and what is in the cut, so that a file does not depend on what was drawn before."""


def _is_known(function: Callable[..., Any]) -> bool:
    return tuple(inspect.signature(function).parameters) == _WANTED


@cache
def _usual_glyphs(fontfile: Any) -> frozenset[int]:
    font = get_font(fontfile)
    return frozenset(font.get_char_index(ord(letter)) for letter in USUAL) - {0}
