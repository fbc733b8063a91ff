"""Decoding what a model predicts."""

import numpy as np
import pytest
import torch

from hma_data.tokenizers.base import get_tokenizer
from hma_model.generation.decode import decode


class OnGPU(torch.Tensor):
    """A tensor that says that it is not on the CPU."""

    is_cpu = False


@pytest.mark.parametrize("name", ["fsq-8", "vae-8"])
def test_frames_on_a_gpu_are_decoded_there_to_the_same_pictures(name, monkeypatch) -> None:
    tokenizer = get_tokenizer(name)
    cells = tokenizer.spec.image_size // 16
    small = np.random.default_rng(0).integers(0, 256, (6, cells, cells, 3), np.uint8)
    pictures = small.repeat(16, axis=1).repeat(16, axis=2)
    stored = np.concatenate([tokenizer.encode(pictures), tokenizer.encode(255 - pictures)], axis=-2)
    values = torch.from_numpy(stored.astype(np.int64 if name == "fsq-8" else np.float32))
    frames = values.unflatten(0, (2, 3))
    wanted = decode(tokenizer, frames)
    monkeypatch.setattr(tokenizer, "decode", None)
    monkeypatch.setattr(tokenizer, "batch", 4)
    made = decode(tokenizer, frames.as_subclass(OnGPU))  # type: ignore[arg-type]
    assert made.shape == wanted.shape == (2, 3, 16 * cells, 32 * cells, 3)
    assert np.abs(made.astype(int) - wanted).max() <= 1
