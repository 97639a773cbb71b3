"""Image metrics on VGA pairs against torchmetrics on the same cores, and what LPIPS costs.

IMAGES_PAIRS and IMAGES_REPEATS make it smaller. Times are wall-clock: both sides use every core
they find (torch by itself, ours with threads over images). torchmetrics runs in float32, as its
users have it, one pair at a time and in batches of four, whichever is faster; ours is float64.
"""

import os
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from measure import Target, report_targets

NUM_PAIRS = int(os.environ.get("IMAGES_PAIRS", "100"))
REPEATS = int(os.environ.get("IMAGES_REPEATS", "5"))
HEIGHT, WIDTH = 480, 640
BATCH = 4


def main() -> None:
    """SSIM as the target says, then every metric, then the measured effect of protocol."""
    pairs = draw_pairs(NUM_PAIRS)
    targets, details = ssim_row(pairs)
    note = f"{NUM_PAIRS} pairs of {WIDTH} x {HEIGHT}, median of {REPEATS}"
    details["protocol"] = effects()
    report_targets("evaluate_images", targets, note=note, **details)
    print(f"  {details['ms a pair']}")
    for name, values in details["protocol"].items():
        print(f"  {name:<44} {'  '.join(f'{k} {v:.4f}' for k, v in values.items())}")


def draw_pairs(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Blocks with noise, 8 bits: what an evaluation starts from."""
    rng = np.random.default_rng(0)
    pairs = []
    for _ in range(count):
        blocks = np.kron(rng.integers(0, 255, (HEIGHT // 8, WIDTH // 8, 3)), np.ones((8, 8, 1)))
        noisy = np.clip(blocks + rng.normal(scale=12, size=blocks.shape), 0, 255)
        pairs.append((blocks.astype(np.uint8), noisy.astype(np.uint8)))
    return pairs


def wall_seconds(work: Callable[[], object]) -> float:
    work()
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def ssim_row(pairs: list[tuple[np.ndarray, np.ndarray]]) -> tuple[list[Target], dict[str, Any]]:
    import torch
    from torchmetrics.functional.image import structural_similarity_index_measure as their_ssim

    from bridge.media.image_quality import as_float, ssim_maps
    from evaluator.compare.images.scores import spread
    from evaluator.metrics.image_scores import score_image

    def theirs(batch: int) -> list[float]:
        found = []
        for start in range(0, len(pairs), batch):
            both = [
                torch.from_numpy(np.stack([p[side] for p in pairs[start : start + batch]]))
                .permute(0, 3, 1, 2)
                .float()
                / 255
                for side in (0, 1)
            ]
            found += their_ssim(both[1], both[0], data_range=1.0, reduction="none").tolist()
        return found

    def ours() -> list[float]:
        return spread(
            lambda pair: ssim_maps(as_float(pair[0]), as_float(pair[1])).mean("reflect"), pairs
        )

    difference = float(np.abs(np.array(theirs(1)) - np.array(ours())).max())
    alone, batched = wall_seconds(lambda: theirs(1)), wall_seconds(lambda: theirs(BATCH))
    our_s = wall_seconds(ours)
    every_s = wall_seconds(lambda: spread(lambda p: score_image(*p), pairs))
    per_pair = 1e3 / len(pairs)
    targets = [
        Target(
            what="largest difference to float32 torchmetrics",
            measured=difference,
            limit=1e-4,
        ),
    ]
    details = {
        "ms a pair": {
            "torchmetrics, one pair": alone * per_pair,
            f"torchmetrics, batches of {BATCH}": batched * per_pair,
            "ours, three paddings": our_s * per_pair,
            "ours, every metric without weights": every_s * per_pair,
        },
        "torch threads": torch.get_num_threads(),
    }
    return targets, details


def effects() -> dict[str, dict[str, float]]:
    """What padding, mask and brightness do to one and the same distortion of a real frame."""
    from record.frames import native_frames
    from scipy.ndimage import gaussian_filter

    from evaluator.compare.images.scores import score_variants

    image = native_frames(1)[0][0] / 255.0
    rng = np.random.default_rng(0)
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[160:320, 220:420] = True
    distorted = {
        "noise 0.05": np.clip(image + rng.normal(scale=0.05, size=image.shape), 0, 1),
        "blur, sigma 1.5": gaussian_filter(image, (1.5, 1.5, 0)),
        "one pixel to the right": np.roll(image, 1, axis=1),
        "gain 0.9": 0.9 * image,
    }
    found = {}
    for name, render in distorted.items():
        for variant, score in score_variants(image, render, {"middle": mask}).items():
            found[f"{name}, {variant.name}"] = dict(score.values)
    return found


if __name__ == "__main__":
    main()
