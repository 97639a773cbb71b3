"""One meaning, one colour: what is drawn takes its colours from one table."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from bridge.media.palette import DARK, IN_SCENE, LIGHT, rgb, style_sheet

ROOT = Path(__file__).parents[2]
PALETTE = ROOT / "bridge" / "media" / "palette.py"
HEX = re.compile(r"#(?!(?:000|fff)\b)(?:[0-9a-fA-F]{6}|[0-9a-fA-F]{3})\b(?=[\"'; )}])")
"""A colour as style sheets write it, but for black and white."""
NAMED = re.compile(r"COLOU?R")
PARTS = re.compile(r"\[\s*[\d.]+,\s*[\d.]+,\s*[\d.]+\s*\]")


def _drawn() -> Iterator[Path]:
    for package in ("bridge", "twin", "evaluator", "dashboards"):
        for ending in ("py", "css", "js", "html"):
            yield from (ROOT / package).rglob(f"*.{ending}")


def test_colours_are_written_in_one_file_alone() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()[:80]}"
        for path in _drawn()
        if path != PALETTE
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if HEX.search(line) or (path.suffix == ".js" and "olor" in line and PARTS.search(line))
    ]
    assert found == []


def _is_rgb(node: ast.AST) -> bool:
    parts = node.elts if isinstance(node, ast.Tuple) else []
    return len(parts) == 3 and all(
        isinstance(each, ast.Constant) and isinstance(each.value, int | float) for each in parts
    )


def test_no_module_that_draws_names_a_colour_of_its_own() -> None:
    found = []
    for package in ("evaluator", "dashboards"):
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
                    continue
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                names = " ".join(ast.unparse(each) for each in targets)
                if NAMED.search(names) and any(_is_rgb(each) for each in ast.walk(node.value)):
                    found.append(f"{path.relative_to(ROOT)}:{node.lineno}: {names}")
    assert found == []


def test_dark_pages_have_every_colour_that_light_ones_have() -> None:
    assert list(LIGHT) == list(DARK)
    sheet = style_sheet()
    assert all(sheet.count(f"--{name}: ") == 2 for name in LIGHT)
    assert set(IN_SCENE) <= set(DARK)


def test_recorded_planned_executed_success_and_failure_look_different() -> None:
    told_apart = ("recorded", "planned", "twin-planned", "twin-executed", "good", "bad")
    for table in (LIGHT, DARK):
        assert len({table[name] for name in told_apart}) == len(told_apart)
    assert rgb("recorded") == (0xE7, 0xEA, 0xF0)


def test_style_sheets_use_no_colour_that_is_not_there() -> None:
    defined = set(re.findall(r"--([\w-]+):", style_sheet()))
    for folder in ("dashboards/static", "dashboards/templates"):
        for path in (ROOT / folder).rglob("*.css"):
            own = set(re.findall(r"--([\w-]+):", path.read_text()))
            used = set(re.findall(r"var\(--([\w-]+)", path.read_text()))
            if path.name != "share.css":  # it is part of the report's page
                assert used <= defined | own | {"bar", "hue", "share"}, path.name
