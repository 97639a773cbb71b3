"""The calls of ``rebuild``: ask the models before semantics is written, give vectors after."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bridge.episode.streams import RgbdFrame
from bridge.task.task_file import Task
from bridge.terminal import Output
from twin.scene.foundation.stage import ModelFindings, ask_models, embed_things, spread
from twin.scene.frames.choice import FrameChoice, load
from twin.scene.gaussians.cloud import GaussianCloud
from twin.scene.semantics.store import read_semantics
from twin.scene.settings import ModelConfig


@dataclass(frozen=True, kw_only=True)
class Consulted:
    """What the models said, and what they will be asked again."""

    config: ModelConfig
    frames: list[RgbdFrame]
    """Training frames that were looked at; empty when no model is named."""
    findings: ModelFindings

    def give_vectors(
        self,
        folder: Path,
        rows: Mapping[str, int],
        cloud: GaussianCloud,
        output: Output,
        *,
        threads: int = 0,
    ) -> dict[str, Any]:
        """Write the CLIP vectors of the things that ``semantics.npz`` holds.

        Args:
            folder: The scene folder, its semantics written.
            rows: Gaussians of the background and of each object, as they were written.
            cloud: All of them, in that order.
            output: Shows how far it is.
            threads: For drawing; 0: all cores.

        Returns:
            What ``scene.json`` says about it, under ``vectors``; nothing without CLIP.
        """
        if not self.config.clip:
            return {}
        scene = read_semantics(folder, rows)
        features = self.findings.features
        with output.progress("give things vectors", len(scene.instances)) as advance:
            about = embed_things(
                folder,
                scene,
                cloud,
                self.frames,
                features,
                self.config,
                threads=threads,
                advance=advance,
            )
        return {"vectors": about}


def consult(
    config: ModelConfig,
    choices: Sequence[FrameChoice],
    cloud: GaussianCloud,
    task: Task | None,
    output: Output,
    *,
    threads: int = 0,
) -> Consulted:
    """Ask segmenter and feature model about training frames; nothing when none is named.

    Args:
        config: Which models.
        choices: The training frames, with the poses the fit ended with.
        cloud: All Gaussians of the scene.
        task: Names what to look for when no prompts are given.
        output: Shows how far it is.
        threads: For lifting; 0: all cores.

    Raises:
        UsageError: When a folder, prompt or device cannot be used.
        MissingDependencyError: When the extra ``foundation`` is not installed.
    """
    num_models = bool(config.segmenter) + bool(config.features)
    if not num_models and not config.clip:
        nothing = ModelFindings(masks=[], features=None)
        return Consulted(config=config, frames=[], findings=nothing)
    frames = training_frames(choices, config.model_frames)
    with output.progress("ask the models", num_models * len(frames)) as advance:
        findings = ask_models(config, frames, cloud, task, threads=threads, advance=advance)
    num_masks = sum(len(masks.masks) for _, masks in findings.masks)
    if config.segmenter:
        output.say(f"{num_masks} masks in {len(frames)} frames")
    return Consulted(config=config, frames=frames, findings=findings)


def training_frames(choices: Sequence[FrameChoice], count: int) -> list[RgbdFrame]:
    """Read at most ``count`` training frames, spread evenly over episodes, cameras and time."""
    numbered = [(index, ns) for index, each in enumerate(choices) for ns in sorted(each.train_ns)]
    chosen = {numbered[place] for place in spread(range(len(numbered)), count)}
    frames: list[RgbdFrame] = []
    for index, each in enumerate(choices):
        frames += load(each, frozenset(ns for owner, ns in chosen if owner == index))
    return frames
