"""How much drawn images agree with recorded ones: whole, where seen, and by part of the scene.

Every PSNR is of the squared error over all pixels of its kind in all images, so that an image in
which a part is small counts little. Robot and objects are where their meshes are met first along
the ray of the recorded camera, whatever is drawn there; background is all the rest.
"""

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from bridge.geometry.camera import Camera
from bridge.media.image_quality import as_float
from twin.robot.surface import PosedSurface
from twin.scene.shape.mesh import Mesh, first_hit
from twin.scene.store.library import NOT_SCANNED


def part_masks(
    camera: Camera,
    T_base_camera: Float[np.ndarray, "4 4"],
    robot: PosedSurface | None,
    meshes: Mapping[str, Mesh],
    Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]],
    not_scanned: Collection[str] = (),
) -> dict[str, Bool[np.ndarray, "height width"]]:
    """Which pixels show robot, objects and background, by the first mesh along each ray.

    Args:
        robot: Its surface as it stands then; None: it is not known.
        not_scanned: Objects that no scan saw: they are objects, and a kind of their own besides.
    """
    rays = camera.rays()
    nothing = np.full(rays.shape[:2], np.inf, dtype=np.float32)
    robot_m = nothing if robot is None else robot.depth_along(rays, T_base_camera)
    objects_m, _ = first_hit(rays, T_base_camera, meshes, Ts_base_object)
    is_robot = np.isfinite(robot_m) & (robot_m <= objects_m)
    is_object = np.isfinite(objects_m) & ~is_robot
    masks = {"robot": is_robot, "objects": is_object, "background": ~is_robot & ~is_object}
    drawn_from_task = {name: mesh for name, mesh in meshes.items() if name in not_scanned}
    if drawn_from_task:
        own_m, _ = first_hit(rays, T_base_camera, drawn_from_task, Ts_base_object)
        masks[NOT_SCANNED] = is_object & (own_m <= objects_m)
    return masks


class ImageAgreement:
    """Collects squared errors over many images."""

    def __init__(self) -> None:
        """Nothing was compared yet."""
        self._squared: dict[str, float] = {}
        self._pixels: dict[str, int] = {}
        self._images = 0

    def add(
        self,
        recorded_u8: UInt8[np.ndarray, "height width 3"],
        drawn_u8: UInt8[np.ndarray, "height width 3"],
        seen_mask: Bool[np.ndarray, "height width"],
        parts: Mapping[str, Bool[np.ndarray, "height width"]],
    ) -> None:
        """Compare one more image."""
        squared = np.square(as_float(recorded_u8) - as_float(drawn_u8)).mean(axis=-1)
        whole = np.ones_like(seen_mask)
        kinds = {"whole": whole, "seen": seen_mask, "unseen": ~seen_mask, **parts}
        for kind, mask in kinds.items():
            self._squared[kind] = self._squared.get(kind, 0.0) + float(squared[mask].sum())
            self._pixels[kind] = self._pixels.get(kind, 0) + int(mask.sum())
        self._images += 1

    def record(self) -> dict[str, Any]:
        """PSNR [dB], share of the pixels and share of the squared error of each kind.

        A kind without pixels, or without any error, has no PSNR: None.
        """
        total, pixels = self._squared.get("whole", 0.0), self._pixels.get("whole", 0)
        return {
            "images": self._images,
            **{
                kind: {
                    "psnr_db": -10.0 * float(np.log10(squared / self._pixels[kind]))
                    if squared > 0 and self._pixels[kind]
                    else None,
                    "pixel_fraction": self._pixels[kind] / pixels,
                    "error_fraction": squared / total if total > 0 else 0.0,
                }
                for kind, squared in self._squared.items()
            },
        }


def describe_agreement(record: Mapping[str, Any]) -> str:
    """One line for each kind of pixel."""
    lines = [f"compared with {record['images']} recorded images:"]
    for kind, found in record.items():
        if kind == "images":
            continue
        psnr = found["psnr_db"]
        text = "undefined (no pixel, or no error)" if psnr is None else f"{psnr:.2f} dB"
        lines.append(
            f"  {kind:<11}{text}, {found['pixel_fraction']:.1%} of the pixels, "
            f"{found['error_fraction']:.1%} of the squared error"
        )
    return "\n".join(lines)
