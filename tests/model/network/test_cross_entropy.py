"""`hma_model.network.cross_entropy` against torch's own operations."""

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st

from hma_model.network import cross_entropy as ours
from hma_model.network.linear import Linear


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
