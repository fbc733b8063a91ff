"""Products by oneDNN against float64 arithmetic."""

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hma_model.network import linear as linears
from hma_model.network.linear import Linear, after_gelu, after_norm
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
import os, sys
import hma_model.network.linear
assert os.environ["ONEDNN_PRIMITIVE_CACHE_CAPACITY"] == sys.argv[1]
"""


@pytest.mark.slow
@pytest.mark.parametrize("given", [None, "7"])
def test_few_products_are_kept_unless_the_user_says_otherwise(given, monkeypatch):
    monkeypatch.delenv("ONEDNN_PRIMITIVE_CACHE_CAPACITY", raising=False)
    if given:
        monkeypatch.setenv("ONEDNN_PRIMITIVE_CACHE_CAPACITY", given)
    run_fresh(KEPT, given or "64")
