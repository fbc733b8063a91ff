"""Tiny untrained checkpoints of both trunks, and a driver of exported graphs in onnxruntime."""

import json
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray

from hma_data.lab import family
from hma_data.tokenizers.shapes import get_spec
from hma_model.checkpoint import io as checkpoint
from hma_model.config import HMAConfig
from hma_model.generation.unmask import masked_after
from hma_model.network.model import HMA
from tests.model.network.test_unet import COLORS, PIXELS
from tests.model.true_world import _of_robot, tiny_model

ROBOT = "rails_03"


def save_tokens(folder: Path) -> Path:
    return _save(tiny_model(ROBOT), folder)


def save_pixels(folder: Path) -> Path:
    spec = get_spec("raw-64")
    return _save_unet(folder, {**PIXELS, "grid": spec.grid, "patch": 8, "tokenizer": spec.to_json()})


def save_colors(folder: Path) -> Path:
    spec = get_spec("palette-64")
    values = {**COLORS, "grid": spec.grid, "factored": spec.factored, "tokenizer": spec.to_json()}
    return _save_unet(folder, values)


def _save_unet(folder: Path, values: dict[str, Any]) -> Path:
    torch.manual_seed(0)
    model = _of_robot(HMA(HMAConfig(**values)), family.embodiment(ROBOT), False)
    for name, parameter in model.named_parameters():
        if name.endswith(("conv2.weight", "proj.weight")):
            torch.nn.init.normal_(parameter, std=0.05)
        elif name == "readout.linear.weight":  # decided scores; else one middle colour is taken everywhere
            torch.nn.init.normal_(parameter, std=2.0)
    return _save(model, folder)


def _save(model: HMA, folder: Path) -> Path:
    space = model.embodiments[ROBOT]
    low, high = family.Body.of(ROBOT).ranges
    ends = {"min": low.tolist(), "max": high.tolist()}
    stats = {ROBOT: {"action": {"mean": list(space.mean), "std": list(space.std), **ends}}}
    yaml = {ROBOT: family.embodiment(ROBOT).to_yaml()}
    checkpoint.save(model, folder, embodiment_yaml=yaml, stats=stats, cards={})
    return folder


class Driver:
    """An exported robot in onnxruntime, begun from one of its starts.

    Attributes:
        about: the manifest.
        frames, chunks: of the start.
        state: of the step.
    """

    def __init__(self, folder: Path, robot: str, start: int = 0, threads: int = 1) -> None:
        self.about = json.loads((folder / "manifest.json").read_text())
        (self.robot,) = [one for one in self.about["robots"] if one["id"] == robot]
        settings = onnxruntime.SessionOptions()
        settings.intra_op_num_threads, settings.log_severity_level = threads, 3
        self.stem, self.step = (
            onnxruntime.InferenceSession(folder / part["file"], settings)
            for part in (self.robot["stem"], self.about["step"])
        )
        self.frames = np.load(folder / self.robot["frames"])[start]
        self.chunks = np.load(folder / self.robot["chunks"])[start]
        self.begin(self.draws(np.random.default_rng(0)))

    def begin(self, draws: dict[str, NDArray[Any]]) -> None:
        self.state = {one["name"]: np.zeros(one["shape"], one["dtype"]) for one in self.about["state"]}
        self._before = np.full(self.chunks.shape[1], np.nan, np.float32)
        for frame, chunk in zip(self.frames, self.chunks):
            self.put(frame)
            self.advance(chunk, draws)
        self.put(self.frames[-1])

    def put(self, frame: NDArray[Any]) -> None:
        self.state["frame"] = frame.astype(self.state["frame"].dtype)

    def draws(self, generator: np.random.Generator) -> dict[str, NDArray[Any]]:
        made = {
            one["name"]: getattr(generator, one["law"])(size=one["shape"]).astype(np.float32)
            for one in self.about["draws"]
        }
        if self.about["temperature"] is not None:
            made["temperature"] = np.zeros((), np.float32)
        return made

    def advance(self, chunk: NDArray[Any], draws: dict[str, NDArray[Any]]) -> NDArray[np.uint8]:
        (actions,) = self.stem.run(None, {"chunks": np.stack([self._before, chunk])})
        image, *after = self.step.run(None, {"actions": actions, **self.state, **draws})
        self.uncertainty = float(after.pop()[0]) if len(after) > len(self.state) else float("nan")
        self.state, self._before = dict(zip(self.state, after, strict=True)), chunk
        return image


def drawn_as_torch(driver: Driver, config: HMAConfig, seed: int) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield for each frame the numbers that a row of `Rollout` draws from its seed at temperature 0."""
    generator, tokens = torch.Generator().manual_seed(seed), config.tokens_per_frame
    plain = driver.draws(np.random.default_rng(0))
    while True:
        made = dict(plain)
        rank = torch.rand(1, tokens, generator=generator)  # it is drawn even where it is not used
        if "rank" in made:
            made["rank"] = rank.numpy()
        if config.kind == "continuous" and "noise" in made:
            left = [tokens, *(masked_after(step, 2, tokens) for step in range(2))]
            parts = [before - after for before, after in pairwise(left)]
            noise = [torch.randn(count, config.patch_dim, generator=generator) for count in parts]
            made["noise"] = torch.cat(noise).numpy()
        yield made
