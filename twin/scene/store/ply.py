"""Gaussians as the PLY file that other splat viewers read (SuperSplat, Rerun)."""

from pathlib import Path

import numpy as np

from bridge.errors import PathNotFoundError
from bridge.whole_file import write_whole
from twin.errors import TwinError
from twin.scene.gaussians.cloud import NUM_FIRST, SH_DC, GaussianCloud, as_float32

COLUMNS = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *("f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2"),
    *("rot_0", "rot_1", "rot_2", "rot_3"),
)
REST_COLUMNS = tuple(f"f_rest_{index}" for index in range(3 * NUM_FIRST))
"""Harmonics of degree 1: all of red, then green, then blue. Written only where there are any."""
REST_COUNTS = (9, 24, 45)
MAX_SPLATS = 50_000_000


class UnreadablePlyError(TwinError):
    """The file is not a splat PLY of the kind we write."""

    def __init__(self, *, path: Path, found: str) -> None:
        """Remember the file."""
        self.path = path
        super().__init__(
            f"{path}: {found}. Expected a binary little-endian PLY with float columns "
            f"{', '.join(COLUMNS)}."
        )


def write_ply(path: Path, cloud: GaussianCloud) -> None:
    """Write a cloud; the file appears under its name only when it is complete.

    Scales are natural logarithms, opacities logits, rotations wxyz, colours the constant
    spherical harmonic with those of degree 1 as ``f_rest_0..8`` where the cloud has them.
    Metres, in the frame that ``scene.json`` names.
    """
    quats = cloud.quats_wxyz / np.linalg.norm(cloud.quats_wxyz, axis=1, keepdims=True)
    table = np.concatenate(
        [
            cloud.means_m,
            np.zeros_like(cloud.means_m),
            (cloud.colors - 0.5) / SH_DC,
            np.swapaxes(cloud.harmonics, 1, 2).reshape(len(cloud), 3 * cloud.num_harmonics),
            cloud.opacities_logit[:, None],
            cloud.scales_log,
            quats,
        ],
        axis=1,
    ).astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(cloud)}"]
    header += [f"property float {name}" for name in _columns_of(cloud)]
    write_whole(path, "\n".join([*header, "end_header", ""]).encode() + table.tobytes())


def read_ply(path: Path) -> GaussianCloud:
    """Read a splat PLY. Harmonics above degree 1 and unknown columns are ignored.

    Raises:
        PathNotFoundError: When the file is not there.
        UnreadablePlyError: When it is another kind of file, or cut short.
    """
    if not path.is_file():
        hint = "robot-gst rebuild RUN makes it."
        raise PathNotFoundError(path=path, what="splat file", hint=hint)
    data = path.read_bytes()
    end = data.find(b"end_header\n")
    if not data.startswith(b"ply\n") or end < 0:
        raise UnreadablePlyError(path=path, found="no PLY header")
    names, count = _header(path, data[:end].decode("ascii", "replace").splitlines())
    body = data[end + len(b"end_header\n") :]
    if len(body) != count * len(names) * 4:
        found = f"{len(body)} bytes of data for {count} rows of {len(names)} floats"
        raise UnreadablePlyError(path=path, found=found)
    table = np.frombuffer(body, dtype="<f4").reshape(count, len(names))
    if not np.isfinite(table).all():
        raise UnreadablePlyError(path=path, found="values that are not finite")
    if not table[:, [names.index(f"rot_{i}") for i in range(4)]].any(axis=1).all():
        raise UnreadablePlyError(path=path, found="rotations of length zero")

    def columns(*wanted: str) -> np.ndarray:
        return as_float32(table[:, [names.index(name) for name in wanted]])

    return GaussianCloud(
        means_m=columns("x", "y", "z"),
        quats_wxyz=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        scales_log=columns("scale_0", "scale_1", "scale_2"),
        opacities_logit=columns("opacity")[:, 0].copy(),
        colors=as_float32(columns("f_dc_0", "f_dc_1", "f_dc_2") * np.float32(SH_DC) + 0.5),
        harmonics=_harmonics(names, table),
    )


def _columns_of(cloud: GaussianCloud) -> tuple[str, ...]:
    after_color = COLUMNS.index("f_dc_2") + 1
    rest = REST_COLUMNS[: 3 * cloud.num_harmonics]
    return (*COLUMNS[:after_color], *rest, *COLUMNS[after_color:])


def _harmonics(names: list[str], table: np.ndarray) -> np.ndarray:
    """Degree 1 of files with degree 1, 2 or 3 (9, 24 or 45 columns); none from others."""
    total = sum(name.startswith("f_rest_") for name in names)
    wanted = [
        [f"f_rest_{color * (total // 3) + index}" for color in range(3)]
        for index in range(NUM_FIRST)
    ]
    if total not in REST_COUNTS or any(name not in names for row in wanted for name in row):
        return np.zeros((len(table), 0, 3), dtype=np.float32)
    return as_float32(table[:, [[names.index(name) for name in row] for row in wanted]])


def _header(path: Path, lines: list[str]) -> tuple[list[str], int]:
    if "format binary_little_endian 1.0" not in lines:
        raise UnreadablePlyError(path=path, found="another PLY format")
    counts = [line.split()[2] for line in lines if line.startswith("element vertex ")]
    properties = [line.split() for line in lines if line.startswith("property ")]
    if len(counts) != 1 or not counts[0].isdigit() or int(counts[0]) > MAX_SPLATS:
        raise UnreadablePlyError(path=path, found="no usable 'element vertex' line")
    if any(len(words) != 3 or words[1] != "float" for words in properties):
        raise UnreadablePlyError(path=path, found="a column that is not float")
    names = [words[2] for words in properties]
    missing = [name for name in COLUMNS if name not in names and not name.startswith("n")]
    if missing:
        raise UnreadablePlyError(path=path, found=f"without {', '.join(missing)}")
    return names, int(counts[0])
