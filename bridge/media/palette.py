"""One meaning, one colour: in the report, on the pages, in the 3D view and in Rerun.

After Okabe and Ito (2008): told apart by the colour-blind and in print. A test keeps colours out of
every other file.
"""

from collections.abc import Mapping

Rgb = tuple[int, int, int]

LIGHT: Mapping[str, str] = {
    "recorded": "#171a21",
    "planned": "#8a93a3",
    "twin-planned": "#1d64d8",
    "twin-executed": "#d9730d",
    "good": "#00664a",
    "bad": "#a33a00",
    "unknown": "#6b5b1e",
    "level": "#b3261e",
    "third": "#007a5a",
    "fourth": "#8e4585",
    "banner": "#fff6d6",
    "banner-edge": "#e2c25a",
    "good-tint": "#dff3ec",
    "bad-tint": "#fdeade",
    "unknown-tint": "#f6f1dc",
    "plain-tint": "#eceff4",
    "stage-0": "#cfe0fb",
    "stage-1": "#dcefdc",
    "stage-2": "#fbe6cc",
    "stage-3": "#e7dcf7",
    "stage-ink": "#20242c",
    "ink": "#171a21",
    "quiet": "#5c6473",
    "paper": "#ffffff",
    "ground": "#f5f6f8",
    "edge": "#dfe3ea",
    "grid": "#e9ecf1",
    "field": "#878f9e",
    "hover": "#f0f3f8",
    "link": "#1d4ed8",
}
"""On paper and on light pages. ``planned`` is what a plan commands, ``twin-planned`` and
``twin-executed`` are its replays; ``good`` is success, an accepted plan, agreement; ``bad`` is
failure and refusal; ``level`` a limit; ``banner`` says stand-in; ``third`` and ``fourth`` are
series without a meaning of their own."""
DARK: Mapping[str, str] = {
    "recorded": "#e7eaf0",
    "planned": "#7b8698",
    "twin-planned": "#6ba4ff",
    "twin-executed": "#f6a04d",
    "good": "#63d4b0",
    "bad": "#ffa077",
    "unknown": "#e0c872",
    "level": "#ff8f86",
    "third": "#45cfa0",
    "fourth": "#dd9fd4",
    "banner": "#2e2815",
    "banner-edge": "#7a682b",
    "good-tint": "#12342a",
    "bad-tint": "#40230f",
    "unknown-tint": "#35301a",
    "plain-tint": "#262c37",
    "stage-0": "#25406e",
    "stage-1": "#244a31",
    "stage-2": "#5b3f1c",
    "stage-3": "#423064",
    "stage-ink": "#e7eaf0",
    "ink": "#e7eaf0",
    "quiet": "#9aa4b5",
    "paper": "#181c24",
    "ground": "#101319",
    "edge": "#2b313d",
    "grid": "#262c36",
    "field": "#6d7688",
    "hover": "#202631",
    "link": "#8ab4ff",
}
"""The same on dark pages; of lines, also over pictures and in 3D."""
OBJECTS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7")
"""Of objects drawn from above, in the task's order."""
IN_SCENE = ("recorded", "planned", "twin-planned", "twin-executed", "unknown")
"""In a 3D view, on any ground: as on dark pages. ``unknown`` outlines what was not scanned."""


def rgb(name: str) -> Rgb:
    """The colour of a meaning in a 3D view: red, green, blue, each 0 to 255."""
    red, green, blue = bytes.fromhex(DARK[name][1:])
    return red, green, blue


def style_sheet() -> str:
    """Every colour as a custom property of CSS: light, and dark where the reader prefers it."""
    fixed = {f"in-scene-{name}": DARK[name] for name in IN_SCENE}
    fixed |= {f"object-{index}": value for index, value in enumerate(OBJECTS)}
    dark = _properties(DARK)
    light = _properties({**LIGHT, **fixed})
    return f"{light}\n@media (prefers-color-scheme: dark) {{ {dark} }}\n"


def _properties(colours: Mapping[str, str]) -> str:
    said = " ".join(f"--{name}: {value};" for name, value in colours.items())
    return f":root {{ {said} }}"
