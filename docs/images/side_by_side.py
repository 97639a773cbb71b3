"""Write held-out views of a rebuilt run beside their renderings, small enough for the documents.

Example: .venv/bin/python docs/images/side_by_side.py runs/cell docs/images/standin.jpg
Takes views spread over the ranking by PSNR: neither the best nor the worst alone.
"""

import argparse
import io
from pathlib import Path

import numpy as np
from PIL import Image

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.media.color import decode_color
from evaluator.compare.images.scores import RECORDED, RENDERED, images_of, score_views

MAX_BYTES = 150_000
GAP_PX = 4
ROW_WIDTH_PX = 960


def rows(run: RunFolder, count: int) -> list[np.ndarray]:
    """Recorded beside rendered, for views spread over the ranking by PSNR, their middle first."""
    found = []
    for path in run.derived("*.views.*"):
        images = images_of(Episode.open(path), None)
        scores = score_views(images)
        for score in scores:
            key = (score.camera_id, score.stamp_ns)
            pair = [decode_color(images.color[name][key]) for name in (RECORDED, RENDERED)]
            gap = np.full((pair[0].shape[0], GAP_PX, 3), 255, dtype=np.uint8)
            found.append((score.value("psnr_db") or 0.0, np.hstack([pair[0], gap, pair[1]])))
    found.sort(key=lambda item: item[0])
    places = np.linspace(0, len(found) - 1, 2 * count + 1)[1::2].round().astype(int)
    for place in places:
        print(f"{found[place][0]:.2f} dB")
    return [found[place][1] for place in places]


def write_rows(pictures: list[np.ndarray], out: Path) -> None:
    """Write pictures of one width below each other as a JPEG that is small enough."""
    stack: list[np.ndarray] = []
    for row in pictures:
        stack += [row, np.full((GAP_PX, row.shape[1], 3), 255, dtype=np.uint8)]
    image = Image.fromarray(np.vstack(stack[:-1]))
    width = min(image.width, ROW_WIDTH_PX)
    size = (width, round(image.height * width / image.width))
    image = image.resize(size, Image.Resampling.LANCZOS)
    for quality in range(90, 30, -5):
        buffer = io.BytesIO()
        image.save(buffer, format="jpeg", quality=quality)
        if len(buffer.getvalue()) < MAX_BYTES:
            break
    out.write_bytes(buffer.getvalue())
    print(f"{out}: {len(buffer.getvalue())} bytes, quality {quality}")


def main() -> None:
    """Read the run, write one JPEG."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="rebuilt run folder")
    parser.add_argument("out", type=Path, help="JPEG to write")
    parser.add_argument("--rows", type=int, default=2, help="how many views")
    given = parser.parse_args()
    write_rows(rows(RunFolder.open(given.run), given.rows), given.out)


if __name__ == "__main__":
    main()
