"""Compute linear maps, and what precedes them, with the kernels that suit the processor.

torch computes float32 products on a CPU with MKL, which on processors other than Intel's leaves AVX-512
unused. oneDNN, which torch brings as well, uses it: twice the speed forward and for the gradient of the
inputs, 1.6 times for that of the weights. Elsewhere (GPUs, other types, few rows, inside a compiler) these
are products as torch computes them.

oneDNN keeps the code of the last 1,024 products of different shapes, some 5 MB each. Training on a mixture
has another number of windows of each robot in each step, so all are used; of 64, none is missed.

M rows, I inputs, O outputs.
"""

import os
from collections.abc import Callable
from functools import cache
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

_DNN: Any = torch.ops.mkldnn
_ATEN: Any = torch.ops.aten
ROWS = 64  # with fewer rows the calls cost more than the kernels save

os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "64")  # read at the first product


@cache
def has_kernels() -> bool:
    """Check whether oneDNN's float32 kernels are there and use AVX-512."""
    there = torch.backends.mkldnn.is_available() and hasattr(_DNN, "_linear_pointwise")
    wide: bool = torch.backends.cpu.get_cpu_capability() == "AVX512"
    return there and wide and hasattr(_ATEN, "mkldnn_linear_backward_weights")


class Linear(nn.Linear):
    """A linear map; its state is that of `torch.nn.Linear`."""

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., I) to (..., O)."""
        if _suits_onednn(self, x):
            made: Tensor = _Product.apply(x, self.weight, self.bias, False)
            return made
        return super().forward(x)


def after_norm(norm: nn.Module, linear: nn.Module, x: Tensor) -> Tensor:
    """Apply a norm and a linear map to (..., I); the backward pass recomputes the norm."""
    if isinstance(norm, nn.LayerNorm) and _suits_onednn(linear, x):
        made: Tensor = _NormProduct.apply(x, norm.weight, norm.bias, norm.eps, linear.weight, linear.bias)
        return made
    return recomputed(linear, lambda x: linear(norm(x)), x)


def after_gelu(linear: nn.Module, x: Tensor) -> Tensor:
    """Apply a GELU and a linear map to (..., I); the backward pass recomputes the GELU."""
    if _suits_onednn(linear, x):
        made: Tensor = _Product.apply(x, linear.weight, linear.bias, True)
        return made
    return recomputed(linear, lambda x: linear(F.gelu(x)), x)


def recomputed(linear: nn.Module | None, function: Callable[..., Tensor], x: Tensor, *others: Any) -> Tensor:
    """Call a function of (..., I) that ends in a linear map, and keep only its inputs for the backward pass.

    The backward pass recomputes the operations before the product. It does not recompute the product, because
    the recomputation stops once all tensors for the backward pass exist. With oneDNN it would; so there all
    tensors are kept.
    """
    if not torch.is_grad_enabled() or (linear is not None and _suits_onednn(linear, x)):
        return function(x, *others)
    out: Tensor = checkpoint(function, x, *others, use_reentrant=False, preserve_rng_state=False)
    return out


def is_whole(linear: nn.Module) -> bool:
    """Check whether a map is one of float32 that is all here, and computes what `Linear` says."""
    if not isinstance(linear, Linear) or linear.weight.dtype != torch.float32:
        return False
    return type(linear.weight) is nn.Parameter  # FSDP's shards are of another type


def product(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Map (M, I) by a weight (O, I) and a bias (O,), float32 on a CPU, without autograd."""
    return _product(x, weight, bias) if has_kernels() else F.linear(x, weight, bias)


def _suits_onednn(linear: nn.Module, x: Tensor) -> bool:
    if torch.compiler.is_compiling() or torch.is_autocast_enabled("cpu"):
        return False
    if x.device.type != "cpu" or x.dtype != torch.float32 or x.numel() < ROWS * x.shape[-1]:
        return False
    return is_whole(linear) and has_kernels()


def _product(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    # views of other strides take a path a thousand times slower
    made: Tensor = _DNN._linear_pointwise(x.contiguous(), weight.contiguous(), bias, "none", [], "none")
    return made


def _weight_grads(grad: Tensor, x: Tensor, weight: Tensor, biased: bool) -> tuple[Tensor, Tensor | None]:
    """Return the gradients of a map's weight (O, I) and bias (O,), given those (M, O) of its outputs."""
    rows = (each.reshape(-1, each.shape[-1]).to_mkldnn() for each in (grad, x))
    of_weight, of_bias = _ATEN.mkldnn_linear_backward_weights(*rows, weight, biased)
    return of_weight.to_dense(), of_bias.to_dense() if biased else None


class _Product(torch.autograd.Function):
    """A product, and with `gelu` the GELU before it, which the backward pass computes again."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor | None, gelu: bool) -> Tensor:
        ctx.save_for_backward(x, weight)
        ctx.biased, ctx.gelu = bias is not None, gelu
        return _product(F.gelu(x) if gelu else x, weight, bias)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:
        x, weight = ctx.saved_tensors
        grad = grad.contiguous()
        of_x = _product(grad, weight.t()) if ctx.needs_input_grad[0] else None
        if ctx.gelu and of_x is not None:
            of_x = _ATEN.gelu_backward(of_x, x)
        if not ctx.needs_input_grad[1]:
            return of_x, None, None, None
        return of_x, *_weight_grads(grad, F.gelu(x) if ctx.gelu else x, weight, ctx.biased), None


class _NormProduct(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, x: Tensor, gain: Tensor, shift: Tensor, eps: float, weight: Tensor, bias: Tensor | None
    ) -> Tensor:
        normed, mean, inverse = torch.native_layer_norm(x, x.shape[-1:], gain, shift, eps)
        ctx.save_for_backward(x, gain, shift, mean, inverse, weight)
        ctx.biased, ctx.eps = bias is not None, eps
        return _product(normed, weight, bias)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:
        x, gain, shift, mean, inverse, weight = ctx.saved_tensors
        grad, needs = grad.contiguous(), ctx.needs_input_grad
        of_normed = _product(grad, weight.t())
        of_x, of_gain, of_shift = _ATEN.native_layer_norm_backward(
            of_normed, x, x.shape[-1:], mean, inverse, gain, shift, list(needs[:3])
        )
        if not needs[4]:
            return of_x, of_gain, of_shift, None, None, None
        normed = F.layer_norm(x, x.shape[-1:], gain, shift, ctx.eps)
        return of_x, of_gain, of_shift, None, *_weight_grads(grad, normed, weight, ctx.biased)
