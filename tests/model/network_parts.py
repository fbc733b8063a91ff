"""Small models and batches that the network's tests share."""

from typing import Any

import torch

from hma_data.loading.dataset import Batch
from hma_model.config import ActionSpace, HMAConfig
from hma_model.network.conditioning import Groups, align
from hma_model.network.model import HMA
from hma_model.network.stem import patchify

ARM = ActionSpace("arm", 3, 2, (1.0, -2.0, 0.5), (2.0, 0.5, 1.0), (True, True, False))
HAND = ActionSpace("hand.v1", 2, 1, (0.0, 3.0), (1.0, 0.0), (True, True))


def seeded(value: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(value)


def small_config(**changes: Any) -> HMAConfig:
    values: dict[str, Any] = {
        "layers": 2, "width": 32, "heads": 4, "frames": 5, "grid": (4, 4), "factored": (6, 4),
        "base_width": 16, "diffusion_width": 32, "diffusion_depth": 2, "diffusion_sample_steps": 4,
    }  # fmt: skip
    if changes.get("kind") == "continuous":
        values |= {"grid": (8, 8), "channels": 3, "latent_scale": 0.5}
    return HMAConfig(**(values | changes))


def small_model(seed: int = 0, **changes: Any) -> HMA:
    torch.manual_seed(seed)
    model = HMA(small_config(**changes))
    model.add_embodiment(ARM)
    model.add_embodiment(HAND)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    return model.eval()


def small_batch(config: HMAConfig, embodiment: list[str], seed: int = 0, frames: int | None = None) -> Batch:
    generator = torch.Generator().manual_seed(seed)
    b, t = len(embodiment), frames or config.frames
    actions = torch.randn(b, t, ARM.chunk_dim, generator=generator)
    for row, name in enumerate(embodiment):
        if name == HAND.id:
            actions[row, :, HAND.chunk_dim :] = 0
    return Batch(
        embodiment=embodiment,
        actions=actions,
        action_mask=torch.ones(b, t, dtype=torch.bool),
        tokens=torch.randint(0, config.vocab_size, (b, t, *config.grid), generator=generator),
        latents=torch.randn(b, t, config.channels, *config.grid, generator=generator),
    )


def conditions(model: HMA, latents: torch.Tensor, mask: torch.Tensor, actions: Any, robot: str) -> Any:
    """Return the conditions (B, T, H/p, W/p, D) under which a continuous model draws its patches."""
    config, count = model.config, latents.shape[1]
    groups, times = Groups.of(robot, len(latents)), model.time_positions(count)
    patches, hidden = (patchify(values, config.patch) for values in (latents, mask.unsqueeze(2)))
    chunks = None if actions is None else align(config, actions, None, count)
    conditioning = model.condition(chunks, groups, times.positions)
    features = model.video_features(model.trunk(model.embed(patches, hidden), conditioning, times))
    return model.latent_readout(features, times.positions).unflatten(2, config.token_grid)
