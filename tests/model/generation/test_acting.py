"""A rollout that acts commands what `predict_actions` says of the whole history, also of its own video."""

from typing import Any

import pytest
import torch

from hma_model.generation.rollout import Rollout
from hma_model.network.model import HMA
from tests.model.generation.test_generate import LAYOUTS
from tests.model.network_parts import ARM, HAND, small_batch, small_model

ACTS: dict[str, Any] = {"objectives": {"forward": 1.0, "policy": 1.0}}
NAMES, TOTAL, PROMPTS = ["arm", "hand.v1"], 9, (3, 1)


def wanted(
    model: HMA, frames: torch.Tensor, chunks: torch.Tensor, known: torch.Tensor, row: int
) -> torch.Tensor:
    seen = known[: len(frames)].clone()
    seen[-1] = False  # the chunk that is asked for
    given = [part[None, : len(frames)] for part in (frames, chunks, seen)]
    return model.predict_actions(given[0], NAMES[row], given[1], given[2])[0, -1]


@pytest.mark.parametrize(
    ("layout", "kind", "cache"),
    [(name, "discrete", True) for name in LAYOUTS]
    + [("rotary", "continuous", True), ("rotary", "discrete", False), ("learned", "discrete", False)],
)
def test_the_cached_chunk_is_that_of_the_whole_history(layout: str, kind: str, cache: bool) -> None:
    model = small_model(kind=kind, **LAYOUTS[layout] | ACTS)
    batch = small_batch(model.config, NAMES, frames=TOTAL)
    frames, chunks = batch.tokens if kind == "discrete" else batch.latents, batch.actions
    known = torch.rand(2, TOTAL, generator=torch.Generator().manual_seed(1)) < 0.7
    rollout = Rollout(model, NAMES, 2, cache=cache)
    for row, count in enumerate(PROMPTS):
        rollout.reset([row], frames[[row], :count], chunks[[row], :count], known[[row], :count], [0])
    learned = model.config.released  # which end with the window
    for step in range((model.config.frames + 1 if learned else TOTAL) - max(PROMPTS)):
        if step % 3 != 1:  # several frames may come before the next command
            made = rollout.act()
            for row, count in enumerate(PROMPTS):
                at = count + step
                expected = wanted(model, frames[row, :at], chunks[row], known[row], row)
                torch.testing.assert_close(made[row, : len(expected)], expected, atol=1e-4, rtol=1e-4)
        at = [count + step for count in PROMPTS]
        rollout.observe(
            torch.stack([frames[row, i] for row, i in enumerate(at)]),
            torch.stack([chunks[row, i - 1] for row, i in enumerate(at)]),
            known=torch.stack([known[row, i - 1] for row, i in enumerate(at)]),
        )


@pytest.mark.parametrize("layout", ["rotary", "learned", "released", "cross"])
def test_video_and_actions_roll_out_together_with_and_without_a_cache(layout: str) -> None:
    model = small_model(**LAYOUTS[layout] | ACTS)
    batch = small_batch(model.config, NAMES, frames=2)
    runs = []
    for cache in (True, False):
        rollout = Rollout(model, NAMES, 2, cache=cache, temperature=0.5)
        rollout.prompt(batch.tokens, batch.actions, seeds=[1, 2])
        steps = [(chunk := rollout.act(), rollout.step(chunk)) for _ in range(6)]
        runs.append([torch.stack(part) for part in zip(*steps)])
    torch.testing.assert_close(runs[0][0], runs[1][0], atol=1e-4, rtol=1e-4)
    assert torch.equal(runs[0][1], runs[1][1])
    assert runs[0][0][:, 1, HAND.chunk_dim :].abs().max() == 0 and runs[0][0].shape[2] == ARM.chunk_dim


@pytest.mark.parametrize("absent", ["embedding", "skip", "tokens"])
@pytest.mark.parametrize("first", ["observe", "act"])
def test_what_comes_before_a_first_step_without_actions_leaves_the_cache_right(first, absent) -> None:
    model = small_model(conditioning=("concat", "modulation"), action_tokens=2, absent_action=absent, **ACTS)
    batch = small_batch(model.config, NAMES, frames=4)
    runs = []
    for cache in (True, False):
        rollout = Rollout(model, NAMES, 2, cache=cache, unmask_steps=2, temperature=0.0)
        rollout.prompt(batch.tokens[:, :3], None, seeds=[1, 2])
        if first == "act":
            rollout.act()
        else:
            rollout.observe(batch.tokens[:, 3])
        runs.append(torch.stack([rollout.step(None) for _ in range(4)]))
    assert torch.equal(*runs)


def test_a_model_that_acts_from_one_frame_may_then_be_told_its_actions() -> None:
    model = small_model(absent_action="skip", **ACTS)
    batch = small_batch(model.config, NAMES, frames=1)
    runs = []
    for cache in (True, False):
        rollout = Rollout(model, NAMES, 2, cache=cache, temperature=0.0)
        rollout.prompt(batch.tokens, None, seeds=[1, 2])
        runs.append(torch.stack([rollout.step(rollout.act()) for _ in range(4)]))
    assert torch.equal(*runs)


def test_acting_leaves_no_trace_in_the_video() -> None:
    model = small_model(**ACTS)
    batch = small_batch(model.config, NAMES, frames=8)
    runs = []
    for acts in (True, False):
        rollout = Rollout(model, NAMES, 2, temperature=0.5)
        rollout.prompt(batch.tokens[:, :2], batch.actions, seeds=[1, 2])
        for at in range(2, 5):
            _ = acts and rollout.act()
            rollout.observe(batch.tokens[:, at], batch.actions[:, at - 1])
        runs.append(torch.stack([rollout.step(batch.actions[:, at]) for at in range(4, 8)]))
    assert torch.equal(*runs)


def test_a_diffusion_head_draws_each_rows_own_noise() -> None:
    model = small_model(action_loss="diffusion", **ACTS)
    batch = small_batch(model.config, NAMES, frames=3)
    both = Rollout(model, NAMES[::-1], 2)
    both.reset([1, 0], batch.tokens, batch.actions, None, [5, 6], NAMES)
    for row, name in enumerate(NAMES):
        alone = Rollout(model, name)
        alone.reset([0], batch.tokens[[row]], batch.actions[[row]], None, [5 + row])
        own = alone.act()[0]
        torch.testing.assert_close(own, both.act([1 - row])[0, : len(own)], atol=1e-4, rtol=1e-4)
