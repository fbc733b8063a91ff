"""Products by oneDNN, attention in bfloat16 and the cross entropy against plain arithmetic."""

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from hma_model.network import cross_entropy as ours
from hma_model.network import linear as linears
from hma_model.network.linear import Linear, after_gelu, after_norm
from hma_model.network.rotary import rotate_qkv
from hma_model.network.trunks import transformer
from hma_model.network.trunks.transformer import PRODUCT_KEYS, attend
from tests.data.fresh import run_fresh

ROWS, INPUTS, OUTPUTS = (3, 50), 24, 40


def values_and_gradients(function, parameters: list[nn.Parameter], x: Tensor, grad: Tensor) -> list[Tensor]:
    x = x.detach().requires_grad_()
    out = function(x)
    return [out, *torch.autograd.grad(out, [x, *parameters], grad)]


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("before", ["nothing", "norm", "gelu"])
@pytest.mark.parametrize("kernels", [True, False])
def test_values_and_gradients_equal_float64(before, bias, kernels, monkeypatch):
    if kernels and not linears.has_kernels():
        pytest.skip("this platform has no AVX-512")
    monkeypatch.setattr(linears, "has_kernels", lambda: kernels)
    torch.manual_seed(0)
    linear, norm = Linear(INPUTS, OUTPUTS, bias=bias), nn.LayerNorm(INPUTS)
    nn.init.normal_(norm.weight)
    nn.init.normal_(norm.bias)
    # of other strides than its shape's
    x, grad = torch.randn(*ROWS[::-1], INPUTS).transpose(0, 1), torch.randn(*ROWS, OUTPUTS)
    ours = {
        "nothing": linear,
        "norm": lambda x: after_norm(norm, linear, x),
        "gelu": lambda x: after_gelu(linear, x),
    }
    used = [*linear.parameters(), *(norm.parameters() if before == "norm" else [])]
    found = values_and_gradients(ours[before], used, x, grad)

    exact, exact_norm = nn.Linear(INPUTS, OUTPUTS, bias=bias).double(), nn.LayerNorm(INPUTS).double()
    exact.load_state_dict(linear.state_dict())
    exact_norm.load_state_dict(norm.state_dict())
    prepared = {"nothing": lambda x: x, "norm": exact_norm, "gelu": F.gelu}
    used = [*exact.parameters(), *(exact_norm.parameters() if before == "norm" else [])]
    wanted = values_and_gradients(lambda x: exact(prepared[before](x)), used, x.double(), grad.double())
    for value, reference in zip(found, wanted, strict=True):
        torch.testing.assert_close(value.double(), reference, rtol=1e-4, atol=1e-4)


def test_frozen_weights_and_autocast():
    linear = Linear(INPUTS, OUTPUTS)
    linear.requires_grad_(False)
    x = torch.randn(100, INPUTS, requires_grad=True)
    linear(x).sum().backward()
    torch.testing.assert_close(x.grad, linear.weight.sum(0).expand_as(x), rtol=1e-4, atol=1e-4)
    with torch.autocast("cpu", torch.bfloat16):
        assert linear(x).dtype == torch.bfloat16


KEPT = """
import os
import hma_model.network.linear
assert os.environ["ONEDNN_PRIMITIVE_CACHE_CAPACITY"] == "64"
"""


@pytest.mark.slow
def test_few_products_are_kept(monkeypatch):
    monkeypatch.delenv("ONEDNN_PRIMITIVE_CACHE_CAPACITY", raising=False)
    run_fresh(KEPT)


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


@pytest.mark.parametrize(("dtype", "error"), [(torch.float32, 1e-6), (torch.bfloat16, 0.01)])
def test_the_fast_rotation_agrees_with_the_plain_one_in_float64(dtype, error) -> None:
    qkv = torch.randn(5, 12, 3, 2, 16, generator=torch.Generator().manual_seed(1))
    angles = torch.randn(12, 8, generator=torch.Generator().manual_seed(2))
    rotary = (angles.cos(), angles.sin())
    for exact, near in zip(rotate_qkv(qkv.double(), rotary), rotate_qkv(qkv.to(dtype), rotary), strict=True):
        assert near.dtype == dtype
        assert (exact - near.double()).norm() < error * exact.norm()


def torchs(features, linear, gains, before, digits):
    scores = linear(features).float().unflatten(-1, (digits.shape[1], -1))
    if gains is not None:
        scores = scores.scatter_add(-1, before.unsqueeze(-1), gains.unsqueeze(-1))
    losses = F.cross_entropy(scores.flatten(0, 1), digits.flatten(), reduction="none")
    return losses.view(digits.shape).sum(1)


def case(rows, digits, values, gained=True):
    generator = torch.Generator().manual_seed(rows * 100 + values)
    linear = Linear(8, digits * values)
    with torch.no_grad():
        linear.weight.normal_(generator=generator)
        linear.bias.normal_(generator=generator)
    features = torch.randn(rows, 8, generator=generator, requires_grad=True)
    gains = torch.randn(rows, digits, generator=generator, requires_grad=True) if gained else None
    draws = torch.randint(values, (2, rows, digits), generator=generator)
    return features, linear, gains, *draws


def graded(function, features, linear, gains, before, digits):
    """Return the losses, and the gradients of a sum in which each row weighs differently."""
    losses = function(features, linear, gains, before, digits)
    inputs = [features, linear.weight, linear.bias, *([] if gains is None else [gains])]
    weights = torch.linspace(-1, 2, len(features))
    return losses.detach(), *torch.autograd.grad((losses * weights).sum(), inputs)


@given(
    rows=st.integers(1, 2 * ours.ROWS + 3),
    digits=st.integers(1, 4),
    values=st.integers(2, 9),
    gained=st.booleans(),
)
def test_losses_and_gradients_are_torchs(rows, digits, values, gained):
    given_case = case(rows, digits, values, gained)
    for made, expected in zip(
        graded(ours.cross_entropy, *given_case), graded(torchs, *given_case), strict=True
    ):
        torch.testing.assert_close(made, expected, rtol=1e-4, atol=1e-4)


def test_under_autocast_products_are_bf16_and_losses_float32():
    given_case = case(700, 4, 255)
    with torch.autocast("cpu", torch.bfloat16):
        made, expected = graded(ours.cross_entropy, *given_case), graded(torchs, *given_case)
    exact = graded(torchs, *given_case)
    for ours_, torchs_, right in zip(made, expected, exact, strict=True):
        assert ours_.dtype == torch.float32
        assert (ours_ - right).norm() <= 1.5 * (torchs_ - right).norm() + 1e-4 * right.norm()


def test_scores_of_any_size_give_finite_losses():
    features, linear, gains, before, digits = case(5, 2, 7)
    losses = graded(ours.cross_entropy, features * 1e4, linear, gains, before, digits)
    assert all(each.isfinite().all() for each in losses)


@pytest.mark.parametrize("change", ["another class", "half", "compiled"])
def test_other_maps_are_left_to_torch(change, monkeypatch):
    features, linear, *_ = case(3, 2, 7)
    assert ours.has_kernel(linear, features)
    if change == "another class":
        linear = torch.nn.Linear(8, 14)
    elif change == "half":
        linear = linear.bfloat16()
    else:
        monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    assert not ours.has_kernel(linear, features)
