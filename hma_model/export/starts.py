"""Take frames to start from, and measure by them what weights in float16 cost.

P frames of a start, H×W pixels, A action dims, K = stride * A.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from hma_data.tokenizers.network import NetworkTokenizer
from hma_model.export.files import rounded
from hma_model.play.session import psnr
from hma_model.worlds.scenes import Drivable
from hma_model.worlds.world import World

if TYPE_CHECKING:
    from hma_data.tokenizers.base import Tokenizer
    from hma_model.network.model import HMA

MOST_LOSS_DB = 0.1  # that weights in float16 may cost


@dataclass(frozen=True)
class Start:
    """Frames to start from.

    Attributes:
        frames: (P, h, w) tokens, or (P, c, H, W) latents as stored.
        chunks: (P - 1, K), NaN where they are unknown.
        action: (A,) that leaves the robot as it is.
        image: (H, W, 3) of the last frame.
    """

    frames: NDArray[Any]
    chunks: NDArray[np.float32]
    action: NDArray[np.float32]
    image: NDArray[np.uint8]


def take_starts(world: World, robot: Drivable, count: int) -> list[Start]:
    """Return the first scenes of a robot; a robot that begins from images has only one."""
    name = robot.embodiment.id
    found = []
    for number in range(1 if robot.source == "images" else count):
        scene = robot.scene(number)
        frames = world.encoded(name, scene.prompt.frames)[-world.model.config.frames :]
        chunks = scene.prompt.chunks[len(scene.prompt.chunks) + 1 - len(frames) :]
        session = world.open(name, frames, chunks)
        found.append(Start(frames, chunks, scene.action, world.image(session)))
        world.close(session)
    return found


def round_weights(
    model: "HMA", tokenizer: "Tokenizer", starts: Mapping[str, Sequence[Start]]
) -> tuple[float, bool]:
    """Round the weights to float16 unless that costs too much; return the loss in dB, and whether they are.

    The loss is that of the PSNR of the last frame of each start, predicted from the frames before it.
    """
    modules = [model, *([tokenizer.network] if isinstance(tokenizer, NetworkTokenizer) else [])]
    kept = [[parameter.detach().clone() for parameter in module.parameters()] for module in modules]
    before = _one_step_psnr(model, tokenizer, starts)
    for module in modules:
        rounded(module)
    loss = round(before - _one_step_psnr(model, tokenizer, starts), 3)
    if loss < MOST_LOSS_DB:
        return loss, True
    with torch.no_grad():
        for module, values in zip(modules, kept, strict=True):
            for parameter, value in zip(module.parameters(), values, strict=True):
                parameter.copy_(value)
    return loss, False


def _one_step_psnr(model: "HMA", tokenizer: "Tokenizer", starts: Mapping[str, Sequence[Start]]) -> float:
    world = World(model, tokenizer, temperature=0.0)
    scores = []
    for name, some in starts.items():
        for start in some:
            session = world.open(name, start.frames[:-1], start.chunks[:-1])
            truth = world.shown(start.frames[-1:])[0]
            scores.append(psnr(world.step({session: start.chunks[-1]})[session], truth))
            world.close(session)
    return float(np.mean(scores))
