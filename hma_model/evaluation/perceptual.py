"""Measure LPIPS, FID and FVD of rollouts, with networks that the user has.

    --lpips FILE   AlexNet and the linear layers: the state dict of lpips.LPIPS(net="alex"), or TorchScript
    --fid FILE     Inception: pt_inception-2015-12-05 of pytorch-fid, or NVIDIA's TorchScript
    --fvd FILE     I3D: TorchScript (StyleGAN-V's copy of TensorFlow Hub's), or the state dict of VideoGPT's

Without a file a metric is absent, and `missing` says so. FID compares all predicted frames of a set with all
true ones, FVD the predicted parts of its windows. FVD's videos are scaled to 224 pixels on their short side
and cropped; those of fewer than ten frames are stretched to sixteen by repeating frames.

N pictures or videos, B windows, T frames, S pixels a side, D features.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from hma_data.errors import UsageError
from hma_data.storage.paths import StrPath
from hma_model.evaluation import networks as published
from hma_model.evaluation.frechet import Moments, frechet_distance
from hma_model.evaluation.weights import Weights, open_weights

Images = NDArray[np.uint8]
Network = Callable[[Tensor], Tensor]
SIDE, LEAST, STRETCHED = 224, 10, 16  # pixels of I3D's short side; frames below which a video becomes 16
AT_ONCE = 32  # pictures in a pass
HOW = {
    "lpips": "--lpips FILE#SHA256: the state dict of lpips.LPIPS(net='alex')",
    "fid": "--fid FILE#SHA256: pt_inception-2015-12-05 of pytorch-fid, or its TorchScript of NVIDIA",
    "fvd": "--fvd FILE#SHA256: i3d_torchscript.pt of StyleGAN-V, or i3d_pretrained_400.pt of VideoGPT",
}


@dataclass(frozen=True)
class Networks:
    """The networks that there are.

    Attributes:
        lpips: returns the distance (N,) of pictures (N, S, S, 3) from true ones.
        frames: returns features (N, D) of pictures (N, 3, S, S) of 0 to 255, by the metric's name.
        videos: returns features (N, D) of videos (N, 3, T, 224, 224) of -1 to 1, by the metric's name.
        facts: file and SHA-256 of each, by the metric's name.
    """

    lpips: Callable[[Images, Images], NDArray[np.float64]] | None = None
    frames: dict[str, Network] = field(default_factory=dict)
    videos: dict[str, Network] = field(default_factory=dict)
    facts: dict[str, dict[str, str]] = field(default_factory=dict)


def open_networks(
    lpips: StrPath | None = None, fid: StrPath | None = None, fvd: Sequence[StrPath] = ()
) -> Networks:
    """Open networks, each `FILE#SHA256` (str or path); FVD may have several, one for each protocol.

    Raises:
        UsageError: a file is not there, is not the one of its hash, or is of another network.
    """
    facts: dict[str, dict[str, str]] = {}

    def opened(metric: str, file: StrPath) -> Weights:
        weights = open_weights(file, f"--{metric[:5].rstrip('_')}")
        facts[metric] = {"file": weights.name, "sha256": weights.sha256}
        return weights

    distance = None if lpips is None else _lpips(opened("lpips", lpips))
    frames = {} if fid is None else {"fid": _inception(opened("fid", fid))}
    videos: dict[str, Network] = {}
    for file in fvd:
        weights = open_weights(file, "--fvd")
        name = "fvd" if weights.script else "fvd_videogpt"
        if name in videos:
            raise UsageError("--fvd", f"{file} is a second network of the same protocol", "give one of each")
        facts[name] = {"file": weights.name, "sha256": weights.sha256}
        videos[name] = _i3d(weights)
    return Networks(distance, frames, videos, facts)


def _lpips(weights: Weights) -> Callable[[Images, Images], NDArray[np.float64]]:
    if not weights.script:
        _require(weights, "--lpips", ("net.slice1.0.weight", "lin4.model.1.weight"))

    @torch.no_grad()
    def distance(truth: Images, made: Images) -> NDArray[np.float64]:
        found = []
        for start in range(0, len(truth), AT_ONCE):
            pair = [_channels(part[start : start + AT_ONCE]) / 127.5 - 1 for part in (truth, made)]
            far = weights.script(*pair) if weights.script else published.lpips(weights.tensors, *pair)
            found.append(far.flatten().double().numpy())
        return np.concatenate(found)

    return distance


def _inception(weights: Weights) -> Network:
    if weights.script:
        return partial(_called, weights.script, {"return_features": True})
    _require(weights, "--fid", ("Conv2d_1a_3x3.conv.weight", "Mixed_7c.branch_pool.conv.weight"))
    return lambda pictures: published.inception(weights.tensors, pictures / 255)


def _i3d(weights: Weights) -> Network:
    if weights.script:
        options = {"rescale": False, "resize": False, "return_features": True}
        return partial(_called, weights.script, options)
    _require(weights, "--fvd", ("Conv3d_1a_7x7.conv3d.weight", "logits.conv3d.bias"))
    return partial(published.i3d, weights.tensors)


def _called(script: Any, options: dict[str, bool], x: Tensor) -> Tensor:
    """Call TorchScript with those of the options that it knows; uint8 pictures stay what they are."""
    known = {argument.name for argument in script.forward.schema.arguments}
    found: Tensor = script(x, **{key: value for key, value in options.items() if key in known})
    return found


def _require(weights: Weights, option: str, names: Sequence[str]) -> None:
    if lacking := [name for name in names if name not in weights.tensors]:
        fault = f"{weights.name} holds no {lacking[0]}, so it is another network"
        raise UsageError(option, fault, HOW[option.removeprefix("--")])


def _channels(pictures: Images) -> Tensor:
    """Return pictures (…, H, W, 3) as (N, 3, H, W) float32 of 0 to 255."""
    flat = pictures.reshape(-1, *pictures.shape[-3:])
    return torch.from_numpy(np.ascontiguousarray(flat)).permute(0, 3, 1, 2).float()


def stretched(frames: int) -> NDArray[np.int64]:
    """Return the indices of the frames that I3D sees of a video."""
    if frames >= LEAST:
        return np.arange(frames)
    return np.round(np.linspace(0, frames - 1, STRETCHED)).astype(np.int64)


def as_video(pictures: Tensor) -> Tensor:
    """Scale and crop a video's pictures (T, 3, H, W) of 0 to 255 to (3, T, SIDE, SIDE) of -1 to 1."""
    height, width = pictures.shape[2:]
    scale = SIDE / min(height, width)
    size = [max(SIDE, round(height * scale)), max(SIDE, round(width * scale))]
    large = F.interpolate(pictures, size=size, mode="bilinear", align_corners=False)
    top, left = ((side - SIDE) // 2 for side in size)
    return (large[:, :, top : top + SIDE, left : left + SIDE] / 127.5 - 1).transpose(0, 1)


@dataclass
class Judge:
    """Collects features of the truth and of each kind of rollout, and compares them."""

    networks: Networks
    moments: dict[tuple[str, str], Moments] = field(default_factory=dict)

    @torch.no_grad()
    def add(self, kind: str, pictures: Images) -> None:
        """Add the predicted or true frames (B, T, S, S, 3) of some windows."""
        for metric, network in self.networks.frames.items():
            flat = _channels(pictures)
            found = [network(flat[i : i + AT_ONCE]) for i in range(0, len(flat), AT_ONCE)]
            self._of(metric, kind).add(torch.cat(found).double().numpy())
        for metric, network in self.networks.videos.items():
            chosen = pictures[:, stretched(pictures.shape[1])]
            logits = [network(as_video(_channels(video))[None]) for video in chosen]
            self._of(metric, kind).add(torch.cat(logits).double().numpy())

    def _of(self, metric: str, kind: str) -> Moments:
        return self.moments.setdefault((metric, kind), Moments())

    def figures(self, horizon: int) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
        """Return the distances of each kind of rollout, and in words why a metric is absent.

        Args:
            horizon: predicted frames of a window.
        """
        found: dict[str, dict[str, Any]] = {}
        missing: dict[str, str] = {}
        facts = self.networks.facts
        for metric in ("lpips", "fid", "fvd"):
            if not any(name.startswith(metric) for name in facts):
                missing[metric] = f"not measured, for want of weights: {HOW[metric]}"
        for (metric, kind), own in self.moments.items():
            true = self.moments[metric, "truth"]
            if true.count < true.needed:
                what, a_window = ("frames", horizon) if metric == "fid" else ("videos", 1)
                missing[metric] = (
                    f"not measured: {true.count:,} {what} are too few, its {true.needed - 1:,} features need "
                    f"{true.needed:,}: --windows {-(-true.needed // a_window)} or more"
                )
            elif kind != "truth":
                found.setdefault(kind, {})[metric] = round(frechet_distance(true, own), 4)
        return found, missing
