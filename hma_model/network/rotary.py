"""Rotate queries and keys by angles that grow with time (rotary positions, arXiv 2104.09864).

B batch, T frames, N tokens of a frame.
"""

import torch
from torch import Tensor

from hma_model.config import HMAConfig

ROTARY_BASE = 100.0  # ratio of the longest wavelength to the shortest; windows are short


def rotary_angles(config: HMAConfig, positions: Tensor) -> tuple[Tensor, Tensor]:
    """Return cos and sin, float32 (..., head_dim / 2), of the rotary angles at the times (...)."""
    half = max(config.head_dim // 2, 1)
    steps = torch.arange(half, device=positions.device, dtype=torch.float32) / half
    angles = positions.float().unsqueeze(-1) * ROTARY_BASE**-steps
    return angles.cos(), angles.sin()


def rotate(x: Tensor, rotary: tuple[Tensor, Tensor]) -> Tensor:
    """Rotate neighbouring pairs of x (..., T, heads, head_dim) by each frame's angles."""
    cos, sin = (angle.to(x.dtype).unsqueeze(-2) for angle in rotary)
    even, odd = x.unflatten(-1, (-1, 2)).unbind(-1)
    return torch.stack([even * cos - odd * sin, odd * cos + even * sin], dim=-1).flatten(-2)


def turns_of(rotary: tuple[Tensor, Tensor], heads: int, within: bool = False) -> Tensor:
    """Return the rotation that `rotate_qkv` applies, complex (..., T, 3 * heads * head_dim / 2)."""
    cos, sin = (angle.unsqueeze(-2) if within else angle for angle in rotary)
    turn = torch.complex(cos, sin)
    turns = torch.stack([turn, turn, torch.ones_like(turn)], dim=-2).unsqueeze(-2)
    return turns.expand(*turns.shape[:-2], heads, -1).flatten(-3)


def rotate_qkv(
    qkv: Tensor, rotary: tuple[Tensor, Tensor], within: bool = False, turns: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Rotate queries and keys, and return them with the unchanged values.

    Without a compiler to fuse the operations, one complex product over contiguous memory is several times as
    fast.

    Args:
        qkv: (..., T, 3, heads, head_dim), or `within` frames (..., T, N, 3, heads, head_dim).
        rotary: cos and sin (T, head_dim / 2), or (B, T, head_dim / 2).
        within: whether there is an axis of places between the times and the axis of size 3.
        turns: `turns_of` these, if they are at hand.
    """
    if torch.compiler.is_exporting():
        return _rotate_exported(qkv, rotary, within)
    half = qkv.dtype == torch.bfloat16 and qkv.device.type == "cpu"
    if torch.compiler.is_compiling() or not (half or qkv.dtype == torch.float32):
        cos, sin = (angle.unsqueeze(-2) if within else angle for angle in rotary)
        q, k, v = qkv.unbind(-3)
        return rotate(q, (cos, sin)), rotate(k, (cos, sin)), v
    turns = turns_of(rotary, qkv.shape[-2], within) if turns is None else turns
    flat = torch.view_as_complex(qkv.float().view(*qkv.shape[:-3], -1, 2)) * turns
    q, k, v = torch.view_as_real(flat).view_as(qkv).to(qkv.dtype).unbind(-3)
    return q, k, v


def _rotate_exported(
    qkv: Tensor, rotary: tuple[Tensor, Tensor], within: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Do as `rotate_qkv` in few operations: a runtime fuses none, and picks single numbers slowly."""
    size = qkv.shape[-1]
    swap = torch.zeros(size, size)  # a pair (even, odd) becomes (-odd, even)
    swap[1::2, ::2], swap[::2, 1::2] = -torch.eye(size // 2), torch.eye(size // 2)
    cos, sin = (angle.repeat_interleave(2, -1)[..., None, None, :] for angle in rotary)
    if within:
        cos, sin = cos.unsqueeze(-4), sin.unsqueeze(-4)
    both, v = qkv.split([2, 1], dim=-3)
    q, k = (both * cos + both @ swap * sin).unbind(-3)
    return q, k, v.squeeze(-3)
