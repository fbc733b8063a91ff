"""The first frame that the model is told at every frame."""

import dataclasses

import pytest
import torch

from hma_data.loading.dataset import Batch
from hma_model.generation.rollout import Rollout
from hma_model.training.scheduled_sampling import forwarded
from tests.model.network_parts import small_batch, small_model

NAMES = ["arm", "hand.v1", "arm", "arm"]
KINDS = pytest.mark.parametrize("kind", ["discrete", "continuous"])


def _seed(value: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(value)


def _frames(model, batch):
    return batch.tokens if model.config.kind == "discrete" else batch.latents


def _with_earlier(batch, earlier):
    return dataclasses.replace(batch, earlier=earlier)


@KINDS
@pytest.mark.parametrize("training_pass", ["window", "pairs"])
def test_without_an_earlier_frame_it_is_the_windows_own(kind, training_pass):
    model = small_model(kind=kind, told_first=True, training_pass=training_pass)
    batch = small_batch(model.config, NAMES)
    frames = _frames(model, batch)
    plain = model(batch, "forward", _seed()).loss
    assert torch.equal(plain, model(_with_earlier(batch, frames[:, 0]), "forward", _seed()).loss)
    assert not torch.equal(plain, model(_with_earlier(batch, frames[:, 1]), "forward", _seed()).loss)


def test_each_sample_of_a_mixed_batch_has_its_own():
    model = small_model(told_first=True)
    batch = small_batch(model.config, NAMES)
    earlier = batch.tokens.flip(1)[:, 0]

    def scores(first):
        return model.video_logits(batch.tokens, batch.actions, NAMES, first=first)

    other = earlier.clone()
    other[1] = batch.tokens[1, 2]
    changed = (scores(earlier) != scores(other)).flatten(1).any(1)
    assert changed.tolist() == [False, True, False, False]


@KINDS
@pytest.mark.parametrize("changes", [{}, {"masked_input": "previous"}, {"time_position": "learned"}], ids=str)
def test_a_rollout_is_told_the_first_frame_of_its_prompt(kind, changes):
    model = small_model(kind=kind, told_first=True, frames=4, **changes)
    batch = small_batch(model.config, NAMES, frames=11)
    frames = _frames(model, batch)[:, :6]  # longer than the window

    def made(prompt, cache):
        how = {"generator": _seed(), "cache": cache, "sample_steps": 2, "temperature": 0.0}
        return model.generate(prompt, batch.actions, NAMES, 5, **how)

    cached = made(frames, True)
    torch.testing.assert_close(cached, made(frames, False), rtol=0, atol=1e-4)
    other = frames.clone()
    other[:, 0] = frames[:, 1]  # long out of the window
    assert not torch.equal(made(other, True), cached)


def test_rows_keep_their_own_first_frames():
    model = small_model(told_first=True, frames=4)
    batch = small_batch(model.config, NAMES, frames=12)
    chunks = batch.actions

    def alone(row, prompt, seed, steps):
        one = Rollout(model, NAMES[row])
        one.prompt(prompt, chunks[row : row + 1], seeds=[seed])
        return [one.step(chunks[row : row + 1, 2 + i]) for i in range(steps)]

    rollout = Rollout(model, NAMES, 4)
    rollout.prompt(batch.tokens[:, :3], chunks, seeds=[1, 2, 3, 4])
    for i in range(6):
        rollout.step(chunks[:, 2 + i])
    new = batch.tokens[1:2, 5:8]
    rollout.reset([1], new, chunks[1:2], seeds=[7])
    twin = rollout.fork(1)
    for one in (rollout, twin):
        made = [one.step(chunks[[0, 1], [8 + i, 2 + i]], rows=[0, 1]) for i in range(3)]
        assert torch.equal(made[-1][:1], alone(0, batch.tokens[:1, :3], 1, 9)[-1])
        assert torch.equal(made[-1][1:], alone(1, new, 7, 3)[-1])


@KINDS
def test_predicted_pasts_are_told_the_earlier_frame_too(kind, monkeypatch):
    model = small_model(kind=kind, told_first=True)
    parts = vars(small_batch(model.config, NAMES))
    unused = "latents" if kind == "discrete" else "tokens"
    batch = Batch(**{**parts, unused: None})
    frames = _frames(model, batch)
    made = [
        forwarded(model, dataclasses.replace(batch, earlier=earlier), 1.0, 2, _seed()).context
        for earlier in (None, frames[:, 0], frames[:, 3])
    ]
    assert torch.equal(made[0], made[1]) and not torch.equal(made[0], made[2])
    assert torch.equal(
        forwarded(model, dataclasses.replace(batch, earlier=frames[:, 0]), 1.0, 2, _seed()).earlier,
        frames[:, 0],
    )
