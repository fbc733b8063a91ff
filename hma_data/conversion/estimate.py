"""Estimate the size and the time of a conversion from its plan and from one episode that is tokenized."""

import math
import time
from dataclasses import dataclass

import numpy as np

from hma_data.conversion.plan import Plan
from hma_data.episodes.align import to_clip
from hma_data.episodes.images import prepare
from hma_data.errors import HMAError
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import open_source
from hma_data.storage.paths import StrPath
from hma_data.tokenizers.base import Tokenizer, TokenizerSpec

FRAMES, TRIED = 64, 5  # pictures tokenized, episodes tried


@dataclass(frozen=True)
class Estimate:
    """The estimated size and time of a conversion.

    Attributes:
        bytes: of all shards.
        frames_per_second: of one worker, decoding included; None when no episode could be read.
        seconds: in all, with the requested number of workers; None when no episode could be read.
        fault: why no episode could be read.
    """

    bytes: int
    frames_per_second: float | None
    seconds: float | None
    fault: str = ""


def estimate(
    plan: Plan, uri: StrPath, embodiment: Embodiment, tokenizer: Tokenizer, workers: int
) -> Estimate:
    """Estimate a conversion: tokenize some frames of the first readable episode, and scale up."""
    stride = plan.facts["frame_stride"]
    cameras = plan.facts["cameras"]
    rows = plan.frames // stride * len(cameras)
    size = int(rows * bytes_a_row(tokenizer.spec, embodiment, stride))
    source = open_source(embodiment.source.format)
    fault = ""
    for _, ref in [item for unit in plan.units for item in unit.episodes][:TRIED]:
        try:
            begun = time.monotonic()
            clip = to_clip(source.read(uri, ref.id, embodiment), embodiment)
            camera = embodiment.camera(cameras[0])
            kept = np.arange(0, len(clip), stride)[:FRAMES]
            raw = clip.frames_at(camera.name, kept)
            tokenizer.encode(prepare(raw, camera, tokenizer.spec.image_size, tokenizer.spec.resize_filter))
            rate = len(kept) / (time.monotonic() - begun)
            return Estimate(size, rate, rows / rate / max(workers, 1))
        except HMAError as refused:
            fault = str(refused)
    return Estimate(size, None, None, fault)


def bytes_a_row(spec: TokenizerSpec, embodiment: Embodiment, stride: int) -> float:
    """Return the bytes of one row.

    Tokens count with log2 of the vocabulary's size, latents and pixels with the size of their dtype, and
    numbers with 4 bytes each.
    """
    h, w = spec.grid
    if spec.kind == "discrete":
        picture = h * w * math.ceil(math.log2(spec.vocab_size or 2)) / 8
    else:
        picture = h * w * (spec.channels or 1) * np.dtype(spec.dtype).itemsize
    state = embodiment.state.dims if embodiment.state else 0
    return picture + 4 * (stride * embodiment.action_dim + state)
