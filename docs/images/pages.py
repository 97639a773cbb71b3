"""Photograph every page of a run: at 1440 and 390 px, light and dark, side by side.

export PYTHONPATH=tests:tests/dashboards
.venv/bin/python docs/images/pages.py docs/images/pages_demo.webp runs/demo
"""

import argparse
import io
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from headless import Browser, chromium
from PIL import Image
from serving import dashboard

from bridge.episode.run_folder import RunFolder

LOOKS = ((1440, False), (1440, True), (390, False), (390, True))
WIDTHS_PX = {1440: 288, 390: 130}
MOST_PX = 300
"""Of a page's height in the picture."""
GAP_PX = 6
RESTS_S = 3.0
"""What loads itself, pictures and 3D, has this long."""


def pages_of(run: RunFolder) -> list[str]:
    """Addresses of all pages."""
    episode = next((path.stem for path in run.episodes() if "trial" in path.stem), None)
    episode = episode or next((path.stem for path in run.episodes()), None)
    of_episode = [] if episode is None else [f"episode/{episode}"]
    return ["", *of_episode, "failures", "twin", "numbers", "label", "live"]


def photograph(tab: Browser, url: str, width: int, dark: bool) -> Image.Image:
    """A page as somebody sees it, small."""
    tab.show(url, width=width, dark=dark)
    time.sleep(RESTS_S)
    page = Image.open(io.BytesIO(tab.picture())).convert("RGB")
    scale = WIDTHS_PX[width] / page.width
    small = page.resize((WIDTHS_PX[width], max(1, round(page.height * scale))))
    return small.crop((0, 0, small.width, min(small.height, MOST_PX)))


def main() -> None:
    """Write one picture, a row for each page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("run", type=Path)
    options = parser.parse_args()
    run = RunFolder.open(options.run)
    rows = []
    with (
        TemporaryDirectory() as home,
        dashboard(run) as (_, url),
        chromium(Path(home), webgl=True) as tab,
    ):
        for page in pages_of(run):
            rows.append([photograph(tab, f"{url}{page}", *look) for look in LOOKS])
            print(page or "first page", tab.complaints)
    heights = [max(each.height for each in row) + GAP_PX for row in rows]
    sheet = Image.new("RGB", (sum(WIDTHS_PX[w] + GAP_PX for w, _ in LOOKS), sum(heights)), "gray")
    top = 0
    for row, height in zip(rows, heights, strict=True):
        left = 0
        for each in row:
            sheet.paste(each, (left, top))
            left += each.width + GAP_PX
        top += height
    sheet.save(options.out, quality=60)


if __name__ == "__main__":
    main()
