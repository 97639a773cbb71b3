"""Numbered marks on a recorded image, so that a model can say which thing it means."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, UInt8

from bridge.geometry import se3
from bridge.geometry.camera import Camera

_DIGITS = {
    "0": ("###", "#.#", "#.#", "#.#", "###"),
    "1": (".#.", "##.", ".#.", ".#.", "###"),
    "2": ("###", "..#", "###", "#..", "###"),
    "3": ("###", "..#", ".##", "..#", "###"),
    "4": ("#.#", "#.#", "###", "..#", "..#"),
    "5": ("###", "#..", "###", "..#", "###"),
    "6": ("###", "#..", "###", "#.#", "###"),
    "7": ("###", "..#", ".#.", ".#.", ".#."),
    "8": ("###", "#.#", "###", "#.#", "###"),
    "9": ("###", "#.#", "###", "..#", "###"),
}
"""Drawn here, so that no font is needed."""
_DOT_PX = 3
_RIM_PX = 4
_MOST_TRIES = 40


def draw_marks(
    image_u8: UInt8[np.ndarray, "height width 3"],
    camera: Camera,
    T_base_camera: Float[np.ndarray, "4 4"],
    middles_m: Mapping[str, Float[np.ndarray, "3"]],
) -> tuple[UInt8[np.ndarray, "height width 3"], dict[str, int]]:
    """Draw a number over each thing that the image shows, white on black.

    Numbers count from 1 in the order of the things. A thing beside or behind the camera gets none.
    Marks that would cover each other are moved up.

    Returns:
        The image with marks, and the number of each thing that has one.
    """
    marked, numbers = image_u8.copy(), dict[str, int]()
    taken: list[tuple[int, int, int, int]] = []
    T_camera_base = se3.invert(T_base_camera)
    for number, (name, middle) in enumerate(middles_m.items(), start=1):
        p = se3.apply(T_camera_base, middle)
        if not np.isfinite(p).all() or p[2] <= 0:
            continue
        (u, v), _ = camera.project(p)
        if not (0 <= u < image_u8.shape[1] and 0 <= v < image_u8.shape[0]):
            continue
        label = _label(number)
        area = _free_area(int(u), int(v), label.shape, image_u8.shape, taken)
        top, left, bottom, right = area
        marked[top:bottom, left:right] = np.where(label, 255, 0)[..., None]
        taken.append(area)
        numbers[name] = number
    return marked, numbers


def _label(number: int) -> Bool[np.ndarray, "rows columns"]:
    """The digits of a number with a dark rim; True is white."""
    columns = []
    for digit in str(number):
        dots = np.array([[dot == "#" for dot in row] for row in _DIGITS[digit]])
        columns += [dots, np.zeros((len(dots), 1), dtype=bool)]
    drawn = np.kron(np.concatenate(columns[:-1], axis=1), np.ones((_DOT_PX, _DOT_PX), dtype=bool))
    return np.pad(drawn, _RIM_PX)


def _free_area(
    u: int,
    v: int,
    size: tuple[int, ...],
    image: tuple[int, ...],
    taken: list[tuple[int, int, int, int]],
) -> tuple[int, int, int, int]:
    """Rows and columns around a pixel, moved up from marks that are there, within the image."""
    height, width = size[0], size[1]
    left = min(max(u - width // 2, 0), max(image[1] - width, 0))
    top = min(max(v - height // 2, 0), max(image[0] - height, 0))
    for _ in range(_MOST_TRIES):
        area = (top, left, min(top + height, image[0]), min(left + width, image[1]))
        if top == 0 or not any(_overlap(area, other) for other in taken):
            break
        top = max(top - height // 2, 0)
    rows, columns = min(top + height, image[0]), min(left + width, image[1])
    return rows - height, columns - width, rows, columns


def _overlap(a: tuple[int, int, int, int], b: tuple[int, int, int, int]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
