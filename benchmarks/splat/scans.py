"""Scans rebuilt by the whole of ``rebuild``, as the command does it: the stand-in cell, a shelf."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.terminal import Output

ROOT = Path(__file__).resolve().parents[2]
SEED = 20
"""Of the stand-in laboratory; a development seed."""
QUIET = Output(quiet=True)


def standin_scan(folder: Path) -> RunFolder:
    """Record one scan of the stand-in cell, with all that is wrong there."""
    from cell_run import START_NS, FileSession

    from bridge.sources.standin.session import run_session
    from bridge.sources.standin.settings import SessionConfig

    run = RunFolder.create(folder)
    config = SessionConfig(seed=SEED, trials=0)
    run_session(FileSession(run.episodes_dir), config, QUIET, start_ns=START_NS)
    return run


def shelf_folder() -> Path | None:
    """The real wrist camera before a shelf; None without it."""
    data = Path(os.environ.get("GST_SHARED_DATA", ROOT.parent / "shared" / "data"))
    folder = data / "rgbd_apc_shelf_wristcam"
    return folder if (folder / "scene.json").is_file() else None


def shelf_scan(source: Path, folder: Path) -> RunFolder:
    """Import the frames of the wrist camera as one scan."""
    from bridge.cli.exchange import import_rgbd

    import_rgbd(source, folder, output=QUIET)
    return RunFolder.open(folder)


def rebuilt(run: RunFolder, budget_s: float) -> Mapping[str, Any]:
    """Rebuild within a time; the content of scene.json."""
    from twin.scene.rebuild.run import rebuild
    from twin.scene.settings import FitConfig, RebuildConfig

    return rebuild(run, RebuildConfig(fit=FitConfig(budget_s=budget_s)), QUIET)


@dataclass(frozen=True, kw_only=True)
class HeldOut:
    """Means of one way of scoring over the held-out views of moving cameras."""

    psnr_db: float
    ssim: float


def held_out(run: RunFolder, record: Mapping[str, Any]) -> dict[str, HeldOut]:
    """By variant (raw, gain, static), as the evaluator scores them."""
    from evaluator.compare.images.scores import images_of, score_views

    still = {item["id"] for item in record["cameras"] if item["stationary"]}
    found: dict[str, list[tuple[float, float]]] = {}
    for path in run.derived("*.views.*"):
        for view in score_views(images_of(Episode.open(path), None)):
            for way, score in view.scores.items() if view.camera_id not in still else ():
                if {"psnr_db", "ssim"} <= score.values.keys():
                    pair = score.values["psnr_db"], score.values["ssim"]
                    found.setdefault(way, []).append(pair)
    return {
        name: HeldOut(psnr_db=float(np.mean(rows, axis=0)[0]), ssim=float(np.mean(rows, axis=0)[1]))
        for name, rows in found.items()
    }
