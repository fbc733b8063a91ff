"""Take frames to start from, and measure by them what weights in float16 cost.

P frames of a start, H×W pixels, A action dims, K = stride * A.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hma_data.lab.family.table import BlockTable
from hma_data.tokenizers.base import Tokenizer
from hma_data.tokenizers.network import NetworkTokenizer
from hma_model.evaluation.metrics import PSNR_LIMIT, psnr
from hma_model.export.files import rounded
from hma_model.export.truth import table_values
from hma_model.network.model import HMA
from hma_model.worlds.scenes import Drivable, LabScene
from hma_model.worlds.world import World

REPLAY_FRAMES = 60  # true images of a replay, that of the start included
MOST_LOSS_DB = 0.1  # that weights in float16 may cost


@dataclass(frozen=True)
class Start:
    """Frames to start from.

    Attributes:
        frames: (P, h, w) tokens, or (P, c, H, W) latents as stored.
        chunks: (P - 1, K), NaN where they are unknown.
        action: (A,) that leaves the robot as it is.
        image: (H, W, 3) of the last frame.
        replay: (R - 1, K) that the recorder's driver takes from here on; None without a simulator.
        true: (R, H, W, 3) images of the simulator under them, the start's first; None also where the page
            simulates the robot itself.
        table: the state of that simulation.
    """

    frames: NDArray[Any]
    chunks: NDArray[np.float32]
    action: NDArray[np.float32]
    image: NDArray[np.uint8]
    replay: NDArray[np.float32] | None = None
    true: NDArray[np.uint8] | None = None
    table: dict[str, Any] | None = None


def take_starts(world: World, robot: Drivable, count: int) -> list[Start]:
    """Return the first scenes of a robot; a robot that begins from images has only one."""
    name = robot.embodiment.id
    found = []
    for number in range(1 if robot.source == "images" else count):
        scene = robot.scene(number)
        frames = world.encoded(name, scene.prompt.frames)[-world.model.config.frames :]
        chunks = scene.prompt.chunks[len(scene.prompt.chunks) + 1 - len(frames) :]
        session = world.open(name, frames, chunks)
        start = Start(frames, chunks, scene.action, world.image(session))
        if isinstance(scene, LabScene):
            start = _with_truth(start, scene)
        found.append(start)
        world.close(session)
    return found


def _with_truth(start: Start, scene: LabScene) -> Start:
    """Return a start with recorded actions, and with a simulation for the page or true images."""
    simulation = scene.simulator.simulation
    table = table_values(simulation) if isinstance(simulation, BlockTable) else None
    rest = [scene.advance(None) for _ in range(REPLAY_FRAMES - 1)]
    start = replace(start, replay=np.stack([chunk for chunk, _ in rest]), table=table)
    if table is None:
        start = replace(start, true=np.stack([scene.prompt.frames[-1], *(image for _, image in rest)]))
    return start


def round_weights(
    model: HMA, tokenizer: Tokenizer, starts: Mapping[str, Sequence[Start]]
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


def _one_step_psnr(model: HMA, tokenizer: Tokenizer, starts: Mapping[str, Sequence[Start]]) -> float:
    world = World(model, tokenizer, temperature=0.0)
    scores = []
    for name, some in starts.items():
        for start in some:
            session = world.open(name, start.frames[:-1], start.chunks[:-1])
            truth = world.shown(start.frames[-1:])[0]
            made = world.step({session: start.chunks[-1]})[session]
            scores.append(psnr(truth, made, limit=PSNR_LIMIT))
            world.close(session)
    return float(np.mean(scores))
