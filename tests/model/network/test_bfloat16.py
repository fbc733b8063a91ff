"""Attention and rotation in bfloat16 on a CPU, which take other forms than in float32."""

import pytest
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from hma_model.network.rotary import rotate_qkv
from hma_model.network.trunks import transformer
from hma_model.network.trunks.transformer import PRODUCT_KEYS, attend


def _attended(dtype: torch.dtype, length: int, masked: str) -> list[Tensor]:
    drawn = torch.randn(3, 4, 2, length, 16, generator=torch.Generator().manual_seed(1))
    q, k, v = (part.to(dtype).requires_grad_() for part in drawn)
    mask = torch.ones(4, 1, length, length, dtype=torch.bool).tril(3) if masked == "mask" else None
    given = (q, k, v, mask, 0.25, masked == "causal")
    out = checkpoint(attend, *given, use_reentrant=False)  # as in training with checkpointing
    assert out.dtype == dtype
    grads = torch.autograd.grad(out.float().square().sum(), (q, k, v))
    return [out.detach().float(), *(grad.float() for grad in grads)]


@pytest.mark.parametrize("length", [12, PRODUCT_KEYS + 1])
@pytest.mark.parametrize("masked", ["", "causal", "mask"])
def test_attention_agrees_with_float32(length: int, masked: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transformer, "CACHED_SCORES", 3 * length**2)  # eight sequences in three parts
    whole = _attended(torch.float32, length, masked)
    half = _attended(torch.bfloat16, length, masked)
    for exact, near in zip(whole, half, strict=True):
        assert (exact - near).norm() < 0.02 * exact.norm()


def test_rotation_agrees_with_float32() -> None:
    qkv = torch.randn(5, 12, 3, 2, 16, generator=torch.Generator().manual_seed(1))
    angles = torch.randn(12, 8, generator=torch.Generator().manual_seed(2))
    rotary = (angles.cos(), angles.sin())
    for exact, near in zip(rotate_qkv(qkv, rotary), rotate_qkv(qkv.bfloat16(), rotary), strict=True):
        assert near.dtype == torch.bfloat16
        assert (exact - near.float()).norm() < 0.01 * exact.norm()
