"""Measure LPIPS (Zhang et al. 2018), if its package and the weights of its backbone are installed.

N pictures of S×S, uint8 RGB.
"""

import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hma_data.errors import MissingDependencyError

Frames = NDArray[np.uint8]
Perceptual = Callable[[Frames, Frames], NDArray[np.float64]]
INSTALL = "pip install lpips"
BACKBONE = "alexnet-owt-7be5be79.pth"  # torchvision's file of AlexNet, 233 MB


def open_lpips(*, download: bool, device: str = "cpu") -> Perceptual:
    """Return a function that measures LPIPS: (N, S, S, 3) true and made -> (N,); lower is nearer.

    Args:
        download: whether the backbone may be downloaded.

    Raises:
        MissingDependencyError: the package or the backbone is missing; the remedy says how to get it.
    """
    try:
        lpips = import_module("lpips")
    except ImportError as fault:
        raise MissingDependencyError("LPIPS", "the package lpips is not installed", INSTALL) from fault
    cached = Path(torch.hub.get_dir()) / "checkpoints" / BACKBONE
    if not download and not cached.is_file():
        raise MissingDependencyError(
            "LPIPS", "AlexNet's weights (233 MB) are not on this machine", "--lpips downloads them"
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it uses torchvision's old arguments
            network = lpips.LPIPS(net="alex", verbose=False).to(device).eval()
    except OSError as fault:
        raise MissingDependencyError(
            "LPIPS", f"AlexNet's weights cannot be had: {fault}", f"put {BACKBONE} into {cached.parent}"
        ) from fault

    @torch.inference_mode()
    def measure(true: Frames, made: Frames) -> NDArray[np.float64]:
        pair = (_pixels(frames, device) for frames in (true, made))
        return np.asarray(network(*pair).flatten().cpu().numpy(), np.float64)

    return measure


def _pixels(frames: Frames, device: str) -> Any:
    return torch.from_numpy(frames).to(device).permute(0, 3, 1, 2).float().mul(2 / 255).sub(1)
