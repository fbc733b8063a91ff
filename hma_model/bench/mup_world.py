"""Train a small model on a small synthetic world, for `hma bench mup` and the test of muP.

The world consists of patterns of tokens that the action moves along a line, frame by frame.

B batch, T frames, h,w token grid.
"""

from dataclasses import dataclass

import numpy as np
import torch

from hma_model.config import ActionSpace, HMAConfig
from hma_model.network.model import HMA
from hma_model.training.optim import parameter_groups

SPACE = ActionSpace("mover", 1, 1, (0.0,), (1.0,), (True,))
_GRID, _FRAMES, _DIGITS, _PATTERNS = (4, 4), 4, (16, 16), 16


@dataclass
class Windows:
    """Windows of the synthetic world; see `hma_model.network.objectives.Windows`."""

    tokens: torch.Tensor
    actions: torch.Tensor
    action_mask: torch.Tensor
    embodiment: list[str]
    latents: None = None


def windows(batch: int, generator: torch.Generator) -> Windows:
    """Return a batch in which the action (B, T, 1) of -1, 0 or 1 shifts each frame to the next."""
    cells = _GRID[0] * _GRID[1]
    patterns = torch.randint(0, 256, (_PATTERNS, cells), generator=torch.Generator().manual_seed(0))
    moves = torch.randint(-1, 2, (batch, _FRAMES), generator=generator)
    start = torch.randint(0, cells, (batch, 1), generator=generator)
    offset = start + torch.nn.functional.pad(moves[:, :-1], (1, 0)).cumsum(1)
    index = (torch.arange(cells) + offset.unsqueeze(-1)) % cells
    chosen = patterns[torch.randint(0, _PATTERNS, (batch,), generator=generator)]
    tokens = chosen.unsqueeze(1).expand(-1, _FRAMES, -1).gather(2, index)
    return Windows(
        tokens.unflatten(2, _GRID),
        moves.unsqueeze(-1).float(),
        torch.ones(batch, _FRAMES, dtype=torch.bool),
        [SPACE.id] * batch,
    )


def make_model(width: int, layers: int, mup: bool, base_width: int, seed: int = 0) -> HMA:
    """Return a model of the synthetic world."""
    torch.manual_seed(seed)
    config = HMAConfig(
        layers=layers, width=width, heads=4, frames=_FRAMES, grid=_GRID, factored=_DIGITS, mup=mup,
        base_width=base_width, label_smoothing=0.0, corrupt_max=0.0, history_probability=0.0,
    )  # fmt: skip
    model = HMA(config)
    model.add_embodiment(SPACE)
    return model.train()


def train(model: HMA, rate: float, steps: int, batch: int, seed: int = 0) -> list[float]:
    """Train with AdamW at a constant rate until a loss is not finite; return all losses in nats a token."""
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(parameter_groups(model, rate, 0.0), betas=(0.9, 0.95))
    losses = []
    for _ in range(steps):
        out = model(windows(batch, generator), "forward", generator)
        losses.append(out.loss.item())
        if not np.isfinite(losses[-1]):
            break
        optimizer.zero_grad()
        out.loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
    return losses
