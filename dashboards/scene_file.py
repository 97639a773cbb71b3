"""The file that the page's 3D view reads.

``GS3D``, version and length of the header, each a little-endian uint32; the header, JSON padded
with blanks; then ``splats`` (48 bytes each, see ``SPLAT``), ``poses`` (position and quaternion
wxyz) and ``points`` (position and page time), all float32. Offsets in the header count from its
end.
"""

import json
import struct
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from bridge.episode.run_folder import RunFolder
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from dashboards.episode_page import read_replays, sent_plan_of
from dashboards.library import Stamps, derived_paths
from dashboards.recording import Problems, read_recording
from dashboards.trial_plots import shown_replays
from dashboards.trial_scene import RECORDED, Side, TrialScene, gather_scene
from twin.scene.gaussians import GaussianCloud
from twin.scene.harmonics import NUM_FIRST
from twin.scene.movable_scene import MovableScene

MAGIC, VERSION = b"GS3D", 1
HEAD = 16
"""Bytes before the header."""
MAX_SPLATS = 100_000
"""What software WebGL draws in time; the largest and most opaque are kept."""
OBJECTS = 10.0
"""How much more the Gaussians of objects count."""
TIE = 1e-6
"""Gaussians that close an object are all alike: within so much, which of them stay is drawn."""
STILL_M = 1e-6
"""A track whose poses differ by less is one pose."""
SPLAT = np.dtype(
    [
        ("p_m", "<f4", 3),
        ("rgb", "<f2", 3),
        ("opacity", "<f2"),
        ("scales_m", "<f2", 3),
        ("none", "<u2"),
        ("q_wxyz", "<i2", 4),
        ("harmonics", "i1", 3 * NUM_FIRST),
        ("left", "u1", 3),
    ]
)
"""Rotation in 1/32767, harmonics of degree 1 in 1/127 of the header's ``harmonics``. Higher degrees
are left out: of all colours of degree 1 what stays is the nearest to them over all directions."""
EYE_M, TARGET_M = np.array([1.5, -1.1, 0.9]), np.array([0.4, 0.0, 0.1])
"""Where to look from and to in a trial without cameras, and without a tool."""
UP = np.array([0.0, 0.0, 1.0])
ASIDE_RAD, ABOVE_M = 0.35, 0.12
"""How far the first view stands from that of the recorded camera, around what is looked at."""
_GATHERING = threading.Lock()
"""Robot models keep scratch memory: one answer at a time uses them."""


@dataclass(frozen=True, kw_only=True)
class FirstView:
    """Where the 3D view begins."""

    camera: Camera
    eye_m: Float[np.ndarray, "3"]
    target_m: Float[np.ndarray, "3"]


def first_view(scene: TrialScene) -> FirstView:
    """Look at the tool's way from beside the recorded camera that stands still.

    There the scan saw most; from the side of the recorded picture depth shows.
    """
    tool = next((path.p_m for path in scene.paths if path.name == RECORDED), None)
    target_m = TARGET_M if tool is None else np.asarray((tool.min(axis=0) + tool.max(axis=0)) / 2)
    for item in scene.cameras:
        if np.ptp(item.Ts_base_camera[:, :3, 3], axis=0).max() > STILL_M or not item.known.all():
            continue
        aside = item.Ts_base_camera[0, :3, 3] - target_m
        c, s = np.cos(ASIDE_RAD), np.sin(ASIDE_RAD)
        turned = np.array([c * aside[0] - s * aside[1], s * aside[0] + c * aside[1], aside[2]])
        return FirstView(
            camera=item.camera, eye_m=target_m + turned + ABOVE_M * UP, target_m=target_m
        )
    camera = Camera(width=640, height=400, fx=560.0, fy=560.0, cx=320.0, cy=200.0)
    return FirstView(camera=camera, eye_m=EYE_M, target_m=target_m)


@lru_cache(maxsize=2)
def packed(path: Path, run_path: Path, _stamps: Stamps) -> bytes:
    """The file of a recorded episode's scene; gathered anew where what it is made of changed."""
    run = RunFolder(run_path)
    with _GATHERING:
        recording = read_recording(path)
        replays = read_replays(derived_paths(run, path.stem, "replay"), recording, Problems())
        sent_plan = sent_plan_of(recording)
        shown = shown_replays(replays, sent_plan)
        return pack_scene(gather_scene(run, recording, shown, sent_plan))


@dataclass
class _Blocks:
    """Rows that the header points to."""

    poses: list[Float[np.ndarray, "num_rows 7"]] = field(default_factory=list)
    points: list[Float[np.ndarray, "num_rows 4"]] = field(default_factory=list)
    num_poses: int = 0
    num_points: int = 0

    def track(self, Ts: Float[np.ndarray, "num_samples 4 4"]) -> list[int]:
        """Add poses; returns their first row and how many there are, one for what stands still."""
        if np.ptp(Ts, axis=0).max() < STILL_M:
            Ts = Ts[:1]
        q, p = se3.split(Ts)
        self.poses.append(np.concatenate([p, q], axis=1))
        self.num_poses += len(Ts)
        return [self.num_poses - len(Ts), len(Ts)]

    def line(
        self, p_m: Float[np.ndarray, "num_rows 3"], t_s: Float[np.ndarray, " num_rows"]
    ) -> list[int]:
        """Add points with their times; returns their first row and how many there are."""
        self.points.append(np.concatenate([p_m, t_s[:, None]], axis=1))
        self.num_points += len(p_m)
        return [self.num_points - len(p_m), len(p_m)]


def pack_scene(scene: TrialScene) -> bytes:
    """Write everything that the 3D view of a trial needs into one file."""
    clouds = {} if scene.parts is None else reduced_clouds(scene.parts, scene)
    clouds, by_node = _by_node(clouds, scene.sides)
    table, ranges, factor = _splat_table(clouds)
    for key, followers in by_node.items():
        first = ranges[key][0]
        for node_key, count in followers.items():
            ranges[node_key] = [first, count]
            first += count
    blocks = _Blocks()
    view = first_view(scene)
    header: dict[str, Any] = {
        "end_s": float(scene.times_s[-1]),
        "samples": len(scene.times_s),
        "harmonics": factor,
        "ranges": ranges,
        "parts": _parts(scene, ranges, blocks),
        "spans_s": {side.name: side.span_s for side in scene.sides},
        "boxes": _boxes(scene.sides, scene, blocks),
        "paths": [
            {"name": path.name, "style": path.style, "points": blocks.line(path.p_m, path.t_s)}
            for path in scene.paths
        ],
        "arms": _arms(scene, blocks),
        "cameras": [
            {"id": item.id, "track": blocks.track(_nowhere(item.Ts_base_camera, item.known))}
            | _intrinsics(item.camera)
            for item in scene.cameras
        ],
        "view": {"eye_m": view.eye_m.tolist(), "target_m": view.target_m.tolist()}
        | _intrinsics(view.camera),
        "notes": list(scene.notes),
    }
    body = [table.tobytes()]
    for name, rows in (("poses", blocks.poses), ("points", blocks.points)):
        header[name] = sum(len(block) for block in body)
        body += [np.concatenate(rows).astype("<f4").tobytes()] if rows else []
    text = json.dumps(header, allow_nan=False).encode()
    text += b" " * (-len(text) % 16)
    return MAGIC + struct.pack("<II4x", VERSION, len(text)) + text + b"".join(body)


def reduced_clouds(parts: MovableScene, scene: TrialScene) -> dict[str, GaussianCloud]:
    """Background, objects and links that are drawn, at most ``MAX_SPLATS`` Gaussians together.

    What is largest and most opaque is kept, opacity times area, of objects ten times that: they are
    small, and what is looked at.
    """
    clouds = {"background": parts.background}
    clouds |= {f"object {name}": item.cloud for name, item in parts.objects.items()}
    clouds |= {f"link {name}": parts.links[name] for name in scene.Ts_root_link}
    weights = {name: _weights(cloud) for name, cloud in clouds.items()}
    for name in parts.objects:
        weights[f"object {name}"] *= OBJECTS
    total = sum(len(each) for each in weights.values())
    if total <= MAX_SPLATS:
        return clouds
    least = np.partition(np.concatenate([*weights.values()]), total - MAX_SPLATS)[
        total - MAX_SPLATS
    ]
    return {name: cloud.take(weights[name] >= least) for name, cloud in clouds.items()}


def _by_node(
    clouds: Mapping[str, GaussianCloud], sides: Sequence[Side]
) -> tuple[dict[str, GaussianCloud], dict[str, dict[str, int]]]:
    """Put the Gaussians of soft objects in the order of the nodes that they follow.

    Each follows the node nearest to it, rigidly: between neighbours that is off by the strain over
    half a cell of the lattice, about a millimetre for a toy.

    Returns:
        The clouds, and by cloud how many Gaussians follow which node, in their order.
    """
    ordered, counts = dict(clouds), {}
    for name, bend in {name: bend for side in sides for name, bend in side.bends.items()}.items():
        key = f"object {name}"
        if key not in clouds or not len(clouds[key]):
            continue
        _, nodes = cKDTree(bend.rest_nodes_m).query(clouds[key].means_m)
        ordered[key] = clouds[key].take(np.argsort(nodes, kind="stable"))
        found, sizes = np.unique(nodes, return_counts=True)
        size = len(bend.rest_nodes_m)
        keys = (_node_range(name, size, node) for node in found.tolist())
        counts[key] = dict(zip(keys, sizes.tolist(), strict=True))
    return ordered, counts


def _weights(cloud: GaussianCloud) -> Float[np.ndarray, " num_splats"]:
    """Opacity times the area of the two largest axes; of equal ones some, all over the surface."""
    scales = np.sort(cloud.scales_log.astype(np.float64), axis=1)
    weights = np.asarray(cloud.opacities() * np.exp(scales[:, 1] + scales[:, 2]))
    return weights * (1 + TIE * np.random.default_rng(0).random(len(cloud)))


def _splat_table(
    clouds: Mapping[str, GaussianCloud],
) -> tuple[np.ndarray, dict[str, list[int]], float]:
    """All Gaussians, where those of each part begin and how many they are, and the harmonics'."""
    first = {name: cloud.harmonics[:, :NUM_FIRST] for name, cloud in clouds.items()}
    largest = [np.abs(rows).max() for rows in first.values() if rows.size]
    factor = float(max(largest, default=1.0)) or 1.0
    ranges, rows, begin = {}, [np.zeros(0, dtype=SPLAT)], 0
    for name, cloud in clouds.items():
        table = np.zeros(len(cloud), dtype=SPLAT)
        q = cloud.quats_wxyz / np.linalg.norm(cloud.quats_wxyz, axis=1, keepdims=True)
        table["p_m"] = cloud.means_m
        table["rgb"] = cloud.colors
        table["opacity"] = cloud.opacities()
        table["scales_m"] = np.exp(cloud.scales_log)
        table["q_wxyz"] = np.rint(q * 32767)
        if cloud.num_harmonics:
            flat = first[name].reshape(len(cloud), 3 * NUM_FIRST)
            table["harmonics"] = np.rint(flat / factor * 127)
        rows.append(table)
        ranges[name] = [begin, len(cloud)]
        begin += len(cloud)
    return np.concatenate(rows), ranges, factor


def _parts(
    scene: TrialScene, ranges: Mapping[str, Sequence[int]], blocks: _Blocks
) -> list[dict[str, Any]]:
    """What is drawn of which Gaussians, by side; the background and the robot once."""
    if scene.parts is None:
        return []
    still = np.eye(4)[None]
    found = [{"splats": "background", "side": "", "track": blocks.track(still)}]
    for side in scene.sides:
        for name, Ts in side.Ts_base_object.items():
            bent = _bent_parts(side, name, ranges, blocks)
            found += bent
            if not bent and f"object {name}" in ranges:
                track = blocks.track(Ts)
                found.append({"splats": f"object {name}", "side": side.name, "track": track})
    for name, item in scene.parts.objects.items():
        if name not in scene.sides[0].Ts_base_object:
            track = blocks.track(item.T_base_object[None])
            found.append({"splats": f"object {name}", "side": "", "track": track})
    for name, Ts in scene.Ts_root_link.items():
        found.append({"splats": f"link {name}", "side": "", "track": blocks.track(Ts)})
    return found


def _bent_parts(
    side: Side, name: str, ranges: Mapping[str, Sequence[int]], blocks: _Blocks
) -> list[dict[str, Any]]:
    """One part for each node that carries Gaussians; none of an object that is not bent."""
    bend = side.bends.get(name)
    found = []
    for node in range(0 if bend is None else len(bend.rest_nodes_m)):
        key = _node_range(name, len(bend.rest_nodes_m), node) if bend is not None else ""
        if bend is not None and key in ranges:
            track = blocks.track(bend.Ts_base_node[:, node])
            found.append({"splats": key, "side": side.name, "track": track})
    return found


def _node_range(name: str, num_nodes: int, node: int) -> str:
    """Name the Gaussians of a soft object that follow one of its nodes."""
    return f"object {name}, node {node} of {num_nodes}"


def _boxes(sides: Sequence[Side], scene: TrialScene, blocks: _Blocks) -> list[dict[str, Any]]:
    found = []
    not_scanned = frozenset[str]() if scene.parts is None else scene.parts.not_scanned
    for side in sides:
        for name, Ts in side.Ts_base_object.items():
            if name in scene.boxes_m:
                centre_m, half_m = scene.boxes_m[name]
                found.append(
                    {
                        "name": name,
                        "side": side.name,
                        "centre_m": centre_m,
                        "half_m": half_m,
                        "not_scanned": name in not_scanned,
                        "track": blocks.track(Ts),
                    }
                )
    return found


def _arms(scene: TrialScene, blocks: _Blocks) -> list[dict[str, Any]]:
    found = []
    for side in scene.sides:
        if side.skeleton_m is not None:
            count, points, _ = side.skeleton_m.shape
            times = np.repeat(scene.times_s, points)
            line = blocks.line(side.skeleton_m.reshape(count * points, 3), times)
            found.append({"side": side.name, "points": line, "per_sample": points})
    return found


def _nowhere(
    Ts: Float[np.ndarray, "num_samples 4 4"], known: np.ndarray
) -> Float[np.ndarray, "num_samples 4 4"]:
    """Put a camera that nobody knows of far away: the page does not look through it then."""
    placed = Ts.copy()
    placed[~known] = np.eye(4)
    placed[~known, 2, 3] = NOWHERE_M
    return placed


NOWHERE_M = -1e6


def _intrinsics(camera: Camera) -> dict[str, float]:
    names = ("width", "height", "fx", "fy", "cx", "cy")
    return {name: getattr(camera, name) for name in names}
