"""What ``gsplat.rasterization`` documents, slow and plain in torch; stands in where it cannot run.

Every pixel meets every Gaussian. Only the arguments that ``twin.scene.raster.backend`` passes.
"""

from typing import Any

import torch

MAX_ALPHA = 0.999
ALPHA_CUT = 1.0 / 255.0


def _rotation(quats: torch.Tensor) -> torch.Tensor:
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


def rasterization(
    *,
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
    near_plane: float,
    eps2d: float,
    packed: bool,
    render_mode: str,
    rasterize_mode: str,
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Colours (1, h, w, channels), alphas (1, h, w, 1), and the radii of one view."""
    if packed or rasterize_mode != "antialiased" or render_mode != "RGB":
        raise NotImplementedError(render_mode)
    T, K = viewmats[0], Ks[0]
    p = means @ T[:3, :3].T + T[:3, 3]
    front = p[:, 2] > near_plane
    p = torch.where(front[:, None], p, torch.tensor([0.0, 0.0, 1.0], dtype=p.dtype))
    x, y, z = p.unbind(1)
    zero = torch.zeros_like(z)
    J = torch.stack(
        [
            torch.stack([K[0, 0] / z, zero, -K[0, 0] * x / z**2], 1),
            torch.stack([zero, K[1, 1] / z, -K[1, 1] * y / z**2], 1),
        ],
        1,
    )
    A = J @ T[:3, :3] @ _rotation(quats) @ torch.diag_embed(scales)
    cov = A @ A.transpose(1, 2)
    blurred = cov + eps2d * torch.eye(2, dtype=cov.dtype)
    compensation = (torch.linalg.det(cov) / torch.linalg.det(blurred)).clamp(min=0).sqrt()
    opacity = torch.where(front, opacities * compensation, zero)
    conic = torch.linalg.inv(blurred)
    u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
    columns = torch.arange(width, dtype=p.dtype) + 0.5
    rows = torch.arange(height, dtype=p.dtype) + 0.5
    dx = columns[None, None, :] - u[:, None, None]
    dy = rows[None, :, None] - v[:, None, None]
    c = conic[:, :, :, None, None]
    distance2 = c[:, 0, 0] * dx**2 + 2 * c[:, 0, 1] * dx * dy + c[:, 1, 1] * dy**2
    alpha = opacity[:, None, None] * torch.exp(-0.5 * distance2)
    alpha = torch.where(alpha >= ALPHA_CUT, alpha.clamp(max=MAX_ALPHA), torch.zeros_like(alpha))
    order = torch.argsort(z, stable=True)
    alpha = alpha[order]
    light = torch.cumprod(1 - alpha, dim=0)
    weight = alpha * torch.cat([torch.ones_like(light[:1]), light[:-1]])
    image = torch.einsum("nhw,nc->hwc", weight, colors[order])
    radius = 3.0 * blurred.diagonal(dim1=1, dim2=2).sqrt() * front[:, None]
    touches = (u + radius[:, 0] > 0) & (u - radius[:, 0] < width)
    touches &= (v + radius[:, 1] > 0) & (v - radius[:, 1] < height) & (opacity > ALPHA_CUT)
    radii = (radius * touches[:, None]).ceil().to(torch.int32)
    return image[None], weight.sum(0)[None, :, :, None], {"radii": radii[None]}
