"""Run the networks of LPIPS, FID and FVD from their published tensors.

Each network is a function of its input and the tensors of its state dict, so that a layer is what the file
says. The layouts are those of the packages lpips (AlexNet), pytorch-fid and pytorch-i3d; the last is also
that of VideoGPT's FVD.

N pictures or videos, C channels, T frames, H×W pixels.
"""

from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

Tensors = Mapping[str, Tensor]
NORM_EPS = 1e-3  # of batch norms, in Inception and I3D

# -- LPIPS

ALEXNET = (  # layer, stride, padding, and whether a 3×3 pool of stride 2 is before it
    ("slice1.0", 4, 2, False),
    ("slice2.3", 1, 2, True),
    ("slice3.6", 1, 1, True),
    ("slice4.8", 1, 1, False),
    ("slice5.10", 1, 1, False),
)
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)


def lpips(tensors: Tensors, one: Tensor, other: Tensor) -> Tensor:
    """Return the LPIPS distance (N,) of pictures (N, 3, H, W) of -1 to 1 (Zhang et al. 2018, v0.1)."""
    total = torch.zeros(len(one))
    for level, (a, b) in enumerate(zip(_alexnet(tensors, one), _alexnet(tensors, other), strict=True)):
        apart = (_unit(a) - _unit(b)).square()
        weights = tensors[f"lin{level}.model.1.weight"]
        total = total + F.conv2d(apart, weights).mean(dim=(1, 2, 3))
    return total


def _alexnet(tensors: Tensors, x: Tensor) -> list[Tensor]:
    shift, scale = (torch.tensor(values).view(1, 3, 1, 1) for values in (SHIFT, SCALE))
    x, levels = (x - shift) / scale, []
    for name, stride, padding, pooled in ALEXNET:
        x = F.max_pool2d(x, 3, 2) if pooled else x
        weight, bias = tensors[f"net.{name}.weight"], tensors[f"net.{name}.bias"]
        x = F.conv2d(x, weight, bias, stride, padding).relu()
        levels.append(x)
    return levels


def _unit(x: Tensor) -> Tensor:
    return x / (x.square().sum(dim=1, keepdim=True).sqrt() + 1e-10)


# -- FID


class _Inception:
    """The layers of pytorch-fid's Inception: convolution, batch norm and ReLU, by name."""

    def __init__(self, tensors: Tensors) -> None:
        self.tensors = tensors

    def __call__(self, x: Tensor, *names: str, stride: int = 1, same: bool = True) -> Tensor:
        """Apply layers; only the last has the stride, and is not padded unless `same`."""
        for name in names:
            last, weight = name == names[-1], self.tensors[f"{name}.conv.weight"]
            padding = [(k - 1) // 2 if same or not last else 0 for k in weight.shape[2:]]
            x = F.conv2d(x, weight, stride=stride if last else 1, padding=padding)
            x = _normed(x, self.tensors, f"{name}.bn").relu()
        return x


def inception(tensors: Tensors, pictures: Tensor) -> Tensor:
    """Return the pool features (N, 2048) of pictures (N, 3, H, W) of 0 to 1, as pytorch-fid computes them."""
    net = _Inception(tensors)
    x = 2 * F.interpolate(pictures, size=(299, 299), mode="bilinear", align_corners=False) - 1
    x = net(x, "Conv2d_1a_3x3", stride=2, same=False)
    x = net(net(x, "Conv2d_2a_3x3", same=False), "Conv2d_2b_3x3")
    x = net(F.max_pool2d(x, 3, 2), "Conv2d_3b_1x1")
    x = F.max_pool2d(net(x, "Conv2d_4a_3x3", same=False), 3, 2)
    for name in ("Mixed_5b", "Mixed_5c", "Mixed_5d"):
        x = _branches(net, x, name, [("branch1x1",), ("branch5x5_1", "branch5x5_2"), _numbered("3x3dbl", 3)])
    x = _reduced(net, x, "Mixed_6a", [("branch3x3",), _numbered("3x3dbl", 3)])
    for name in ("Mixed_6b", "Mixed_6c", "Mixed_6d", "Mixed_6e"):
        x = _branches(net, x, name, [("branch1x1",), _numbered("7x7", 3), _numbered("7x7dbl", 5)])
    x = _reduced(net, x, "Mixed_7a", [_numbered("3x3", 2), _numbered("7x7x3", 4)])
    for name in ("Mixed_7b", "Mixed_7c"):
        x = _spread(net, x, name, last=name == "Mixed_7c")
    return x.mean(dim=(2, 3))


def _numbered(branch: str, count: int) -> tuple[str, ...]:
    return tuple(f"branch{branch}_{number + 1}" for number in range(count))


def _branches(net: _Inception, x: Tensor, name: str, branches: Sequence[tuple[str, ...]]) -> Tensor:
    parts = [net(x, *(f"{name}.{layer}" for layer in layers)) for layers in branches]
    return torch.cat([*parts, net(_mean(x), f"{name}.branch_pool")], dim=1)


def _reduced(net: _Inception, x: Tensor, name: str, branches: Sequence[tuple[str, ...]]) -> Tensor:
    parts = [net(x, *(f"{name}.{layer}" for layer in layers), stride=2, same=False) for layers in branches]
    return torch.cat([*parts, F.max_pool2d(x, 3, 2)], dim=1)


def _spread(net: _Inception, x: Tensor, name: str, last: bool) -> Tensor:
    """Apply a block whose branches end in pairs; the last one pools by the maximum, as TensorFlow's did."""
    middle = net(x, f"{name}.branch3x3_1")
    double = net(x, f"{name}.branch3x3dbl_1", f"{name}.branch3x3dbl_2")
    pooled = F.max_pool2d(x, 3, 1, 1) if last else _mean(x)
    parts = [
        net(x, f"{name}.branch1x1"),
        *(net(middle, f"{name}.branch3x3_{end}") for end in ("2a", "2b")),
        *(net(double, f"{name}.branch3x3dbl_{end}") for end in ("3a", "3b")),
        net(pooled, f"{name}.branch_pool"),
    ]
    return torch.cat(parts, dim=1)


def _mean(x: Tensor) -> Tensor:
    return F.avg_pool2d(x, 3, 1, 1, count_include_pad=False)


# -- FVD


def i3d(tensors: Tensors, videos: Tensor) -> Tensor:
    """Return the logits (N, 400) of videos (N, 3, T, 224, 224) of -1 to 1 (Carreira and Zisserman 2017)."""
    x = _unit3d(tensors, videos, "Conv3d_1a_7x7", 2)
    x = _unit3d(tensors, _pool3d(x, (1, 3, 3), (1, 2, 2)), "Conv3d_2b_1x1")
    x = _pool3d(_unit3d(tensors, x, "Conv3d_2c_3x3"), (1, 3, 3), (1, 2, 2))
    for name in ("3b", "3c", "4b", "4c", "4d", "4e", "4f", "5b", "5c"):
        if name in ("4b", "5b"):
            size = (3, 3, 3) if name == "4b" else (2, 2, 2)
            x = _pool3d(x, size, (2, 2, 2))
        x = _mixed(tensors, x, f"Mixed_{name}")
    x = F.avg_pool3d(x, (2, 7, 7), 1)
    logits = F.conv3d(x, tensors["logits.conv3d.weight"], tensors["logits.conv3d.bias"])
    return logits.mean(dim=(2, 3, 4))


def _mixed(tensors: Tensors, x: Tensor, name: str) -> Tensor:
    parts = [_unit3d(tensors, x, f"{name}.b0")]
    for branch in ("b1", "b2"):
        parts.append(_unit3d(tensors, _unit3d(tensors, x, f"{name}.{branch}a"), f"{name}.{branch}b"))
    parts.append(_unit3d(tensors, _pool3d(x, (3, 3, 3), (1, 1, 1)), f"{name}.b3b"))
    return torch.cat(parts, dim=1)


def _unit3d(tensors: Tensors, x: Tensor, name: str, stride: int = 1) -> Tensor:
    weight = tensors[f"{name}.conv3d.weight"]
    x = F.conv3d(_same(x, weight.shape[2:], (stride,) * 3), weight, stride=stride)
    return _normed(x, tensors, f"{name}.bn").relu()


def _pool3d(x: Tensor, size: Sequence[int], stride: Sequence[int]) -> Tensor:
    return F.max_pool3d(_same(x, size, stride), tuple(size), tuple(stride))


def _same(x: Tensor, size: Sequence[int], stride: Sequence[int]) -> Tensor:
    """Pad with zeros as TensorFlow's SAME does, to ceil(length / stride) places; the end gets more."""
    padding: list[int] = []
    for length, k, s in zip(reversed(x.shape[2:]), reversed(size), reversed(stride), strict=True):
        whole = max((-(-length // s) - 1) * s + k - length, 0)
        padding += [whole // 2, whole - whole // 2]
    return F.pad(x, padding)


def _normed(x: Tensor, tensors: Tensors, name: str) -> Tensor:
    mean, var, weight, bias = (
        tensors[f"{name}.{part}"] for part in ("running_mean", "running_var", "weight", "bias")
    )
    return F.batch_norm(x, mean, var, weight, bias, eps=NORM_EPS)
