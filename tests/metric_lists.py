"""Write the lists of ``docs/metrics.md`` from the registry: ``python tests/metric_lists.py``."""

import math
import re
from collections.abc import Iterable
from pathlib import Path

from evaluator.measurements import REGISTRY
from evaluator.quantity import RANGES, Quantity

PAGE = Path(__file__).parents[1] / "docs" / "metrics.md"


def range_text(quantity: Quantity) -> str:
    """Write the range as a reader does."""
    low, high = quantity.low, quantity.high
    if quantity.unit == "rad" and high == math.pi:
        return f"{low:g} to pi"
    if math.isinf(low):
        return "any"
    return f"{low:g} and up" if math.isinf(high) else f"{low:g} to {high:g}"


def registry_table(families: Iterable[str]) -> str:
    """Write the quantities of some families, the first words of their ids, as a list in markdown.

    Of a definition its first clause; a range where it is not that of the unit.
    """
    wanted = set(families)
    rows: dict[tuple[str, str], list[str]] = {}
    for each in REGISTRY:
        if each.id.partition(".")[0] in wanted:
            words = re.sub(r",? ?(in )?\{(protocol|where|without|what)\}", "", each.definition)
            words = re.sub(r"[:;,]? ?\{(words|about|after)\}$", "", words)
            words = _capitals(words).partition("; ")[0].replace("|", "/").strip(" :,;")
            usual = (each.low, each.high) == RANGES[each.unit]
            parts = ("" if each.unit == "1" else each.unit, "" if usual else range_text(each))
            allowed = ", ".join(filter(None, parts))
            rows.setdefault((words, allowed), []).append(_capitals(each.id))
    lines = []
    for (words, allowed), names in rows.items():
        shown = ", ".join(f"`{name}`" for name in names)
        lines.append(f"- {shown}: {words}{f' [{allowed}]' if allowed else ''}")
    return "\n".join(lines)


def _capitals(text: str) -> str:
    return re.sub(r"\{(\w+)(?::\w+)?\}", lambda part: part[1].upper(), text)


_BLOCK = re.compile(r"(<!-- registry: ([\w ]+) -->\n).*?(<!-- /registry -->)", re.DOTALL)


def with_tables(page: str) -> str:
    """Return a page whose blocks ``<!-- registry: FAMILIES -->`` hold what is registered now."""
    return _BLOCK.sub(lambda m: f"{m[1]}{registry_table(m[2].split())}\n{m[3]}", page)


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text()))
