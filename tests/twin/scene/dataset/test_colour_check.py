"""Faults of colour against depth are named, each by its own name, in a scene of cards on a wall.

The scene is drawn here pixel by pixel from its own formula, with no rasteriser of the product.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from bridge.episode.reader import RawMessage
from bridge.geometry.camera import Camera
from twin.scene.dataset.colour_check import check_colour
from twin.scene.frames.rgbd import Target, TrainingView

STEP_NS, COUNT, WALL_M, CARD_M = 100_000_000, 24, 2.0, 1.2
CARDS = np.random.default_rng(4).uniform((-1.1, -0.5), (0.9, 0.4), (14, 2))
"""Upper left corners of cards of 0.22 m x 0.16 m [m]."""
GRAIN = gaussian_filter(np.random.default_rng(5).normal(0, 1, (400, 400)), 1.0)


def pose_at(stamp_ns: int) -> np.ndarray:
    """To and fro along x, and a little up and down."""
    t, T = stamp_ns * 1e-9, np.eye(4)
    T[:2, 3] = 0.25 * np.sin(1.9 * t), 0.08 * np.sin(2.7 * t)
    return T


@cache
def drawn(stamp_ns: int, factor: int) -> tuple[np.ndarray, np.ndarray, Camera]:
    """Grey planes, depth and camera, at full size or half of it."""
    camera = Camera(width=240, height=180, fx=200.0, fy=200.0, cx=120.0, cy=90.0).scaled(1 / factor)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy], axis=-1)
    at = pose_at(stamp_ns)[:2, 3]
    wall, card = at + WALL_M * rays, at + CARD_M * rays
    inside = (card[..., None, :] > CARDS) & (card[..., None, :] < np.add(CARDS, (0.22, 0.16)))
    on_card = inside.all(axis=-1).any(axis=-1)
    grain = [GRAIN[tuple((100 * p + 200).astype(int).T)].T for p in (wall, card)]
    grey = np.where(on_card, 190 + 60 * grain[1], 70 + 60 * grain[0]).clip(12, 243)
    depth = np.where(on_card, CARD_M, WALL_M).astype(np.float32)
    return np.repeat(grey[None], 3, axis=0).astype(np.uint8), depth, camera


def view_of(k: int, colour_ns: int, paint: Callable[[np.ndarray, int], np.ndarray]) -> TrainingView:
    sizes = []
    for factor in (2, 1):
        planes = np.ascontiguousarray(paint(drawn(colour_ns, factor)[0], factor))
        _, depth, camera = drawn(k * STEP_NS, factor)
        mask = np.ones(depth.shape, dtype=bool)
        sizes.append(Target(camera=camera, planes_u8=planes, depth_m=depth, static_mask=mask))
    return TrainingView(
        camera_id="cam", stamp_ns=k * STEP_NS, T_base_color=pose_at(k * STEP_NS),
        half=sizes[0], full=sizes[1],
    )  # fmt: skip


def views_of(
    colour_ns: Callable[[int], int] = lambda k: k * STEP_NS,
    paint: Callable[[int], Callable[[np.ndarray, int], np.ndarray]] = lambda k: lambda p, _: p,
) -> list[TrainingView]:
    return [view_of(k, colour_ns(k), paint(k)) for k in range(COUNT)]


def enlarged(planes: np.ndarray, _factor: int) -> np.ndarray:
    inner = [((np.arange(n) - n / 2) / 1.1 + n / 2).astype(int) for n in planes.shape[1:]]
    return planes[:, inner[0][:, None], inner[1]]


def with_a_pose_off() -> list[TrainingView]:
    views = views_of()
    away = np.outer([0.3, 0.1, 0.2, 0.0], [0.0, 0.0, 0.0, 1.0])
    views[9] = replace(views[9], T_base_color=views[9].T_base_color + away)
    return views


def sent_with_every(nth: int) -> list[RawMessage]:
    """Stamps differ in all messages; every so many has its forerunner's image."""
    same = [k - (k % nth == nth - 1) for k in range(COUNT)]
    data = [(1 + k).to_bytes(12, "little") + bytes([one] * 9) for k, one in enumerate(same)]
    return [RawMessage("", "", 0, k * STEP_NS, k, each) for k, each in enumerate(data)]


def test_a_good_scan_has_none() -> None:
    assert check_colour(views_of(), pose_at, sent_with_every(COUNT + 1)) == []


def test_images_sent_again_are_copies_while_the_camera_moves() -> None:
    told = "3 of its images are copies of the one before"
    assert told in check_colour(views_of(), pose_at, sent_with_every(8))
    still = check_colour(views_of(), lambda _: np.eye(4), sent_with_every(8))
    assert not any("copies" in each for each in still)


@pytest.mark.parametrize(
    ("views", "says"),
    [
        (lambda: views_of(lambda k: k * STEP_NS + 120_000_000), "ms later than its depth"),
        (lambda: views_of(lambda k: k * STEP_NS - 120_000_000), "ms earlier than its depth"),
        (
            lambda: views_of(paint=lambda _: lambda p, f: np.roll(p, 12 // f, axis=2)),
            "lies (+12, +0) pixels beside its depth",
        ),
        (lambda: views_of(paint=lambda _: enlarged), "% larger than its depth"),
        (lambda: views_of(paint=lambda _: lambda p, _: p[:, ::-1, ::-1]), "are upside down"),
        (lambda: views_of(paint=lambda _: lambda p, _: p[:, :, ::-1]), "are mirrored"),
        (
            lambda: views_of(paint=lambda _: lambda p, f: gaussian_filter(p, (0, 8 / f, 8 / f))),
            "blurred",
        ),
        (lambda: views_of(paint=lambda k: lambda p, _: p // (1 + (k % 6 == 4))), "exposure jumps"),
        (with_a_pose_off, "the poses of 1 of 24 images fit neither"),
    ],
)
def test_a_fault_is_named(views: Callable[[], list[TrainingView]], says: str) -> None:
    found = check_colour(views(), pose_at)
    assert any(says in each for each in found), found
