"""What an invented run holds beside its trials: held-out views, and imported runs without plans."""

from dataclasses import replace

import numpy as np
from evaluation_log import NUM_STEPS, START_NS, Log, wobble
from jaxtyping import Float

from bridge.episode.metadata import Derived, EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter


def write_views(run: RunFolder, rng: np.random.Generator) -> None:
    """Two cameras, three instants each, one of them badly rendered."""
    derived = Derived(
        kind="views",
        source_episode="scan_01",
        source_sha256="",
        settings={"holdout": "every 8th frame", "num_splats": 1234},
    )
    with EpisodeWriter(run.derived_dir / "scan_01.views.scene.mcap") as writer:
        writer.describe(
            EpisodeInfo(id="scan_01-views", kind="scan", stand_in=True), derived=derived
        )
        log = Log(writer)
        for index, camera in enumerate(("wrist", "front")):
            for place in range(3):
                picture, mask, depth_m = _scenery(rng, index + 0.4 * place)
                wrong = 0.015 + 0.05 * (index == 1 and place == 2)
                rendered = np.roll(picture, 1, axis=1) * (0.97 - 2 * wrong)
                rendered = np.clip(rendered + rng.normal(0, 255 * wrong, picture.shape), 0, 255)
                stamp_ns = START_NS + place * 1_000_000_000
                log.picture(camera, "recorded/image", picture, stamp_ns)
                log.picture(camera, "rendered/image", rendered.astype(np.uint8), stamp_ns)
                log.picture(camera, "mask/objects", mask, stamp_ns)
                log.depth(camera, "recorded/depth", depth_m, stamp_ns)
                log.depth(camera, "rendered/depth", depth_m + 0.004, stamp_ns)


def _scenery(
    rng: np.random.Generator, turn: float
) -> tuple[np.ndarray, np.ndarray, Float[np.ndarray, "height width"]]:
    """A table with two blocks under soft light, large enough for MS-SSIM."""
    height, width = 176, 192
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    picture = np.stack([150 + 0.3 * y, 140 + 0.25 * y, 128 + 0.2 * x], axis=2)
    depth_m = 1.4 - 0.004 * y
    mask = np.zeros((height, width), dtype=bool)
    for at, size, colour in (
        (60 + 20 * turn, 38, (190, 60, 48)),
        (122 - 12 * turn, 26, (52, 104, 170)),
    ):
        block = (abs(x - at) < size / 2) & (abs(y - 100) < size / 2)
        light = 0.75 + 0.25 * (x[block] - at) / size
        picture[block] = np.array(colour) * light[:, None]
        depth_m[block] -= 0.05
        mask |= block
    picture = np.clip(picture + rng.normal(0, 2.0, picture.shape), 0, 255).astype(np.uint8)
    white = np.repeat(mask[..., None], 3, axis=2).astype(np.uint8) * 255
    return picture, white, depth_m


def write_imported(run: RunFolder, rng: np.random.Generator) -> None:
    """Runs without plans and without a common clock, recorded and simulated."""
    share = np.linspace(0, 1, NUM_STEPS)[:, None]
    for number in range(1, 4):
        for engine, offset in ((None, 0.0), ("pybullet", 0.012)):
            name = f"reach_{engine or 'real'}_{number:02d}"
            folder = run.episodes_dir if engine is None else run.derived_dir
            derived = None
            if engine is not None:
                derived = Derived(kind="replay", source_episode="", source_sha256="", engine=engine)
            with EpisodeWriter(folder / f"{name}.mcap") as writer:
                info = EpisodeInfo(id=name, kind="imported", task="reach", cell="elsewhere")
                writer.describe(replace(info, stand_in=True), derived=derived)
                ends = np.array([0.2, 0.1, 0.3]), np.array([0.5, -0.2 + offset, 0.2])
                path = ends[0] + share * (ends[1] - ends[0])
                Log(writer).tool(path + wobble(rng, 0.003 + offset / 3))
