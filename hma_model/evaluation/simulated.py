"""Measure on a laboratory robot whether the model does what its actions say: `hma evaluate --state`.

The simulator makes true episodes with states, and the model rolls out from their first frames. A probe reads
where the robot's parts are in its pictures, and the distance from the truth is the error, in px of a picture
of 128, at each step of the horizon. Beside it stand the probe's own error and the same error of the true
pictures as the tokenizer shows them.

PSNR* and perplexity* are the paper's (table 4): the actions after the prompt are perturbed, the simulator
answers the perturbed actions, and the model is compared with that answer.

B episodes, T frames, P predicted frames, S pixels a side, K = stride·A.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, Unpack

import numpy as np
import torch

from hma_data.arrays import Float32s, Floats, Images
from hma_data.lab import simulator, truth
from hma_data.loading.dataset import Batch
from hma_data.tokenizers.base import Tokenizer
from hma_model.evaluation.actions import shuffled, without_actions
from hma_model.evaluation.intervals import NATURAL, horizon_summary, rounded, summary
from hma_model.evaluation.metrics import PSNR_LIMIT, PSNR_RANGE, perplexity_summary, psnr, teacher_forced
from hma_model.evaluation.probe import Probe, as_seen, state_errors, train_probe
from hma_model.evaluation.rollouts import RolloutImages, Sampling, rollout
from hma_model.network.model import HMA

PERTURBATION = 0.1  # standard deviations of the actions, as the paper's
FIRST_EPISODE = 500_000  # its number; drift's episodes count from 0, those of probes from a million


def measure_state(
    model: HMA,
    tokenizer: Tokenizer,
    robot: str,
    *,
    frames: int,
    prompt: int,
    episodes: int,
    seed: int = 0,
    **sampling: Unpack[Sampling],
) -> dict[str, Any]:
    """Compute the figures of a laboratory robot from its state.

    Args:
        model: in eval mode, with the robot.
        tokenizer: the model's.
        robot: its id.
        frames, prompt: T, and how many of them are true.
        episodes: how many are simulated.
        seed: of the episodes, the probe and the rollouts.
        sampling: options of `HMA.generate`.

    Returns:
        `error_px` of the rollouts `true`, `shuffled`, `none` and `copy`, and of the true pictures as the
        tokenizer shows them (`reconstruction`): the mean over the horizon, at its last step, and by frame.
        `probe_px` is the probe's own error, `spread_px` what knows nothing would have. `perturbed` has
        `psnr_star` and `perplexity_star`, beside `psnr` and `perplexity` of the true actions.

    Raises:
        UsageError: it is no robot of the laboratory.
    """
    simulator.embodiment(robot)
    space = model.embodiments[robot]
    stride = space.stride
    probe = train_probe(robot, tokenizer, stride, seed)
    simulate = partial(truth.episode, robot, frames, stride, seed)
    made = [simulate(FIRST_EPISODE + number) for number in range(episodes)]
    chunks = np.stack([one.chunks for one in made])
    batch = as_batch(model, tokenizer, robot, made)
    roll = partial(rollout, model, tokenizer, prompt=prompt, seed=seed, **sampling)
    true = roll(batch)
    films = {
        "true": true.predicted,
        "shuffled": roll(shuffled(batch, prompt - 1, seed), truth=true.truth).predicted,
        "none": roll(without_actions(batch), truth=true.truth).predicted,
        "copy": true.truth[:, prompt - 1 : prompt].repeat(frames, axis=1),
        "reconstruction": true.truth,
    }
    ways = {name: film[:, prompt:] for name, film in films.items()}
    parts = np.stack([one.parts[prompt:] for one in made])
    found = {"episodes": episodes, "picture_px": truth.SIZE}
    found |= _controllability(probe, ways, parts, seed)
    wish = perturbed(chunks, space.action_dim, prompt, seed)
    commands = wish.reshape(episodes, -1, space.action_dim)
    answers = [simulate(FIRST_EPISODE + number, commands=commands[number]) for number in range(episodes)]
    other = as_batch(model, tokenizer, robot, answers)
    return found | {"perturbed": _perturbed(model, true, roll(other), batch, other, seed)}


def perturbed(chunks: Float32s, dims: int, prompt: int, seed: int) -> Float32s:
    """Return chunks (B, T, K) with noise of PERTURBATION standard deviations, after the prompt."""
    steps = chunks.reshape(*chunks.shape[:2], -1, dims)
    noise = np.random.default_rng([seed, 3]).normal(size=steps.shape) * steps.std(axis=(0, 1, 2))
    noise[:, : prompt - 1] = 0
    return (steps + PERTURBATION * noise).reshape(chunks.shape).astype(np.float32)


def as_batch(model: HMA, tokenizer: Tokenizer, robot: str, made: Sequence[truth.TrueEpisode]) -> Batch:
    """Return simulated episodes as windows."""
    stored = np.stack([tokenizer.encode(as_seen(robot, tokenizer, one.pictures)) for one in made])
    actions = torch.from_numpy(np.stack([one.chunks for one in made]))
    known = torch.ones(actions.shape[:2], dtype=torch.bool)
    kind, dtype = ("tokens", np.int64) if model.config.kind == "discrete" else ("latents", np.float32)
    return Batch([robot] * len(made), actions, known, **{kind: torch.from_numpy(stored.astype(dtype))})


def _controllability(probe: Probe, ways: dict[str, Images], parts: Floats, seed: int) -> dict[str, Any]:
    """Return the errors of the robot's own parts, of pictures (B, P, S, S, 3) by the kind of rollout."""
    own = probe.own
    if not len(own):
        return {"missing": "no part of the robot can be located in images of this tokenizer"}
    found = {
        "probe_px": rounded(probe.error[own].mean()),
        "spread_px": rounded(probe.spread[own].mean()),
    }
    for name, pictures in ways.items():
        errors = state_errors(probe, pictures, parts)[..., own].mean(axis=-1)
        found[name] = horizon_summary("error_px", errors, seed, within=NATURAL)
    return found


def _perturbed(
    model: HMA, true: RolloutImages, made: RolloutImages, batch: Batch, other: Batch, seed: int
) -> dict[str, Any]:
    """Return PSNR and perplexity under the true actions, and under the perturbed ones."""
    found = {"scale": PERTURBATION}
    for mark, pictures, windows in (("", true, batch), ("_star", made, other)):
        given = pictures.truth[:, pictures.prompt :]
        signal = psnr(given, pictures.predicted[:, pictures.prompt :], limit=PSNR_LIMIT)
        found |= summary(f"psnr{mark}", signal.mean(axis=1), seed, within=PSNR_RANGE)
        found |= summary(f"psnr{mark}_last", signal[:, -1], seed, within=PSNR_RANGE)
        if model.config.kind == "discrete":
            nats, _ = teacher_forced(model, windows.to(model.device))
            found |= perplexity_summary(f"perplexity{mark}", nats.double().cpu().numpy().mean(axis=1), seed)
    return found
