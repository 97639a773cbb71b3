"""The rasteriser again, slow and plain, in torch double precision with autograd."""

from math import factorial, pi

import numpy as np
import torch
from numpy.polynomial.legendre import Legendre

from bridge.geometry.camera import Camera

MIP_VARIANCE_PX2 = 0.1
MAX_ALPHA = 0.999
MIN_MIP_RATIO = 2.5e-5
NEAR_M = 0.02


def rotation(quats: torch.Tensor) -> torch.Tensor:
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    return torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
            torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
            torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
        ],
        dim=1,
    )


def _jacobian(camera: Camera, p: torch.Tensor) -> torch.Tensor:
    x, y, z = p.unbind(1)
    margin_x, margin_y = 0.3 * camera.width, 0.3 * camera.height
    tx = (x / z).clamp(
        (-margin_x - camera.cx) / camera.fx, (camera.width + margin_x - camera.cx) / camera.fx
    )
    ty = (y / z).clamp(
        (-margin_y - camera.cy) / camera.fy, (camera.height + margin_y - camera.cy) / camera.fy
    )
    zero = torch.zeros_like(z)
    row_x = torch.stack([camera.fx / z, zero, -camera.fx * tx / z], 1)
    row_y = torch.stack([zero, camera.fy / z, -camera.fy * ty / z], 1)
    return torch.stack([row_x, row_y], 1)


def weights(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales_log: torch.Tensor,
    opacities_logit: torch.Tensor,
    camera: Camera,
    T_camera_base: torch.Tensor,
    alpha_cut: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return what each Gaussian adds to each pixel (num, height, width), and its depth there."""
    T = T_camera_base
    p = means @ T[:3, :3].T + T[:3, 3]
    front = p[:, 2] > NEAR_M
    p = torch.where(front[:, None], p, torch.tensor([0.0, 0.0, 1.0], dtype=p.dtype))
    A = _jacobian(camera, p) @ T[:3, :3] @ rotation(quats) @ torch.diag_embed(scales_log.exp())
    axis = T[2:3, :3] @ rotation(quats) @ torch.diag_embed(scales_log.exp())
    cov = A @ A.transpose(1, 2)
    mip = cov + MIP_VARIANCE_PX2 * torch.eye(2, dtype=cov.dtype)
    ratio = torch.linalg.det(cov) / torch.linalg.det(mip)
    opacity = torch.sigmoid(opacities_logit) * ratio.clamp(min=MIN_MIP_RATIO).sqrt()
    opacity = torch.where(front, opacity, torch.zeros_like(opacity))
    conic = torch.linalg.inv(mip)

    u = camera.fx * p[:, 0] / p[:, 2] + camera.cx
    v = camera.fy * p[:, 1] / p[:, 2] + camera.cy
    columns = torch.arange(camera.width, dtype=p.dtype) + 0.5
    rows = torch.arange(camera.height, dtype=p.dtype) + 0.5
    dx = columns[None, None, :] - u[:, None, None]
    dy = rows[None, :, None] - v[:, None, None]
    k = conic[:, :, :, None, None]
    distance2 = k[:, 0, 0] * dx**2 + 2 * k[:, 0, 1] * dx * dy + k[:, 1, 1] * dy**2
    alpha = opacity[:, None, None] * torch.exp(-0.5 * distance2)
    alpha = torch.where(alpha >= alpha_cut, alpha.clamp(max=MAX_ALPHA), torch.zeros_like(alpha))

    order = torch.argsort(p[:, 2], stable=True)
    alpha = alpha[order]
    light = torch.cumprod(1 - alpha, dim=0)
    light = torch.cat([torch.ones_like(light[:1]), light[:-1]])
    slope = (conic @ A @ axis.transpose(1, 2))[:, :, :, None]
    depth = p[:, 2, None, None] + slope[:, 0] * dx + slope[:, 1] * dy
    return (alpha * light)[torch.argsort(order)], depth


def _harmonic(
    degree: int, order: int, x: torch.Tensor, y: torch.Tensor, z: torch.Tensor
) -> torch.Tensor:
    """Real spherical harmonic by its definition: a derivative of Legendre's P by (-x - iy)^m."""
    m = abs(order)
    across = torch.ones_like(x), torch.zeros_like(x)
    for _ in range(m):
        across = across[1] * y - across[0] * x, -across[0] * y - across[1] * x
    P = Legendre.basis(degree).deriv(m).convert(kind=np.polynomial.Polynomial)
    along = sum(float(c) * z**power for power, c in enumerate(P.coef))
    norm = (2 * degree + 1) / (4 * pi) * factorial(degree - m) / factorial(degree + m)
    factor = (norm if m == 0 else 2 * norm) ** 0.5
    return factor * along * across[0 if order >= 0 else 1]


def seen_colors(
    means: torch.Tensor, colors: torch.Tensor, harmonics: torch.Tensor, T_camera_base: torch.Tensor
) -> torch.Tensor:
    """Colours along the rays from the camera centre -R^T t; harmonics (num, 3, 8 or 15, 3)."""
    ray = means + T_camera_base[:3, 3] @ T_camera_base[:3, :3]
    x, y, z = (ray / ray.norm(dim=1, keepdim=True)).unbind(1)
    degrees = range(1, round((harmonics.shape[1] + 1) ** 0.5))
    basis = torch.stack(
        [_harmonic(n, m, x, y, z) for n in degrees for m in range(-n, n + 1)], dim=1
    )
    return colors + torch.einsum("nk,nkc->nc", basis, harmonics)


def draw(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales_log: torch.Tensor,
    opacities_logit: torch.Tensor,
    colors: torch.Tensor,
    harmonics: torch.Tensor | None = None,
    *,
    camera: Camera,
    T_camera_base: np.ndarray | torch.Tensor,
    alpha_cut: float,
) -> torch.Tensor:
    """Return planes (5, height, width): rgb, weighted depth, alpha."""
    T = torch.as_tensor(T_camera_base, dtype=means.dtype)
    weight, depth = weights(means, quats, scales_log, opacities_logit, camera, T, alpha_cut)
    if harmonics is not None:
        colors = seen_colors(means, colors, harmonics, T)
    image = torch.einsum("nhw,nc->chw", weight, colors)
    rest = torch.stack([(weight * depth).sum(dim=0), weight.sum(dim=0)])
    return torch.cat([image, rest])


def surface_depth(
    weight: torch.Tensor, depth: torch.Tensor, means: torch.Tensor, T_camera_base: torch.Tensor
) -> torch.Tensor:
    """Mean depth (height, width) of what lies within 2 % of where half of the light is gone."""
    order = torch.argsort(means @ T_camera_base[2, :3] + T_camera_base[2, 3], stable=True)
    weight, depth = weight[order], depth[order]
    gone = weight.cumsum(dim=0) >= 0.5
    median = depth.gather(0, gone.int().argmax(dim=0)[None])
    near = weight * ((depth - median).abs() <= 0.02 * median)
    mean = (near * depth).sum(dim=0) / near.sum(dim=0).clamp(min=1e-12)
    return torch.where(gone[-1], mean, torch.zeros_like(mean))
