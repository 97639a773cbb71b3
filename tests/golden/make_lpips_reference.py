"""Write ``lpips_reference.json``: what the ``lpips`` package gives, for tests that run without it.

Run in an environment of its own with ``pip install lpips==0.1.4 torch``: the package needs
torchvision, which does not import beside a torch without CUDA, and its presence alone would change
what other packages import. The backbones are drawn from a seed, so no download is needed; the
linear heads are the package's own.
"""

import json
import sys
from pathlib import Path

import numpy as np

PATH = Path(__file__).with_name("lpips_reference.json")
SIZE = (50, 68)
"""Not a multiple of what the poolings halve."""
VGG = [
    *((0, 3, 64, 3), (2, 64, 64, 3), (5, 64, 128, 3), (7, 128, 128, 3), (10, 128, 256, 3)),
    *((12, 256, 256, 3), (14, 256, 256, 3), (17, 256, 512, 3), (19, 512, 512, 3)),
    *((21, 512, 512, 3), (24, 512, 512, 3), (26, 512, 512, 3), (28, 512, 512, 3)),
]
"""Index in ``features``, channels in, channels out, size."""


def backbone() -> dict[str, np.ndarray]:
    """Draw the weights of VGG16 from a seed, named as torchvision names them."""
    rng = np.random.default_rng(16)
    state = {}
    for index, channels_in, channels_out, size in VGG:
        shape = (channels_out, channels_in, size, size)
        spread = np.float32(np.sqrt(2.0 / (channels_in * size * size)))
        state[f"features.{index}.weight"] = rng.standard_normal(shape, dtype=np.float32) * spread
        bias = rng.standard_normal(channels_out, dtype=np.float32)
        state[f"features.{index}.bias"] = bias * np.float32(0.1)
    return state


def images(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw a pair of images (height, width, 3) in 0..1."""
    rng = np.random.default_rng(seed)
    blocks = np.kron(rng.random((SIZE[0] // 5, SIZE[1] // 4, 3)), np.ones((5, 4, 1)))
    noisy = np.clip(blocks + rng.normal(scale=0.02 * (seed + 1), size=blocks.shape), 0, 1)
    return blocks, noisy


def stub_torchvision() -> list[object]:
    """Let torchvision import without its CUDA operators; keep what is returned alive."""
    import torch

    library = torch.library.Library("torchvision", "DEF")
    library.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    library.define("qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    return [library]


def main() -> None:
    """Ask the package about two pairs in 0..1."""
    import torch

    alive = stub_torchvision()
    import lpips

    cases = []
    model = lpips.LPIPS(net="vgg", pnet_rand=True, verbose=False)
    state = {}
    for name, value in backbone().items():
        own = next(n for n in model.net.state_dict() if n.split(".", 1)[1] == name[9:])
        state[own] = torch.from_numpy(value)
    model.net.load_state_dict(state, strict=True)
    for seed in range(2):
        pair = [torch.from_numpy(i).permute(2, 0, 1)[None].float() for i in images(seed)]
        with torch.no_grad():
            cases.append({"seed": seed, "value": float(model(*pair, normalize=False))})
    del alive
    version = sys.modules["importlib.metadata"].version("lpips")
    PATH.write_text(json.dumps({"lpips": version, "cases": cases}, indent=1) + "\n")


if __name__ == "__main__":
    main()
