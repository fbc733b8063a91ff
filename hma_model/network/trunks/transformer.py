"""Define the space-time transformer that all embodiments share (paper section 3).

A block applies bidirectional attention among the tokens of a frame, modulation by the action, causal
attention over time at each place of the frame, and an MLP. No information flows backwards in time, so a
rollout carries the keys and values of past frames.

B batch, T frames, S tokens of a frame, N = S + action tokens, D width, L layers, R cache slots.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hma_model.config import HMAConfig
from hma_model.network.linear import Linear, after_gelu, after_norm, recomputed
from hma_model.network.rotary import rotate, rotate_qkv, turns_of
from hma_model.network.stem import Modulation
from hma_model.network.trunks.contract import BlockTrunk, Carried, Conditioning, TimePositions, rows_at

SEQUENCE_LIMIT = 2**15  # of one call of attention: kernels of a GPU refuse 65,536 and more
# Keys up to which attention in bfloat16 on a CPU is computed as products of all sequences at once: the fused
# kernel's backward pass takes about 7 times as long at 12 keys and 5 times at 32.
PRODUCT_KEYS = 128
CACHED_SCORES = 2**20  # scores that stay in a core's cache between their products


def remember(cache: Tensor, new: tuple[Tensor, Tensor], times: TimePositions) -> Tensor:
    """Write keys and values (B, T, ...) into a cache (2, R, rows, ...); return that of the pass's rows."""
    assert times.slots is not None
    # `slots` numbers (slot, row) pairs: one index_copy_ writes frames of rows at different times.
    slots = times.slots.flatten()
    both = torch.cat([slots, slots + cache.shape[1] * cache.shape[2]])  # of keys, and of values
    cache.flatten(0, 2).index_copy_(0, both, torch.cat(new).flatten(0, 1))
    return cache if times.rows is None else cache[:, :, times.rows]


def sinusoids(grid: tuple[int, int], width: int) -> Tensor:
    """Return 2-D sinusoids (S, D) of the places of a grid, of standard deviation 0.5.

    A quarter of the channels each is a sine or cosine of the row or the column; the longest wave is 4 times
    the larger side, the shortest two places.
    """
    quarter = -(-width // 4)
    waves = torch.logspace(math.log2(4 * max(grid)), 1, quarter, base=2)
    places = torch.cartesian_prod(*(torch.arange(side, dtype=torch.float32) for side in grid))
    angles = places.unsqueeze(-1) * (2 * math.pi / waves)  # (S, 2, D / 4)
    values = torch.cat([angles.sin(), angles.cos()], dim=-1).flatten(1)
    return values[:, :width] * 0.5**0.5


def attend(
    q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None, scale: float, causal: bool = False
) -> Tensor:
    """Attend from queries (M, heads, T, head_dim) to keys and values (M, heads, R, head_dim).

    `mask` (T, R) or (1 or M, 1, T, R) is True where attention is allowed. Attention over time has a sequence
    for each place of each window: M may be large.
    """
    if q.device.type == "cpu" and q.dtype == torch.bfloat16 and not torch.compiler.is_compiling():
        if k.shape[-2] <= PRODUCT_KEYS:
            return _attend_by_products(q, k, v, mask, scale, causal)
        if mask is None and not causal:
            made: Tensor = _InCache.apply(q, k, v, scale)
            return made
        return attend(q.float(), k.float(), v.float(), mask, scale, causal).to(q.dtype)
    if torch.compiler.is_exporting():
        return _attend_by_products(q, k, v, mask, scale, causal)
    if len(q) <= SEQUENCE_LIMIT:
        return F.scaled_dot_product_attention(q, k, v, mask, is_causal=causal, scale=scale)
    masks: Sequence[Tensor | None] = [mask] * -(-len(q) // SEQUENCE_LIMIT)
    if mask is not None and mask.dim() > 2 and len(mask) > 1:
        masks = mask.split(SEQUENCE_LIMIT)
    parts = zip(*(x.split(SEQUENCE_LIMIT) for x in (q, k, v)), masks, strict=True)
    return torch.cat([attend(q, k, v, mask, scale, causal) for q, k, v, mask in parts])


def _attend_by_products(
    q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None, scale: float, causal: bool
) -> Tensor:
    """Do as `attend` in two products, with all scores in memory."""
    scores = (q * scale) @ k.transpose(-1, -2)
    if causal:
        mask = torch.ones(scores.shape[-2:], dtype=torch.bool, device=q.device).tril()
    if mask is not None:
        # a sum needs no work in the backward pass, masked_fill would
        scores = scores + torch.zeros_like(mask, dtype=q.dtype).masked_fill_(~mask, -torch.inf)
    return scores.softmax(-1) @ v


class _InCache(torch.autograd.Function):
    """Attention without a mask by products of a few sequences at a time, whose scores stay in the cache.

    The backward pass computes the scores again. With 320 keys both passes take 0.6 times the time of torch's
    fused kernel in float32, the faster of its two.
    """

    @staticmethod
    def forward(ctx: Any, q: Tensor, k: Tensor, v: Tensor, scale: float) -> Tensor:
        flat = [x.flatten(0, 1) for x in (q * scale, k, v)]
        made = torch.empty_like(flat[0])
        for queries, keys, values, out in zip(*_InCache.parts([*flat, made]), strict=True):
            torch.bmm(torch.bmm(queries, keys.mT).softmax(-1), values, out=out)
        ctx.save_for_backward(*flat)
        ctx.scale, ctx.heads = scale, q.shape[:2]
        return made.unflatten(0, q.shape[:2])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:
        saved = ctx.saved_tensors  # once: a checkpoint refuses a second time
        flat = [grad.flatten(0, 1), *saved]
        made = [torch.empty_like(x) for x in saved]
        for part in zip(*_InCache.parts([*flat, *made]), strict=True):
            of_out, queries, keys, values, of_queries, of_keys, of_values = part
            shares = torch.bmm(queries, keys.mT).softmax(-1)
            torch.bmm(shares.mT, of_out, out=of_values)
            of_shares = torch.bmm(of_out, values.mT)
            of_scores = torch._softmax_backward_data(of_shares, shares, -1, shares.dtype)
            torch.bmm(of_scores, keys, out=of_queries)
            torch.bmm(of_scores.mT, queries, out=of_keys)
        of_q, of_k, of_v = (x.unflatten(0, ctx.heads) for x in made)
        return of_q.mul_(ctx.scale), of_k, of_v, None

    @staticmethod
    def parts(tensors: list[Tensor]) -> list[tuple[Tensor, ...]]:
        """Split the sequences (N, T, head_dim) of queries, keys and what belongs to them."""
        most = max(1, CACHED_SCORES // max(x.shape[1] for x in tensors) ** 2)
        return [x.split(most) for x in tensors]


class Attention(nn.Module):
    """Scaled dot-product attention with its projections."""

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        width = config.width
        self.heads, self.normed = config.heads, config.qk_norm
        self.scale = config.attention_scale
        self.qkv = Linear(width, 3 * width, bias=config.qkv_bias)
        self.proj = Linear(width, width)
        self.q_norm = nn.LayerNorm(config.head_dim) if config.qk_norm else nn.Identity()
        self.k_norm = nn.LayerNorm(config.head_dim) if config.qk_norm else nn.Identity()

    def project(
        self, x: Tensor, norm: nn.Module, times: TimePositions | None = None, within: bool = False
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Project (..., length, D), or `within` frames (..., T, N, D), to q, k, v (..., heads, head_dim).

        With `times`, queries and keys are rotated.
        """
        qkv = after_norm(norm, self.qkv, x).unflatten(-1, (3, self.heads, -1))
        if self.normed:
            q, k, v = qkv.unbind(-3)
            qkv = torch.stack([self.q_norm(q), self.k_norm(k), v], dim=-3)
        if times is None:
            q, k, v = qkv.unbind(-3)
            return q, k, v
        turns, rotary = None, times.rotary
        if not torch.compiler.is_compiling():
            turns = times.once("turns", lambda: turns_of(rotary, self.heads, within))
        return rotate_qkv(qkv, rotary, within, turns)

    def merge(
        self, q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None = None, causal: bool = False
    ) -> Tensor:
        """Attend over (M, length, heads, head_dim), and project the result to (M, length, D)."""
        q, k, v = (x.transpose(1, 2) for x in (q, k, v))
        mixed = attend(q, k, v, mask, self.scale, causal)
        return self.proj(mixed.transpose(1, 2).flatten(-2))


class TemporalAttention(Attention):
    """Causal attention over time, separately at each place of the frame."""

    def __init__(self, config: HMAConfig) -> None:
        super().__init__(config)
        self.rotary = not config.released

    def forward(
        self, x: Tensor, norm: nn.Module, times: TimePositions, cache: Tensor | None, first: int = 0
    ) -> Tensor:
        """Apply `norm` and attention over time to (B, T, N, D); return frames from `first` on."""
        turned = times if self.rotary else None
        if cache is not None:
            q, k, v = self.project(x, norm, turned, within=True)
            return self.proj(self._recall(q[:, first:], times, remember(cache, (k, v), times)))
        b, t, n, width = x.shape
        q, k, v = self.project(x.transpose(1, 2).reshape(b * n, t, width), norm, turned)
        causal = times.causal and not first
        mask = None if causal else times.allowed[..., first:, :]
        return self.merge(q[:, first:], k, v, mask, causal).view(b, n, t - first, width).transpose(1, 2)

    def _recall(self, q: Tensor, times: TimePositions, cache: Tensor) -> Tensor:
        """Attend from the last T frames' queries (B, T, N, heads, head_dim) to the rows' cache.

        Return (B, T, N, D).
        """
        b, t, n, heads, size = q.shape
        allowed = times.allowed[:, -t:]  # (1 or B, T, R)
        exporting = torch.compiler.is_exporting()
        if torch.compiler.is_compiling() and not exporting:
            return self._recall_fused(q, allowed, cache)
        if q.device.type != "cpu" or q.dtype != torch.float32:
            queries = q.transpose(1, 2).flatten(0, 1).transpose(1, 2)  # (B*N, heads, T, head_dim)
            k, v = cache.flatten(2, 3).permute(0, 2, 3, 1, 4)
            mask = allowed if len(allowed) == 1 else allowed.repeat_interleave(n, dim=0)
            mixed = attend(queries, k, v, mask.unsqueeze(1), self.scale)
            return mixed.view(b, n, heads, t, size).permute(0, 3, 1, 2, 4).flatten(-2)
        # On a CPU with so few frames a place, batched products take half as long as the fused kernel. The
        # softmax takes a tenth of the time if its vectors run over places instead of frames.
        rows = q.permute(0, 2, 3, 1, 4).reshape(-1, t, size)
        k, v = cache.flatten(2, 4).transpose(1, 2)  # (B*N*heads, R, head_dim)
        hidden = times.once(f"hidden {t}", lambda: self._hidden(allowed, n * heads))
        scores = torch.baddbmm(hidden, rows, k.transpose(1, 2), alpha=self.scale)
        weights = scores.softmax(-1) if exporting else scores.permute(2, 0, 1).softmax(0).permute(1, 2, 0)
        return torch.bmm(weights, v).view(b, n, heads, t, size).permute(0, 3, 1, 2, 4).flatten(-2)

    def _recall_fused(self, q: Tensor, allowed: Tensor, cache: Tensor) -> Tensor:
        """Do as `_recall` in operations that a compiler makes two kernels of, each reading the cache once."""
        k, v = cache.unsqueeze(2)  # (R, 1, B, N, heads, head_dim)
        scores = (q.transpose(0, 1) * k).float().sum(-1) * self.scale  # (R, T, B, N, heads)
        hidden = ~allowed.permute(2, 1, 0)[..., None, None]
        weights = scores.masked_fill(hidden, -torch.inf).softmax(0).unsqueeze(-1)
        return (weights * v).sum(0).to(q.dtype).transpose(0, 1).flatten(-2)

    @staticmethod
    def _hidden(allowed: Tensor, rows: int) -> Tensor:
        """Return (1 or B * rows, T, keys) zeros, and minus infinity where attention is not allowed."""
        hidden = torch.zeros_like(allowed, dtype=torch.float32).masked_fill_(~allowed, -torch.inf)
        return hidden if len(hidden) == 1 else hidden.repeat_interleave(rows, dim=0)


class ActionAttention(nn.Module):
    """Cross-attention, with rotary time, of a frame's tokens to the action embeddings up to that frame."""

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        width = config.width
        self.heads = config.heads
        self.scale = config.attention_scale
        self.q = Linear(width, width, bias=config.qkv_bias)
        self.kv = Linear(width, 2 * width, bias=config.qkv_bias)
        self.proj = Linear(width, width)

    def forward(self, x: Tensor, embedding: Tensor, times: TimePositions, cache: Tensor | None) -> Tensor:
        """Attend from tokens (B, T, N, D) to action embeddings (B, T, D); return (B, T, N, D)."""
        b, t, n, _ = x.shape
        q = self.q(x).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        cos, sin = (angle.unsqueeze(-3) for angle in times.rotary)
        q = rotate(q, (cos, sin))  # (B, N, T, heads, head_dim)
        k, v = self.kv(embedding).unflatten(-1, (2, self.heads, -1)).unbind(2)
        k = rotate(k, times.rotary)
        if cache is not None:
            k, v = remember(cache, (k, v), times).transpose(1, 2)
        k, v = k.transpose(1, 2), v.transpose(1, 2)  # (B, heads, keys, head_dim)
        queries = q.permute(0, 3, 2, 1, 4).flatten(2, 3)  # (B, heads, T*N, head_dim)
        mask = times.allowed.repeat_interleave(n, dim=-2)
        if mask.dim() == 3:
            mask = mask.unsqueeze(1)
        mixed = attend(queries, k, v, mask, self.scale)
        return self.proj(mixed.transpose(1, 2).flatten(-2)).view(b, t, n, -1)


class MLP(nn.Module):
    """Two linear maps with a GELU between."""

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        hidden = int(config.width * config.mlp_ratio)
        self.fc1 = Linear(config.width, hidden, bias=config.mlp_bias)
        self.fc2 = Linear(hidden, config.width, bias=config.mlp_bias)

    def forward(self, x: Tensor, norm: nn.Module) -> Tensor:
        """Apply `norm` and the two maps to (..., D); keep the shape."""
        return after_gelu(self.fc2, after_norm(norm, self.fc1, x))


class Block(nn.Module):
    """A transformer block: space, action, time and MLP, each with a residual connection."""

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        width = config.width
        self.space_norm = nn.Identity() if config.qk_norm else nn.LayerNorm(width)
        self.space = Attention(config)
        self.modulation_out: nn.Linear | None = None
        if "modulation" in config.conditioning and not config.released:
            self.modulation_out = Linear(width, width)
        self.adds = "add" in config.conditioning
        self.action: ActionAttention | None = None
        if "cross_attention" in config.conditioning:
            self.action_norm = nn.LayerNorm(width)
            self.action = ActionAttention(config)
        self.time_norm = nn.Identity() if config.released else nn.LayerNorm(width)
        self.time = TemporalAttention(config)
        self.mlp_norm = nn.Identity() if config.qk_norm else nn.LayerNorm(width)
        self.mlp = MLP(config)

    def forward(
        self,
        x: Tensor,
        conditioning: Conditioning,
        layer: int,
        times: TimePositions,
        cache: Sequence[Tensor | None],
        first: int = 0,
    ) -> Tensor:
        """Apply the block to tokens (B, T, N, D); return those of the frames from `first` on."""
        qkv = self.space.project(x.flatten(0, 1), self.space_norm)
        x = x + self.space.merge(*qkv).view(x.shape)
        if self.adds and conditioning.embedding is not None:
            x = x + conditioning.embedding.unsqueeze(2)
        if conditioning.modulation is not None:
            x = x + recomputed(self.modulation_out, self.modulate, x, conditioning, layer)
        if self.action is not None and conditioning.embedding is not None:
            x = x + self.action(self.action_norm(x), conditioning.embedding, times, cache[1])
        x = x[:, first:] + self.time(x, self.time_norm, times, cache[0], first)
        return x + self.mlp(x, self.mlp_norm)

    def modulate(self, x: Tensor, conditioning: Conditioning, layer: int) -> Tensor:
        """Return the modulated norm of all tokens, projected."""
        assert conditioning.modulation is not None
        shift, gain = conditioning.modulation[layer].unsqueeze(2).chunk(2, dim=-1)
        modulated = torch.addcmul(shift, F.layer_norm(x, x.shape[-1:], eps=1e-6), gain)
        if self.modulation_out is not None:
            return self.modulation_out(modulated)
        assert conditioning.out is not None
        if conditioning.order is not None:
            modulated = modulated[conditioning.order[0]]
        parts = modulated.split([size for size, _, _ in conditioning.out])
        projected = [F.linear(part, w[layer], b[layer]) for part, (_, w, b) in zip(parts, conditioning.out)]
        joined = projected[0] if len(projected) == 1 else torch.cat(projected)
        return joined if conditioning.order is None else joined[conditioning.order[1]]


class Transformer(BlockTrunk):
    """The space-time transformer: embedding, positions and blocks; it satisfies `contract.Trunk`."""

    def __init__(self, config: HMAConfig) -> None:
        super().__init__(config)
        positions = config.frames if config.released else 1
        tokens = config.tokens_per_frame + max(config.appended_tokens, config.absent_tokens)
        self.position = nn.Parameter(torch.randn(positions, tokens, config.width) * 0.02)
        if config.position_init == "sinusoid":
            with torch.no_grad():
                self.position[:, : config.tokens_per_frame] = sinusoids(config.token_grid, config.width)
        continuous = not config.discrete
        self.embed_norm = nn.LayerNorm(config.width, eps=1e-6) if continuous else nn.Identity()
        self.absent = nn.Parameter(torch.randn(positions, config.width) * 0.02)
        self.modulation: Modulation | None = None
        if "modulation" in config.conditioning and config.shared_modulation:
            self.modulation = Modulation(config)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.layers))
        self.norm = nn.Identity() if config.released else nn.LayerNorm(config.width)
        branches = (3 + bool({"modulation", "cross_attention"} & set(config.conditioning))) * config.layers
        for name, module in self.blocks.named_modules():
            if isinstance(module, nn.Linear):  # maps keep unit variance, and the branches that of the stream
                ends = name.endswith(("proj", "fc2", "modulation_out"))
                std = module.in_features**-0.5 * (branches**-0.5 if ends else 1.0)
                nn.init.normal_(module.weight, std=std)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    def carry(self, rows: int, slots: int, tokens: int, dtype: torch.dtype, device: torch.device) -> Carried:
        """Return the cached keys and values of each layer.

        Those of frames are (2, R, B, N, heads, head_dim); after them, with cross-attention, lie those of
        actions, (2, R, B, heads, head_dim). The values of a frame are contiguous, as computed.
        """
        heads = self.config.heads, self.config.head_dim
        of_layer: list[tuple[int, ...]] = [(2, slots, rows, tokens, *heads)]
        if "cross_attention" in self.config.conditioning:
            of_layer.append((2, slots, rows, *heads))
        shapes = of_layer * self.config.layers
        return Carried([torch.zeros(shape, dtype=dtype, device=device) for shape in shapes], 1, tokens)

    def forward(
        self, x: Tensor, conditioning: Conditioning, times: TimePositions, carried: Carried | None = None
    ) -> Tensor:
        """Map embedded frames to features, as `Trunk.__call__` says."""
        config = self.config
        if conditioning.tokens is not None:
            copies = conditioning.tokens.unsqueeze(2).expand(-1, -1, config.action_tokens, -1)
            x = torch.cat([x, copies.to(x.dtype)], dim=2)
        x = self.embed_norm(x + rows_at(self.position, times.positions)[..., : x.shape[2], :])
        each = 0 if carried is None else len(carried.memory) // config.layers
        for layer, block in enumerate(self.blocks):
            cache = (None, None) if carried is None else carried.memory[layer * each : (layer + 1) * each]
            # After the last layer's keys and values, nothing reads the frames before `wanted`.
            first = times.wanted if layer == config.layers - 1 else 0
            x = self.run_block(block, x, conditioning, layer, times, cache, first)
        return F.pad(self.norm(x), (0, 0, 0, 0, times.wanted, 0)) if times.wanted else self.norm(x)
