"""Decode generated frames to images, and choose the model, cameras and prompt for shards.

B batch, T frames, h,w grid, S pixels a side, C cameras.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from hma_data.arrays import Images
from hma_data.errors import UsageError
from hma_data.loading.views import FIRST_CAMERA, Cameras, view_count
from hma_data.shards.reader import ShardSet
from hma_data.storage.paths import StrPath, as_text
from hma_data.tokenizers.base import Tokenizer
from hma_data.tokenizers.network import NetworkTokenizer
from hma_model.checkpoint.folder import EMBEDDED_NAME, resolve
from hma_model.generation.commands import checkpoint_of
from hma_model.network.model import HMA
from hma_model.network.network import Network


def model_for(checkpoint: StrPath, sets: Sequence[ShardSet], device: str = "cpu") -> HMA:
    """Return the model of a checkpoint in eval mode, with the robots of shard sets.

    `embedded` stands for the bundled checkpoint of these robots and of the first set's tokenizer.
    """
    robots = [shards.embodiment.id for shards in sets]
    if as_text(checkpoint) == EMBEDDED_NAME:
        checkpoint = resolve(checkpoint, robots, sets[0].spec.name)
    return HMA.from_pretrained(checkpoint, embodiments=robots, device=device).eval()


def default_prompt(length: int) -> int:
    """Return how many frames of a window of this length a rollout starts from."""
    return max(1, length // 3)


def decode(tokenizer: Tokenizer, stored: Tensor) -> Images:
    """Decode ids (B, T, C·h, w) or latents (B, T, c, C·H, W) to pictures (B, T, S, C·S, 3), side by side.

    Latents that are NaN or infinite are decoded as 0.
    """
    views, rows = stored.flatten(0, 1).nan_to_num(0, 0, 0), tokenizer.spec.grid[0]
    if isinstance(tokenizer, NetworkTokenizer) and not stored.is_cpu:  # tokens stay on the GPU
        kept = views if tokenizer.spec.kind == "discrete" else views.half()
        pictures = torch.cat([tokenizer.pictures(view) for view in kept.split(rows, -2)], 2).numpy(force=True)
    else:
        dtype = np.uint32 if tokenizer.spec.kind == "discrete" else np.dtype(tokenizer.spec.dtype)
        kept = views.round().clamp(0, 255) if dtype == np.uint8 else views  # a cast would wrap around
        cameras = np.split(kept.cpu().numpy().astype(dtype), views.shape[-2] // rows, axis=-2)
        pictures = np.concatenate([tokenizer.decode(view) for view in cameras], axis=2)
    return pictures.reshape(*stored.shape[:2], *pictures.shape[1:])


def trained_cameras(model: Network, embodiment: str) -> Cameras:
    """Return the cameras that a robot's stem was trained on; the first one if no checkpoint tells them."""
    kept = checkpoint_of(model, embodiment)
    return kept.cameras(embodiment) if kept else FIRST_CAMERA


def trained_shards(model: Network, embodiment: str) -> ShardSet | None:
    """Return the shards of an embodiment on which its model was trained; None if they are not here."""
    there = model.source.shards() if model.source else []
    return next((one for one in there if one.embodiment.id == embodiment), None)


def cameras_for(model: Network, shards: ShardSet, cameras: Cameras | None = None) -> Cameras:
    """Return the cameras that a model sees: those given, or those that it was trained on.

    Raises:
        UsageError: these are more or fewer than the views of the model.
    """
    cameras = trained_cameras(model, shards.embodiment.id) if cameras is None else cameras
    if (count := view_count(cameras)) != model.config.views:
        fault = f"are {count} in a frame, but the model takes {model.config.views}"
        raise UsageError(
            "cameras", fault, f"name {model.config.views} of {', '.join(shards.manifest.cameras)}"
        )
    return cameras
