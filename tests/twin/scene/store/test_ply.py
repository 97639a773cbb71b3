from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from twin.scene import gaussians


def some_cloud(count: int = 7) -> gaussians.GaussianCloud:
    rng = np.random.default_rng(3)
    quats = rng.normal(size=(count, 4))
    return gaussians.GaussianCloud(
        means_m=gaussians.as_float32(rng.normal(size=(count, 3))),
        quats_wxyz=gaussians.as_float32(quats / np.linalg.norm(quats, axis=1, keepdims=True)),
        scales_log=gaussians.as_float32(rng.normal(size=(count, 3))),
        opacities_logit=gaussians.as_float32(rng.normal(size=count)),
        colors=gaussians.as_float32(rng.uniform(size=(count, 3))),
    )


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    cloud = some_cloud()
    gaussians.write_ply(tmp_path / "a.ply", cloud)
    again = gaussians.read_ply(tmp_path / "a.ply")
    for name, rows in gaussians.arrays(cloud):
        np.testing.assert_allclose(getattr(again, name), rows, atol=1e-6)
    assert list(tmp_path.iterdir()) == [tmp_path / "a.ply"]


def test_the_header_and_first_row_are_those_other_viewers_expect(tmp_path: Path) -> None:
    cloud = some_cloud(2)
    gaussians.write_ply(tmp_path / "a.ply", cloud)
    head, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 2"]
    assert lines[3:] == [f"property float {name}" for name in gaussians.COLUMNS]
    row = np.frombuffer(body[: 4 * len(gaussians.COLUMNS)], dtype="<f4")
    np.testing.assert_array_equal(row[:3], cloud.means_m[0])
    np.testing.assert_allclose(0.5 + gaussians.SH_DC * row[6:9], cloud.colors[0], atol=1e-6)
    np.testing.assert_array_equal(row[10:13], cloud.scales_log[0])


def test_further_columns_are_ignored(tmp_path: Path) -> None:
    cloud = some_cloud(3)
    gaussians.write_ply(tmp_path / "a.ply", cloud)
    head, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    table = np.frombuffer(body, dtype="<f4").reshape(3, -1)
    wider = np.concatenate([table, np.ones((3, 1), dtype="<f4")], axis=1)
    (tmp_path / "b.ply").write_bytes(
        head + b"property float f_rest_0\nend_header\n" + wider.tobytes()
    )
    np.testing.assert_array_equal(gaussians.read_ply(tmp_path / "b.ply").means_m, cloud.means_m)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda data: data[:-4], "bytes of data"),
        (lambda data: data[4:], "no PLY header"),
        (lambda data: data.replace(b"property float opacity", b"property float opaqueness"), "opa"),
        (lambda data: data.replace(b"little_endian", b"big_endian"), "another PLY format"),
        (lambda data: data.replace(b"element vertex 7", b"element vertex x"), "element vertex"),
        (lambda data: data[:-4] + b"\x00\x00\xc0\x7f", "not finite"),
    ],
)
def test_a_damaged_file_is_refused(
    tmp_path: Path, change: Callable[[bytes], bytes], found: str
) -> None:
    path = tmp_path / "a.ply"
    gaussians.write_ply(path, some_cloud())
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(gaussians.UnreadablePlyError, match=found):
        gaussians.read_ply(path)
