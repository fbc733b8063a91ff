"""A full-sequence diffusion transformer: the kind of model that the paper compares HMA with. No product.

It denoises all frames of a window at once, as IRASim (arXiv 2406.14540) does: blocks of spatial and temporal
attention over all frames, modulated by the noise level and, frame by frame, by the chunk of actions that led
to the frame (adaLN). The frames of the prompt are given clean. It is trained on the same latents, windows and
batches as a continuous HMA, and generates whole sequences by DDIM in 50 steps. It predicts the velocity, as
our head does: at this size a model that predicts the noise hardly learns (docs/results.md).

    from dit import DiT, train
    model, steps = train(DiT(shards, width=128, layers=4), shards, cpu_seconds=120, seed=0)
    latents = model.generate(prompt, actions, robots, frames=6)

B windows, T frames, P frames of the prompt, S tokens of a frame, D width, K = stride * action dim.
"""

import math
import time
from types import SimpleNamespace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hma_data.loading.dataset import MixtureDataset
from hma_data.shards.reader import ShardSet
from hma_model.network.head import cosine_levels

LEVELS, STEPS = 1000, 50  # of noise; of the sampler, as IRASim's
CLIP = 10.0  # of a step's estimate of the clean latents, as our head's


class Attention(nn.Module):
    """Attention among all tokens of axis 1, without a mask."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads, self.qkv, self.out = heads, nn.Linear(width, 3 * width), nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        q, k, v = self.qkv(x).unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        return self.out(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))


class Block(nn.Module):
    """Attention within frames, attention over frames at each place, and an MLP, all three modulated."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.spatial, self.temporal = Attention(width, heads), Attention(width, heads)
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))
        self.modulation = nn.Linear(width, 9 * width)
        nn.init.zeros_(self.modulation.weight)  # so each block starts as the identity
        nn.init.zeros_(self.modulation.bias)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """Take tokens (B, T, S, D) and conditions (B, T, D)."""
        frames, places = x.shape[1:3]
        parts = self.modulation(F.silu(condition)).unsqueeze(2).chunk(9, dim=-1)

        def normed(number: int) -> Tensor:
            return torch.addcmul(parts[number], F.layer_norm(x, x.shape[-1:]), 1 + parts[number + 1])

        x = x + parts[2] * self.spatial(normed(0).flatten(0, 1)).unflatten(0, (-1, frames))
        over_time = self.temporal(normed(3).transpose(1, 2).flatten(0, 1)).unflatten(0, (-1, places))
        x = x + parts[5] * over_time.transpose(1, 2)
        return x + parts[8] * self.mlp(normed(6))


class DiT(nn.Module):
    """The network, for windows of latents of one robot.

    Args:
        shards: a set of continuous tokens; gives the latents' shape and the statistics of the actions.
        frames: T.
        patch: side of a square of latents that becomes one token.
    """

    def __init__(
        self,
        shards: ShardSet,
        frames: int = 8,
        width: int = 128,
        layers: int = 4,
        heads: int = 4,
        patch: int = 4,
    ) -> None:
        super().__init__()
        spec, stats = shards.spec, shards.manifest.stats["action"]
        assert spec.channels is not None
        self.patch, self.scale, self.channels, self.frames = patch, spec.latent_scale, spec.channels, frames
        self.grid = spec.grid[0] // patch, spec.grid[1] // patch
        values, chunk = spec.channels * patch**2, shards.embodiment.stride * shards.embodiment.action_dim
        self.input, self.output = nn.Linear(values, width), nn.Linear(width, values)
        self.place = nn.Parameter(0.02 * torch.randn(math.prod(self.grid), width))
        self.time = nn.Parameter(0.02 * torch.randn(frames, 1, width))
        self.action = nn.Sequential(nn.Linear(chunk, width), nn.SiLU(), nn.Linear(width, width))
        self.level = nn.Sequential(nn.Linear(256, width), nn.SiLU(), nn.Linear(width, width))
        self.blocks = nn.ModuleList(Block(width, heads) for _ in range(layers))
        self.final = nn.Linear(width, 2 * width)
        for layer in (self.final, self.output):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        mean, std = (
            torch.tensor(stats[key]).float().repeat(chunk // len(stats[key])) for key in ("mean", "std")
        )
        self.register_buffer("mean", mean)
        self.register_buffer("std", std.clamp(min=1e-6))
        self.register_buffer("shares", cosine_levels(LEVELS).double())
        # what hma_model.evaluation.rollouts asks of a model
        self.source = None  # no checkpoint of HMA
        self.config = SimpleNamespace(
            kind="continuous", absent_action="embedding", frames=frames, sees_actions=True
        )
        self.device = torch.device("cpu")

    def forward(self, noisy: Tensor, level: Tensor, actions: Tensor) -> Tensor:
        """Predict the velocity of latents.

        Args:
            noisy: (B, T, c, H, W).
            level: (B, T) int64 of each frame; -1 for clean frames.
            actions: (B, T, K) raw; chunk t leads from frame t to frame t + 1.
        """
        size = self.patch
        x = noisy.unflatten(4, (-1, size)).unflatten(3, (-1, size))  # (B, T, c, h, p, w, p)
        x = self.input(x.permute(0, 1, 3, 5, 2, 4, 6).flatten(4).flatten(2, 3))
        x = x + self.place + self.time[: x.shape[1]]
        chunks = (actions - self.mean) / self.std
        chunks = F.pad(chunks[:, :-1], (0, 0, 1, 0))  # frame t is conditioned on the chunk that led to it
        condition = self.action(chunks) + self.level(_waves(level))
        for block in self.blocks:
            x = block(x, condition)
        shift, scale = self.final(F.silu(condition)).unsqueeze(2).chunk(2, dim=-1)
        x = self.output(torch.addcmul(shift, F.layer_norm(x, x.shape[-1:]), 1 + scale))
        x = x.unflatten(3, (self.channels, size, size)).unflatten(2, self.grid)
        return x.permute(0, 1, 4, 2, 5, 3, 6).flatten(5).flatten(3, 4)

    def loss(self, latents: Tensor, actions: Tensor, generator: torch.Generator) -> Tensor:
        """Return the loss of windows of stored latents; the prompt has 1 to T - 1 clean frames."""
        clean = latents * self.scale
        batch, frames = clean.shape[:2]
        level = torch.randint(LEVELS, (batch, 1), generator=generator).repeat(1, frames)
        given = torch.randint(1, frames, (batch, 1), generator=generator)
        known = torch.arange(frames) < given
        share = self.shares[level].float()[..., None, None, None]
        noise = torch.randn(clean.shape, generator=generator)
        noisy = share.sqrt() * clean + (1 - share).sqrt() * noise
        shown = torch.where(known[..., None, None, None], clean, noisy)
        predicted = self(shown, level.masked_fill(known, -1), actions)
        goal = share.sqrt() * noise - (1 - share).sqrt() * clean
        return F.mse_loss(predicted[~known], goal[~known])

    @torch.no_grad()
    def generate(
        self,
        prompt: Tensor,
        actions: Tensor,
        embodiment: Any = None,
        frames: int = 1,
        *,
        generator: torch.Generator | None = None,
        known: Any = None,
        steps: int = STEPS,
    ) -> Tensor:
        """Continue prompts (B, P, c, H, W) of stored latents under chunks (B, P + frames, K); all at once.

        Unknown commands are the mean command. Return (B, frames, c, H, W).
        """
        if known is not None:
            actions = torch.where(known.unsqueeze(-1), actions, self.mean)
        first = prompt * self.scale
        x = torch.randn((len(prompt), frames, *prompt.shape[2:]), generator=generator)
        levels = torch.linspace(LEVELS - 1, 0, steps).round().long().tolist()
        shares = [*self.shares[levels].tolist(), 1.0]
        mark = torch.full((len(prompt), prompt.shape[1] + frames), -1)
        for number, level in enumerate(levels):
            mark[:, prompt.shape[1] :] = level
            predicted = self(torch.cat([first, x], dim=1), mark, actions)[:, prompt.shape[1] :]
            signal, spread = math.sqrt(shares[number]), math.sqrt(1 - shares[number])
            clean = (signal * x - spread * predicted).clamp(-CLIP, CLIP)
            noise = (x - signal * clean) / spread
            x = math.sqrt(shares[number + 1]) * clean + math.sqrt(1 - shares[number + 1]) * noise
        return x / self.scale


def _waves(level: Tensor) -> Tensor:
    """Return the sinusoids (…, 256) of noise levels."""
    rates = torch.exp(torch.arange(128) * (-math.log(10000) / 128))
    angles = level.float().unsqueeze(-1) * rates
    return torch.cat([angles.cos(), angles.sin()], dim=-1)


def train(
    model: DiT,
    shards: ShardSet,
    cpu_seconds: float,
    seed: int,
    batch_size: int = 4,
    lr: float = 1e-3,
    warmup: int = 30,
    steps: int = 1_000_000,
) -> tuple[DiT, int]:
    """Train by AdamW until so many CPU seconds or steps are spent; lr falls with the share of them.

    Return the model and the number of its steps.
    """
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(model.parameters(), lr=lr, betas=(0.9, 0.95), weight_decay=0.01)
    data = iter(MixtureDataset([shards], batch_size, model.frames, seed=seed))
    begun, done = time.process_time(), 0
    while (share := max((time.process_time() - begun) / cpu_seconds, done / steps)) < 1:
        batch = next(data)
        assert batch.latents is not None
        rate = 0.1 + 0.9 * (1 + math.cos(math.pi * share)) / 2
        optimizer.param_groups[0]["lr"] = lr * rate * min(1.0, (done + 1) / warmup)
        optimizer.zero_grad()
        model.loss(batch.latents.float(), batch.actions, generator).backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        done += 1
    return model.eval(), done
