"""The text files of the TUM layout: lists of stamped files, pairs of them, stamped poses."""

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from bridge.clock import NS_PER_S
from bridge.geometry.trajectory import PoseTrajectory
from bridge.sources.errors import FolderError

PAIRING_TOLERANCE_NS = 20_000_000
"""Colour and depth of one frame lie at most this far apart (the benchmark's own choice)."""
MAX_STAMP_S = 2**31
"""ROS stamps count seconds in 32 bits; a larger number is milli- or nanoseconds."""
QUATERNION_TOLERANCE = 0.05
"""Four digits are off by 1e-4; a norm farther from one is not a rotation."""


@dataclass(frozen=True, kw_only=True)
class StampedFile:
    """One line of a list."""

    stamp_ns: int
    name: str
    line: int


def read_files(path: Path) -> list[StampedFile]:
    """Read "stamp file" lines in time order.

    Raises:
        FolderError: Naming the first line that is none.
    """
    files = [
        StampedFile(stamp_ns=_stamp_ns(path, line, cells[0]), name=cells[1], line=line)
        for line, cells in _rows(path, (2,))
    ]
    if not files:
        raise FolderError(path=path, found="no images listed", hint="Write: stamp file.")
    return sorted(files, key=lambda item: item.stamp_ns)


def read_associations(path: Path) -> list[tuple[StampedFile, StampedFile]]:
    """Read "stamp file stamp file" lines; the column whose folder is called depth is depth.

    Raises:
        FolderError: Naming the first line that is none.
    """
    pairs = []
    for line, cells in _rows(path, (4,)):
        first, second = (
            StampedFile(stamp_ns=_stamp_ns(path, line, cells[at]), name=cells[at + 1], line=line)
            for at in (0, 2)
        )
        depth_first = "depth" in first.name and "depth" not in second.name
        pairs.append((second, first) if depth_first else (first, second))
    if not pairs:
        raise FolderError(
            path=path, found="no pairs listed", hint="Write: stamp colour stamp depth."
        )
    return sorted(pairs, key=lambda pair: pair[0].stamp_ns)


def associate(
    colors: Sequence[StampedFile], depths: Sequence[StampedFile]
) -> list[tuple[StampedFile, StampedFile]]:
    """Pair each colour with a depth image of its own, the closest pairs first, within 20 ms."""
    stamps = [depth.stamp_ns for depth in depths]
    candidates = []
    for number, color in enumerate(colors):
        first = bisect_left(stamps, color.stamp_ns - PAIRING_TOLERANCE_NS)
        for other in range(first, len(stamps)):
            gap_ns = abs(stamps[other] - color.stamp_ns)
            if stamps[other] > color.stamp_ns + PAIRING_TOLERANCE_NS:
                break
            candidates.append((gap_ns, number, other))
    partner: dict[int, int] = {}
    taken: set[int] = set()
    for _, number, other in sorted(candidates):
        if number not in partner and other not in taken:
            partner[number] = other
            taken.add(other)
    return [(colors[number], depths[partner[number]]) for number in sorted(partner)]


def read_poses(path: Path) -> PoseTrajectory:
    """Read "stamp tx ty tz qx qy qz qw" lines; rows with nan are left out, as are repeated stamps.

    Raises:
        FolderError: Naming the first line that is no pose.
    """
    poses: dict[int, tuple[list[float], list[float]]] = {}
    for line, cells in _rows(path, (8,)):
        stamp_ns = _stamp_ns(path, line, cells[0])
        try:
            numbers = [float(cell) for cell in cells[1:]]
        except ValueError as error:
            raise FolderError(
                path=path, found=f"line {line}: {error}", hint="Write: stamp tx ty tz qx qy qz qw."
            ) from error
        if not np.isfinite(numbers).all():
            continue
        x, y, z, w = numbers[3:]
        norm = float(np.linalg.norm(numbers[3:]))
        if abs(norm - 1) > QUATERNION_TOLERANCE:
            raise FolderError(
                path=path,
                found=f"line {line}: quaternion of length {norm:.3g}",
                hint="Its length is one; the order is qx qy qz qw.",
            )
        poses.setdefault(stamp_ns, (numbers[:3], [w / norm, x / norm, y / norm, z / norm]))
    if not poses:
        raise FolderError(path=path, found="no poses", hint="Write: stamp tx ty tz qx qy qz qw.")
    stamps = sorted(poses)
    return PoseTrajectory(
        np.array(stamps, dtype=np.int64),
        np.array([poses[stamp][0] for stamp in stamps]),
        np.array([poses[stamp][1] for stamp in stamps]),
    )


def _rows(path: Path, counts: tuple[int, ...]) -> Iterator[tuple[int, list[str]]]:
    """Yield numbered lines of cells, blank lines and comments left out."""
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise FolderError(
            path=path, found=f"not readable as text ({error})", hint="Restore the file."
        ) from error
    for line, row in enumerate(text.splitlines(), start=1):
        cells = row.replace(",", " ").split()
        if not cells or cells[0].startswith("#"):
            continue
        if len(cells) not in counts:
            wanted = " or ".join(str(count) for count in counts)
            raise FolderError(
                path=path,
                found=f"line {line} has {len(cells)} fields, expected {wanted}",
                hint="Correct the line or remove it.",
            )
        yield line, cells


def _stamp_ns(path: Path, line: int, text: str) -> int:
    """Turn seconds in decimal notation into nanoseconds without rounding through a float."""
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        seconds = Decimal("NaN")
    if not seconds.is_finite() or not 0 <= seconds < MAX_STAMP_S:
        raise FolderError(
            path=path,
            found=f"line {line}: {text!r} is no time in seconds",
            hint="Stamps are seconds with decimals, for example 1305031098.665900000.",
        )
    return int((seconds * NS_PER_S).to_integral_value())
