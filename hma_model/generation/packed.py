"""Pack a module's linear maps for generation on a CPU: oneDNN's kernels, weights in the order these read.

torch computes float32 products with MKL, which on processors other than Intel's leaves AVX-512 unused: half
the speed or less. oneDNN uses it. With packed weights a row's result also does not depend on the number of
rows beside it, so a sample of a batch gets the bits that it gets alone.

Products in bfloat16 are about twice as fast again where the processor has AVX512-BF16 or AMX, and those in
int8 three times where it has VNNI. The sums are float32 or int32, and all values between the products are
float32. In int8, the inputs of a product share one scale, so a row depends on the rows beside it.
"""

import copy
from typing import Any, cast

import torch
from torch import Tensor, nn

from hma_model.network.linear import has_kernels
from hma_model.network.trunks.transformer import MLP

_OPS: Any = torch.ops.mkldnn


def packs(device: torch.device) -> bool:
    """Check whether packing pays on this device."""
    return device.type == "cpu" and has_kernels()


def has_bfloat16() -> bool:
    """Check whether this processor multiplies bfloat16 itself."""
    return _has("_is_avx512_bf16_supported", "_is_amx_tile_supported")


def has_int8() -> bool:
    """Check whether this processor adds up products of int8 without overflow, and torch has the kernels."""
    return _has("_is_vnni_supported") and "onednn" in torch.backends.quantized.supported_engines


def _has(*names: str) -> bool:
    probes = (getattr(torch.cpu, name, None) for name in names)
    return any(probe() for probe in probes if probe is not None)


class PackedLinear(nn.Module):
    """A copy of a linear map with packed weights.

    Args:
        linear: the map to copy.
        dtype: of the products.
        activation: "none", or "gelu" to apply to the result.
    """

    def __init__(self, linear: nn.Linear, dtype: torch.dtype, activation: str = "none") -> None:
        super().__init__()
        self.in_features, self.out_features = linear.in_features, linear.out_features
        self.dtype, self.activation = dtype, activation
        self.weight = _OPS._reorder_linear_weight(linear.weight.detach().to(dtype).contiguous())
        self.bias = None if linear.bias is None else linear.bias.detach().to(dtype)

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., in) to (..., out) float32."""
        x = x.to(self.dtype).contiguous()  # views of other strides take a path a thousand times slower
        return _OPS._linear_pointwise(x, self.weight, self.bias, self.activation, [], "none").float()


class QuantizedLinear(nn.Module):
    """A copy of a linear map in int8: a scale for each output of the weights, one for all inputs of a call.

    Args:
        linear: the map to copy.
        activation: "none", or "gelu" to apply to the result.
    """

    def __init__(self, linear: nn.Linear, activation: str = "none") -> None:
        super().__init__()
        self.activation = activation
        weight = linear.weight.detach().float()
        scales = weight.abs().amax(1).clamp(min=1e-12) / 127
        zeros = torch.zeros(len(weight), dtype=torch.int64)
        whole = torch.quantize_per_channel(weight, scales, zeros, 0, torch.qint8)
        bias = None if linear.bias is None else linear.bias.detach().float()
        self.weight = torch.ops.quantized.linear_prepack(whole, bias)

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., in) to (..., out) float32."""
        made = torch.ops.quantized.linear_dynamic(x.contiguous(), self.weight, False)
        return nn.functional.gelu(made) if self.activation == "gelu" else made


class PackedMLP(nn.Module):
    """A copy of a trunk's MLP with packed weights."""

    def __init__(self, mlp: MLP, dtype: torch.dtype) -> None:
        super().__init__()
        self.fc1, self.fc2 = _linear(mlp.fc1, dtype, "gelu"), _linear(mlp.fc2, dtype)

    def forward(self, x: Tensor, norm: nn.Module) -> Tensor:
        """Apply `norm` and the two maps to (..., D); keep the shape."""
        return cast(Tensor, self.fc2(self.fc1(norm(x))))


class LowConv(nn.Module):
    """A copy of a convolution whose product is in bfloat16, on weights laid out with the channels last."""

    def __init__(self, conv: nn.Conv2d) -> None:
        super().__init__()
        self.stride, self.padding = conv.stride, cast(tuple[int, int], conv.padding)
        weight = conv.weight.detach().to(torch.bfloat16)
        self.weight = weight.contiguous(memory_format=torch.channels_last)
        self.bias = None if conv.bias is None else conv.bias.detach().to(torch.bfloat16)

    def forward(self, x: Tensor) -> Tensor:
        """Map (M, C, h, w) to float32."""
        x = x.to(torch.bfloat16).contiguous(memory_format=torch.channels_last)
        return nn.functional.conv2d(x, self.weight, self.bias, self.stride, self.padding).float()


def packed[M: nn.Module](module: M, dtype: torch.dtype = torch.float32) -> M:
    """Return a copy of a module for generation, its linear maps packed; all else is shared with it.

    The products are in `dtype`: float32, bfloat16 or qint8. Later changes of the module's weights do not
    reach the copy.
    """
    made = copy.copy(module)
    made._modules = {name: _pack(child, dtype) for name, child in module._modules.items()}
    return made


def _pack(module: nn.Module | None, dtype: torch.dtype) -> nn.Module | None:
    if isinstance(module, nn.Linear):
        return _linear(module, dtype)
    if isinstance(module, nn.Conv2d) and dtype == torch.bfloat16:
        return LowConv(module)
    if isinstance(module, MLP):
        return PackedMLP(module, dtype)
    return None if module is None else packed(module, dtype)


def _linear(linear: nn.Linear, dtype: torch.dtype, activation: str = "none") -> nn.Module:
    if dtype == torch.qint8:
        return QuantizedLinear(linear, activation)
    return PackedLinear(linear, dtype, activation)
