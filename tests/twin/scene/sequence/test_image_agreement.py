"""Numbers of a composed picture by part: they add up, and a part's error is its own."""

import numpy as np
import pytest

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.image_quality import psnr_db
from bridge.robots.default import ROBOT
from twin.robot.model import load_robot
from twin.robot.posture import Posture
from twin.robot.surface import PosedSurface
from twin.scene.render import ImageAgreement, describe_agreement, part_masks

CAMERA = Camera(width=80, height=60, fx=70.0, fy=70.0, cx=40.0, cy=30.0)
T_CAMERA = se3.look_at(np.array([1.5, -0.8, 0.7]), np.array([0.2, 0.0, 0.3]), np.eye(3)[2])
JOINTS = np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308])
QUAD = (
    np.array([[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.1, 0.1, 0.0], [-0.1, 0.1, 0.0]]),
    np.array([[0, 1, 2], [0, 2, 3]]),
)


def at(p_m: tuple[float, float, float]) -> np.ndarray:
    return se3.transform_from(np.array([1.0, 0.0, 0.0, 0.0]), np.array(p_m))


def test_every_pixel_has_one_part_and_what_is_nearer_hides() -> None:
    robot = PosedSurface(load_robot(ROBOT.urdf_text()), Posture(joints_rad=JOINTS))
    far = part_masks(CAMERA, T_CAMERA, robot, {"plate": QUAD}, {"plate": at((0.5, -0.3, 0.0))})
    assert (sum(mask.astype(int) for mask in far.values()) == 1).all()
    assert min(mask.sum() for mask in far.values()) > 20
    upright = T_CAMERA @ at((0.0, 0.0, 0.4))  # before all else, square to the camera
    near = part_masks(CAMERA, T_CAMERA, robot, {"plate": QUAD}, {"plate": upright})
    edge_px = 2 * 0.1 * CAMERA.fx / 0.4
    assert near["objects"].sum() == pytest.approx(edge_px**2, rel=0.06)
    assert near["robot"].sum() < far["robot"].sum()
    none = part_masks(CAMERA, T_CAMERA, None, {"plate": QUAD}, {})
    assert none["background"].all()


def test_parts_are_rated_alone_and_their_errors_add_up() -> None:
    rng = np.random.default_rng(0)
    agreement = ImageAgreement()
    recorded, drawn = [], []
    for _ in range(3):
        image = rng.integers(0, 200, (60, 80, 3), dtype=np.uint8)
        robot = rng.uniform(size=(60, 80)) < 0.2
        off = image + np.where(robot, 40, 5)[..., None].astype(np.uint8)
        nothing = np.zeros_like(robot)
        parts = {"robot": robot, "objects": nothing, "background": ~robot}
        agreement.add(image, off, ~robot, parts)
        recorded.append(image)
        drawn.append(off)
    found = agreement.record()
    assert found["images"] == 3
    assert found["robot"]["psnr_db"] == pytest.approx(20 * np.log10(255 / 40))
    assert found["seen"]["psnr_db"] == pytest.approx(20 * np.log10(255 / 5))
    assert found["unseen"] == found["robot"]
    assert found["objects"]["psnr_db"] is None
    stacked = (np.concatenate(images) / 255.0 for images in (recorded, drawn))
    assert found["whole"]["psnr_db"] == pytest.approx(psnr_db(*stacked))
    for share in ("pixel_fraction", "error_fraction"):
        parts = [found[name][share] for name in ("robot", "objects", "background")]
        assert sum(parts) == pytest.approx(1.0)
    assert "undefined" in describe_agreement(found)
