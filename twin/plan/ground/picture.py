"""The picture that a model gets: what a camera saw of the start, with its objects and points named.

Points are chosen where the depth image saw the surface, so none is marked that something hides.
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.palette import rgb
from twin.plan.constrain.bodies import surface_points
from twin.plan.constrain.reply import Keypoints, keypoint
from twin.plan.problem import Flags, Points, Pose, Problem
from twin.plan.release.obstacles import spread_points

LONG_SIDE_PX = 1280
MARKS, CANDIDATES = 5, 400
"""Of one object."""
SEEN_M = 0.012
"""A point is seen where the depth image measured its distance to within this."""
_FONT_PX, _MARK_PX, _AWAY_PX = 22, 6, 36
COLOURS = ("twin-planned", "twin-executed", "third", "fourth", "unknown")
_BLACK = (0, 0, 0)


@dataclass(frozen=True, kw_only=True)
class MarkedPicture:
    """A picture with its marks."""

    jpeg: bytes
    keypoints: Keypoints
    """By what stands beside them: ``cube.1``."""


@dataclass(frozen=True, kw_only=True)
class _Seen:
    """What one frame shows of one object."""

    outline_px: Float[np.ndarray, "num_corners 2"]
    points_m: Points
    """In the object's frame."""
    points_px: Float[np.ndarray, "num_marks 2"]


def marked_picture(problem: Problem, frames: Sequence[RgbdFrame]) -> MarkedPicture | None:
    """Mark the frame that shows the most points of the objects; None: none shows any."""
    views = [(frame, _views(problem, frame)) for frame in frames]
    outlines = [[each.outline_px for each in seen.values()] for _, seen in views]
    sizes = [(len(each), sum(np.ptp(px, axis=0).prod() for px in each)) for each in outlines]
    frame, seen = views[sizes.index(max(sizes))]
    if not seen:
        return None
    keypoints = {
        f"{key}.{number}": keypoint(key, p)
        for key, each in seen.items()
        for number, p in enumerate(each.points_m, start=1)
    }
    return MarkedPicture(jpeg=_drawn(frame, seen), keypoints=keypoints)


def _views(problem: Problem, frame: RgbdFrame) -> dict[str, _Seen]:
    found = {}
    for key, T in problem.scene.Ts_base_object.items():
        points = se3.apply(T, surface_points(problem, key, CANDIDATES))
        pixels, is_seen = _pixels(frame.color_camera, frame.T_base_color, points)
        measured = points[is_seen & _measured(frame, points)]
        if not len(measured):  # out of sight
            continue
        marks = spread_points(measured, MARKS)
        found[key] = _Seen(
            outline_px=_hull(pixels),
            points_m=se3.apply(se3.invert(T), marks),
            points_px=_pixels(frame.color_camera, frame.T_base_color, marks)[0],
        )
    return found


def _pixels(
    camera: Camera, T_base_camera: Pose, p_base: Points
) -> tuple[Float[np.ndarray, "num 2"], Flags]:
    """Where points are in an image, and whether they are in it."""
    pixels, z = camera.project(se3.apply(se3.invert(T_base_camera), p_base))
    return pixels, (z > 0) & ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1)


def _measured(frame: RgbdFrame, p_base: Points) -> Flags:
    """Whether the depth image measured something where each point is."""
    pixels, there = _pixels(frame.depth_camera, frame.T_base_depth, p_base)
    column, row = np.where(there, np.nan_to_num(pixels).T, 0).astype(int)
    z = se3.apply(se3.invert(frame.T_base_depth), p_base)[:, 2]
    return np.asarray(there & (np.abs(frame.depth_m[row, column] - z) < SEEN_M))


def _hull(pixels: Float[np.ndarray, "num 2"]) -> Float[np.ndarray, "num_corners 2"]:
    from scipy.spatial import ConvexHull, QhullError  # noqa: PLC0415  # slow to import

    try:
        return np.asarray(pixels[ConvexHull(pixels).vertices])
    except QhullError:  # flat, or fewer than three
        return pixels


def _drawn(frame: RgbdFrame, seen: Mapping[str, _Seen]) -> bytes:
    from PIL import Image as pillow  # noqa: PLC0415  # heavy, only where a model is asked
    from PIL import ImageDraw, ImageFont  # noqa: PLC0415

    picture = pillow.fromarray(frame.image_u8)
    scale = LONG_SIDE_PX / max(picture.size)
    size = (round(picture.width * scale), round(picture.height * scale))
    picture = picture.resize(size, pillow.Resampling.LANCZOS)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(_FONT_PX)
    texts = []
    for number, (key, each) in enumerate(seen.items()):
        colour = rgb(COLOURS[number % len(COLOURS)])
        outline, points = each.outline_px * scale, each.points_px * scale
        middle = outline.mean(axis=0)
        away = points - middle
        ends = points + _AWAY_PX * away / np.maximum(np.linalg.norm(away, axis=1), 1)[:, None]
        texts.append((key, np.array([middle[0], outline[:, 1].min() - 2 * _AWAY_PX]), colour))
        texts += [(f"{n}", end, colour) for n, end in enumerate(ends, start=1)]
        for line, width in ((_BLACK, 4), (colour, 2)):
            draw.line([*map(tuple, outline), tuple(outline[0])], fill=line, width=width)
            for point, end in zip(points, ends, strict=True):
                draw.line((*point, *end), fill=line, width=width)
                draw.circle(tuple(point), _MARK_PX, outline=line, width=width)
    for text, at, colour in texts:  # over all lines
        place = tuple(np.clip(at, (30, 20), (size[0] - 30, size[1] - 20)))
        left, above, right, below = draw.textbbox(place, text, font=font, anchor="mm")
        draw.rectangle((left - 4, above - 4, right + 4, below + 4), fill=_BLACK)
        draw.text(place, text, font=font, anchor="mm", fill=colour)
    buffer = io.BytesIO()
    picture.save(buffer, format="jpeg", quality=90)
    return buffer.getvalue()
