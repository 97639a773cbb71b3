"""A cloud of Gaussians: what is stored, fitted, drawn and moved, and its PLY file.

The file is the one that other splat viewers read (SuperSplat, Rerun).
"""

import re
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32

from bridge.errors import PathNotFoundError
from bridge.geometry import se3
from bridge.whole_file import write_whole
from twin.errors import TwinError, UnreadableFileError
from twin.scene.harmonics import NUM_FIRST, turned_harmonics

SH_DC = 0.28209479177387814
"""Value of the constant spherical harmonic, 1 / (2 sqrt(pi)); PLY files store (c - 0.5) / SH_DC."""


@dataclass(frozen=True, kw_only=True)
class GaussianCloud:
    """Anisotropic Gaussians with one colour each, in the run's root frame.

    The paper's Eq. 1 as resolved by the errata: covariance = R S S^T R^T with S = exp(scales_log)
    and R from the quaternion. Arrays are contiguous float32.
    """

    means_m: Float32[np.ndarray, "num_splats 3"]
    quats_wxyz: Float32[np.ndarray, "num_splats 4"]
    """Orientation; any length but zero, normalised where it is used."""
    scales_log: Float32[np.ndarray, "num_splats 3"]
    """Natural logarithm of the standard deviations in metres."""
    opacities_logit: Float32[np.ndarray, " num_splats"]
    colors: Float32[np.ndarray, "num_splats 3"]
    """sRGB, nominally 0..1; may leave that range, the drawn image is clipped."""
    harmonics: Float32[np.ndarray, "num_splats num_harmonics 3"] = field(
        default_factory=lambda: np.zeros((0, 0, 3), dtype=np.float32)
    )
    """How colour changes with the direction it is seen along: coefficients of the three real
    spherical harmonics of degree 1 (``harmonics.py``) for each colour, or none."""
    completed: Bool[np.ndarray, " num_splats"] = field(
        default_factory=lambda: np.zeros(0, dtype=bool)
    )
    """Those that stand for what nobody measured: undersides, hidden sides. They are drawn like all
    others."""

    def __post_init__(self) -> None:
        """A cloud made without harmonics has rows of none, and one without marks was measured."""
        if self.harmonics.shape[1] not in (0, NUM_FIRST):
            found = f"{self.harmonics.shape[1]} harmonics per colour"
            message = f"a cloud with {found}: give none, or the {NUM_FIRST} of degree 1."
            raise TwinError(message)
        if len(self.harmonics) == 0 and len(self.means_m) > 0:
            none = np.zeros((len(self.means_m), 0, 3), dtype=np.float32)
            object.__setattr__(self, "harmonics", none)
        if len(self.completed) == 0 and len(self.means_m) > 0:
            object.__setattr__(self, "completed", np.zeros(len(self.means_m), dtype=bool))

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.means_m)

    @property
    def num_harmonics(self) -> int:
        """Coefficients of each colour beside the constant: 0 or 3."""
        return int(self.harmonics.shape[1])

    def take(self, index: np.ndarray) -> "GaussianCloud":
        """Select and order Gaussians by a mask or a list of ids."""
        chosen = {name: as_float32(rows[index]) for name, rows in arrays(self)}
        return GaussianCloud(**chosen, completed=self.completed[index])

    def as_completed(self) -> "GaussianCloud":
        """The same Gaussians, all marked as standing for what nobody measured."""
        return replace(self, completed=np.ones(len(self), dtype=bool))

    def opacities(self) -> Float32[np.ndarray, " num_splats"]:
        """Opacity of each Gaussian at its centre, 0..1."""
        return as_float32(1.0 / (1.0 + np.exp(-self.opacities_logit)))


def arrays(cloud: GaussianCloud) -> list[tuple[str, np.ndarray]]:
    """Return what is drawn of a cloud, arrays with their names, in the order of the fields.

    ``harmonics`` is left out where there are none, and ``completed`` changes no image.
    """
    named = [(item.name, getattr(cloud, item.name)) for item in fields(cloud)[:-1]]
    return named if cloud.num_harmonics else named[:-1]


def as_float32(values: np.ndarray) -> np.ndarray:
    """Return contiguous float32, copying only where needed."""
    return np.ascontiguousarray(values, dtype=np.float32)


def concatenate(clouds: list[GaussianCloud]) -> GaussianCloud:
    """Put clouds one after another; those without harmonics get zeros where others have some."""
    most = max(cloud.num_harmonics for cloud in clouds)
    padded = [with_harmonics(cloud, most) for cloud in clouds]
    names = [item.name for item in fields(GaussianCloud)[:-1]]
    return GaussianCloud(
        **{name: as_float32(np.concatenate([getattr(c, name) for c in padded])) for name in names},
        completed=np.concatenate([c.completed for c in padded]),
    )


def with_harmonics(cloud: GaussianCloud, num_harmonics: int = NUM_FIRST) -> GaussianCloud:
    """The same Gaussians with this many harmonics: zeros added, or all left out."""
    if num_harmonics == cloud.num_harmonics:
        return cloud
    harmonics = np.zeros((len(cloud), num_harmonics, 3), dtype=np.float32)
    return replace(cloud, harmonics=harmonics)


def morton_order(
    means_m: Float32[np.ndarray, "num_splats 3"],
) -> np.ndarray:
    """Order that keeps neighbours in space near each other in memory (Morton 1966), ids.

    Drawing walks Gaussians by depth and tile; neighbours in memory are then neighbours in cache.
    """
    low = means_m.min(axis=0)
    extent = float((means_m.max(axis=0) - low).max())
    cells = ((means_m - low) / max(extent, 1e-9) * 1023.0).astype(np.uint64)
    code = np.zeros(len(means_m), dtype=np.uint64)
    for shift, mask in ((16, 0x30000FF), (8, 0x300F00F), (4, 0x30C30C3), (2, 0x9249249)):
        cells = (cells | (cells << np.uint64(shift))) & np.uint64(mask)
    for axis in range(3):
        code |= cells[:, axis] << np.uint64(axis)
    return np.argsort(code, kind="stable")


def moved_cloud(cloud: GaussianCloud, T_new_old: Float[np.ndarray, "4 4"]) -> GaussianCloud:
    """The same Gaussians after a rigid motion; what their colour owes to direction turns along."""
    q, _ = se3.split(T_new_old)
    return replace(
        cloud,
        means_m=as_float32(se3.apply(T_new_old, cloud.means_m.astype(np.float64))),
        quats_wxyz=as_float32(turned_quats(q, cloud.quats_wxyz)),
        harmonics=turned_harmonics(cloud.harmonics, T_new_old[:3, :3]),
    )


def turned_quats(
    turn: Float[np.ndarray, "*splats 4"], quats: Float[np.ndarray, "num_splats 4"]
) -> Float[np.ndarray, "num_splats 4"]:
    """Orientations after a turn, one for all or one for each: the Hamilton product, wxyz."""
    w, x, y, z = np.moveaxis(turn, -1, 0)
    w2, x2, y2, z2 = np.ascontiguousarray(quats.T, dtype=np.float64)
    turned = np.empty((len(quats), 4))
    turned[:, 0] = w * w2 - (x * x2 + y * y2 + z * z2)
    turned[:, 1] = w * x2 + w2 * x + (y * z2 - z * y2)
    turned[:, 2] = w * y2 + w2 * y + (z * x2 - x * z2)
    turned[:, 3] = w * z2 + w2 * z + (x * y2 - y * x2)
    return turned


COLUMNS = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *("f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2"),
    *("rot_0", "rot_1", "rot_2", "rot_3"),
)
REST_COLUMNS = tuple(f"f_rest_{index}" for index in range(3 * NUM_FIRST))
"""Harmonics: all of red, then green, then blue. Only where there are any."""
COMPLETED_COLUMN = "completed"
"""1 where nobody measured what a Gaussian stands for; written only where there are any."""
MAX_SPLATS = 50_000_000


class UnreadablePlyError(UnreadableFileError):
    """The file is not a splat PLY of the kind we write."""


def write_ply(path: Path, cloud: GaussianCloud) -> None:
    """Write a cloud; the file appears under its name only when it is complete.

    Scales are natural logarithms, opacities logits, rotations wxyz, colours the constant
    spherical harmonic with those of degree 1 as ``f_rest_0..8`` where the cloud has them. Metres,
    in the frame that ``scene.json`` names. A last column ``completed``, 0 or 1, where some are;
    other viewers pass it over. A file that is there is replaced.
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
            *([cloud.completed[:, None]] if cloud.completed.any() else []),
        ],
        axis=1,
    ).astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(cloud)}"]
    after_color = COLUMNS.index("f_dc_2") + 1
    rest = REST_COLUMNS[: 3 * cloud.num_harmonics]
    marks = (COMPLETED_COLUMN,) if cloud.completed.any() else ()
    names = (*COLUMNS[:after_color], *rest, *COLUMNS[after_color:], *marks)
    header += [f"property float {name}" for name in names]
    write_whole(path, "\n".join([*header, "end_header", ""]).encode() + table.tobytes())


def read_ply(path: Path) -> GaussianCloud:
    """Read a splat PLY. Harmonics above degree 1 and unknown columns are ignored."""
    if not path.is_file():
        hint = "robot-gst rebuild RUN makes it."
        raise PathNotFoundError(path=path, what="splat file", hint=hint)
    data = path.read_bytes()
    head = re.match(rb"ply\r?\n.*?\bend_header\r?\n", data, re.DOTALL)
    if head is None:
        raise UnreadablePlyError(path=path, found="no PLY header")
    names, count = _header(path, head[0].decode("ascii", "replace").splitlines())
    body = data[head.end() :]
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
        completed=table[:, names.index(COMPLETED_COLUMN)] > 0.5
        if COMPLETED_COLUMN in names
        else np.zeros(count, dtype=bool),
    )


def _harmonics(names: list[str], table: np.ndarray) -> np.ndarray:
    """Of files with all harmonics up to a degree (9, 24, 45, ... columns); none from others."""
    total = sum(name.startswith("f_rest_") for name in names)
    degree = round((total / 3 + 1) ** 0.5) - 1
    rest = [f"f_rest_{index}" for index in range(total)]
    if total != 3 * ((degree + 1) ** 2 - 1) or any(name not in names for name in rest):
        return np.zeros((len(table), 0, 3), dtype=np.float32)
    by_color = table[:, [names.index(name) for name in rest]].reshape(len(table), 3, total // 3)
    return as_float32(np.swapaxes(by_color[:, :, :NUM_FIRST], 1, 2))


def _header(path: Path, lines: list[str]) -> tuple[list[str], int]:
    if any(line.split()[2:] == ["packed_position"] for line in lines):
        found = "a compressed splat file; export it uncompressed (in SuperSplat: PLY)"
        raise UnreadablePlyError(path=path, found=found)
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
