"""Training on the model's own past: which frames, from what, and that the loss still asks for the truth."""

from dataclasses import replace

import pytest
import torch

from hma_data.errors import RecipeError
from hma_data.loading.dataset import Batch
from hma_data.tokenizers.base import TokenizerSpec
from hma_model.network.stem import to_digits
from hma_model.training.loop import train
from hma_model.training.parallel import World
from hma_model.training.recipe import make_recipe
from hma_model.training.run import Run
from hma_model.training.scheduled_sampling import SAMPLE_STEPS, forwarded, rolled, share_at
from tests.model.robots import CONFIG, make_model
from tests.model.runs import TINY
from tests.model.shards import make_shards

FRAMES = 6
ROBOTS = {"arm": 2, "hand": 3}


def batch(size: int = 4, continuous: bool = False) -> Batch:
    g = torch.Generator().manual_seed(0)
    names = ["arm", "hand"] * (size // 2)
    actions = torch.randn(size, FRAMES, 6, generator=g)
    known = torch.ones(size, FRAMES, dtype=torch.bool)
    if continuous:
        return Batch(names, actions, known, latents=torch.randn(size, FRAMES, 2, 4, 4, generator=g))
    return Batch(names, actions, known, tokens=torch.randint(64, (size, FRAMES, 2, 3), generator=g))


@pytest.fixture
def model():
    return make_model(ROBOTS, config=CONFIG.replace(frames=FRAMES)).train()


def changed(given: Batch, true: torch.Tensor) -> torch.Tensor:
    """(B, T) where a frame is not the true one."""
    assert given.context is not None
    return (given.context != true).flatten(2).any(2)


@pytest.mark.parametrize("depth", [1, 2, 4])
def test_so_many_frames_in_a_row_are_replaced_and_the_first_and_last_stay(model, depth):
    torch.manual_seed(1)
    true = batch(16)
    given = forwarded(model, true, 1.0, depth, torch.Generator().manual_seed(3))
    for row in changed(given, true.tokens):
        where = row.nonzero().flatten().tolist()
        assert where == list(range(where[0], where[0] + depth)) and where[0] >= 1 and where[-1] < FRAMES - 1
    assert torch.equal(given.tokens, true.tokens) and model.training


def test_a_replaced_frame_is_what_the_model_predicts_from_the_true_past(model):
    true = batch()
    given = forwarded(model, true, 1.0, 1, torch.Generator().manual_seed(3))
    for i, row in enumerate(changed(given, true.tokens)):
        (at,) = row.nonzero().flatten().tolist()
        seen = true.tokens[i : i + 1, : at + 1].clone()
        seen[:, at] = model.config.vocab_size
        name = true.embodiment[i]
        logits = model.eval().video_logits(seen, true.actions[i : i + 1, : at + 1], name)[0, at]
        digits = logits.argmax(-1)
        assert torch.equal(given.context[i, at], digits[..., 0] + 8 * digits[..., 1])


def test_a_second_frame_is_predicted_from_the_first(model):
    true = batch(2)
    given = forwarded(model, true, 1.0, 2, torch.Generator().manual_seed(3))
    row = changed(given, true.tokens)[0].nonzero().flatten().tolist()
    seen = given.context[:1, : row[1] + 1].clone()
    seen[:, row[1]] = model.config.vocab_size
    digits = model.eval().video_logits(seen, true.actions[:1], "arm")[0, row[1]].argmax(-1)
    assert torch.equal(given.context[0, row[1]], digits[..., 0] + 8 * digits[..., 1])


def test_only_a_share_of_the_windows_gets_one(model):
    true = batch(64)
    given = forwarded(model, true, 0.25, 1, torch.Generator().manual_seed(1))
    assert 6 <= int(changed(given, true.tokens).any(1).sum()) <= 26
    assert forwarded(model, true, 0.0, 1) is true


def test_windows_too_short_for_a_past_stay_as_they_are(model):
    true = batch()
    short = replace(
        true, tokens=true.tokens[:, :2], actions=true.actions[:, :2], action_mask=true.action_mask[:, :2]
    )
    assert forwarded(model, short, 1.0, 2) is short


def test_the_loss_asks_for_the_truth_and_its_gradient_reaches_every_layer(model):
    true = batch()
    given = forwarded(model, true, 1.0, 2, torch.Generator().manual_seed(3))
    other = replace(given, context=true.tokens)
    losses = [model(b, "forward", torch.Generator().manual_seed(5)).loss for b in (given, other, true)]
    assert losses[0] != losses[1] and losses[1] == losses[2]
    losses[0].backward()
    for name, parameter in model.trunk.named_parameters():
        if name != "absent":
            assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_latents_are_replaced_by_what_the_diffusion_head_samples():
    config = CONFIG.replace(
        kind="continuous", grid=(4, 4), channels=2, patch=2, diffusion_width=16, diffusion_depth=1,
        frames=FRAMES, latent_scale=0.5,
    )  # fmt: skip
    model = make_model(ROBOTS, config=config).train()
    true = batch(4, continuous=True)
    given = forwarded(model, true, 1.0, 2, torch.Generator().manual_seed(3))
    assert given.context.shape == true.latents.shape and given.context.isfinite().all()
    assert changed(given, true.latents).sum(1).tolist() == [2] * 4
    model(given, "forward", torch.Generator().manual_seed(5)).loss.backward()


def test_the_share_rises_from_a_step_over_a_number_of_steps():
    recipe = make_recipe({"self_forward": 0.5, "self_forward_from": 10, "self_forward_over": 4})
    assert [share_at(step, recipe, 0.5) for step in (0, 9, 10, 11, 13, 14, 99)] == [
        0, 0, 0.125, 0.25, 0.5, 0.5, 0.5,
    ]  # fmt: skip
    assert share_at(0, make_recipe({}), 0.5) == 0.5


@pytest.mark.parametrize("past", [{"self_forward": 0.5}, {"self_rollout": 0.7, "self_rollout_frames": 3}])
def test_a_run_with_a_past_of_its_own_goes_on_bit_for_bit(past, tmp_path):
    data = [str(make_shards(tmp_path / "arm", "arm"))]
    recipe = make_recipe({**TINY, "data": data, "self_forward_from": 2, **past})
    whole = train(recipe, out=tmp_path / "whole", show=False)

    def kill(facts):
        if facts["step"] == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(recipe, out=tmp_path / "cut", show=False, on_progress=kill)
    assert train(recipe, out=tmp_path / "cut", show=False).losses == whole.losses
    after = {**TINY, "data": data, **past, "self_forward_from": 100}
    plain = train(make_recipe(after), out=tmp_path / "plain", show=False)
    assert [a == b for (_, a), (_, b) in zip(plain.losses, whole.losses)][:2] == [True, True]
    assert plain.losses != whole.losses


@pytest.mark.parametrize("past", ["self_forward", "self_rollout"])
def test_sharded_ranks_are_refused(past, tmp_path):
    data = [str(make_shards(tmp_path / "arm", "arm"))]
    recipe = make_recipe({**TINY, "data": data, past: 0.5, "parallel": "fsdp"})
    with pytest.raises(RecipeError, match="use parallel=ddp"):
        Run(recipe, tmp_path, torch.device("cpu"), World(0, 2))


def test_passes_that_skip_actions_are_refused_where_they_would_disagree(tmp_path):
    data = [str(make_shards(tmp_path / "arm", "arm"))]
    objectives = {"forward": 0.5, "passive": 0.5}
    recipe = {**TINY, "data": data, "objectives": objectives, "parallel": "fsdp"}
    recipe["model"] = {**TINY["model"], "absent_action": "skip"}
    with pytest.raises(RecipeError, match="absent_action: skip does not work with parallel=fsdp"):
        Run(make_recipe(recipe), tmp_path, torch.device("cpu"), World(0, 2))


def test_rollouts_without_predicted_frames_are_refused(tmp_path):
    recipe = make_recipe({**TINY, "data": ["x"], "self_rollout": 0.5, "objectives": {"policy": 1}})
    with pytest.raises(RecipeError, match="self_rollout: needs frames .* policy does not predict"):
        Run(recipe, tmp_path, torch.device("cpu"))


def test_no_loss_is_due_on_padded_frames(model):
    true = batch(2)
    padded = replace(true, frame_mask=torch.tensor([[True] * 3 + [False] * 3, [True] * 6]))
    output = model(padded, "forward", torch.Generator().manual_seed(5))
    assert not output.masked[0, 3:].any() and output.masked[1, 3:].any()


def test_a_run_pads_short_episodes_when_asked(tmp_path):
    spec = TokenizerSpec(
        name="raw", version=1, kind="discrete", image_size=16, grid=(2, 3), vocab_size=64, factored=(8, 8)
    )
    data = [str(make_shards(tmp_path / "arm", "arm", spec=spec, length=6, episodes=8))]
    recipe = make_recipe({**TINY, "data": data, "short": "pad", "eval_every": 0, "steps": 2})
    assert train(recipe, out=tmp_path / "run", show=False).step == 2


CONTINUOUS = {
    "kind": "continuous", "grid": (4, 4), "channels": 2, "patch": 2, "diffusion_width": 16,
    "diffusion_depth": 1, "latent_scale": 0.5,
}  # fmt: skip


@pytest.mark.parametrize("kind", ["discrete", "noise", "velocity"])
@pytest.mark.parametrize("alignment", ["previous", "current"])
@pytest.mark.parametrize("seed", range(3))
def test_a_past_of_its_own_is_what_generation_makes_of_the_same_prompt_and_actions(
    kind, alignment, seed, monkeypatch
):
    continuous = kind != "discrete"
    own = {**CONTINUOUS, "diffusion_target": kind} if continuous else {}
    config = CONFIG.replace(frames=FRAMES, action_alignment=alignment, **own)
    model = make_model(ROBOTS, seed=seed, config=config).train()
    torch.manual_seed(seed)
    with torch.no_grad():  # fresh gates, modulations and outputs are zero, so that actions would not matter
        for parameter in model.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))
    monkeypatch.setattr("hma_model.network.head.randn", lambda shape, *_: torch.full(tuple(shape), 0.3))
    true, depth = batch(4, continuous), 1 + seed
    stored = true.latents if continuous else true.tokens
    given = forwarded(model, true, 1.0, depth, torch.Generator().manual_seed(seed))
    model.eval()
    for i, row in enumerate(changed(given, stored)):
        at = int(row.nonzero()[0])
        made, other = (
            model.generate(
                stored[i : i + 1, :at], actions[i : i + 1], true.embodiment[i], depth,
                unmask_steps=1, temperature=0, sample_steps=SAMPLE_STEPS if continuous else None,
            )[0]
            for actions in (true.actions, -true.actions)
        )  # fmt: skip
        assert torch.allclose(given.context[i, at : at + depth].float(), made.float(), atol=1e-4)
        assert not torch.allclose(made.float(), other.float(), atol=1e-4)
        assert torch.equal(given.context[i, :at], stored[i, :at])
        assert torch.equal(given.context[i, at + depth :], stored[i, at + depth :])


@pytest.mark.parametrize("target", ["noise", "velocity"])
def test_targets_of_a_continuous_model_are_the_true_latents_whatever_it_sees(target, monkeypatch):
    config = CONFIG.replace(frames=FRAMES, **CONTINUOUS, diffusion_target=target)
    model, targets = make_model(ROBOTS, config=config).train(), []
    diffusion = model.latent_readout.diffusion
    plain = diffusion.loss
    monkeypatch.setattr(
        diffusion, "loss", lambda target, *more: (targets.append(target), plain(target, *more))[1]
    )
    true = batch(4, continuous=True)
    given = forwarded(model, true, 1.0, 2, torch.Generator().manual_seed(3))
    assert not torch.equal(given.context, true.latents)
    for seen in (given, true):
        model(seen, "forward", torch.Generator().manual_seed(5))
    assert torch.equal(targets[0], targets[1])


def test_one_that_knows_the_frames_already_gives_the_very_batch(model, monkeypatch):
    true = batch()
    exact = to_digits(true.tokens, model.config.factored)
    scores = torch.nn.functional.one_hot(exact, 8).float()

    def known(*given, frame, **more):
        return scores[torch.arange(len(frame)), frame].unsqueeze(1)

    monkeypatch.setattr(model, "logits_under", known)
    given = forwarded(model, true, 1.0, 3, torch.Generator().manual_seed(3))
    assert torch.equal(given.context, true.tokens)


def test_no_gradient_flows_through_the_past_and_the_draws_of_training_stay_as_they_were(model):
    state = torch.get_rng_state()
    given = forwarded(model, batch(), 1.0, 2, torch.Generator().manual_seed(3))
    assert not given.context.requires_grad and torch.equal(torch.get_rng_state(), state)
    assert all(parameter.grad is None for parameter in model.parameters())


# -- rollouts before the window

LONG = FRAMES + 7


def long_batch(size: int = 8, continuous: bool = False) -> Batch:
    """Frame t of row b is b + t · 100 in every token and action, so that windows show their place."""
    place = torch.arange(size).view(-1, 1) + 100 * torch.arange(LONG)
    names = ["arm", "hand"] * (size // 2)
    shape = (size, LONG, 2, 4, 4) if continuous else (size, LONG, 2, 3)
    frames = place.view(size, LONG, *[1] * (len(shape) - 2)).expand(shape).clone()
    actions = place.unsqueeze(-1).expand(size, LONG, 6).float()
    stored = {"latents": frames.float()} if continuous else {"tokens": frames}
    return Batch(names, actions, torch.ones(size, LONG, dtype=torch.bool), **stored)


def begins(given: Batch) -> list[int]:
    """Return the frame of the longer batch that each window begins with; all of it must be cut alike."""
    stored = given.tokens if given.tokens is not None else given.latents
    places = stored.flatten(2)[:, :, 0].long()
    first = places[:, :1] // 100
    assert torch.equal(places // 100, first + torch.arange(FRAMES))
    assert torch.equal(places % 100, torch.arange(len(places)).view(-1, 1).expand_as(places))
    assert torch.equal(given.actions[:, :, 0].long(), places)
    return first.flatten().tolist()


def marked(made: list, prompts: list):
    """A stand-in for generation: frame t of a row's rollout has -1 - t in every token."""

    def generate(model, prompt, actions, names, count, known, generator=None):
        assert not model.training and len(names) == len(prompt)
        made.append(count)
        prompts.append(prompt.shape[1])
        times = prompt.shape[1] + torch.arange(count)
        return (
            (-1 - times)
            .view(1, count, *[1] * (prompt.dim() - 2))
            .expand(len(prompt), count, *prompt.shape[2:])
        )

    return generate


@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_a_window_of_a_rollout_has_its_frames_up_to_the_one_before_its_last(
    continuous, seed, model, monkeypatch
):
    made, prompts = [], []
    monkeypatch.setattr("hma_model.training.scheduled_sampling.generate", marked(made, prompts))
    given = rolled(model, long_batch(8, continuous), 1.0, FRAMES, torch.Generator().manual_seed(seed))
    (count,), (prompt,) = made, prompts
    assert 2 <= prompt <= FRAMES and model.training
    stored = given.tokens if given.tokens is not None else given.latents
    for row, begin in enumerate(begins(given)):
        for t in range(FRAMES):
            seen, true = given.context[row, t], stored[row, t]
            own = begin + t >= prompt and t < FRAMES - 1
            assert torch.equal(seen, torch.full_like(seen, -1 - begin - t) if own else true)
    assert count == max(begins(given)) + FRAMES - 1 - prompt


def test_windows_of_rollouts_begin_anywhere_and_others_stay_true(model, monkeypatch):
    made, prompts, seen = [], [], set()
    monkeypatch.setattr("hma_model.training.scheduled_sampling.generate", marked(made, prompts))
    rows, whole = 0, 0
    for seed in range(60):
        given = rolled(model, long_batch(), 0.4, FRAMES, torch.Generator().manual_seed(seed))
        seen |= set(begins(given))
        if given.context is not None:
            own = changed(given, given.tokens)
            rows += int(own.any(1).sum())
            whole += int(own[:, :-1].all(1).sum())
    assert seen == set(range(LONG - FRAMES + 1)) and set(prompts) == set(range(2, FRAMES + 1))
    assert 0.25 < rows / (60 * 8) < 0.45 and whole
    true = rolled(model, long_batch(), 0.0, FRAMES, torch.Generator().manual_seed(1))
    assert true.context is None and true.tokens.shape[1] == FRAMES


def test_a_rollout_is_what_generation_makes_with_the_same_seeds(model):
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))
    g = torch.Generator().manual_seed(0)
    long = replace(
        long_batch(4), tokens=torch.randint(64, (4, LONG, 2, 3), generator=g),
        actions=torch.randn(4, LONG, 6, generator=g),
    )  # fmt: skip
    state = torch.get_rng_state()
    given = rolled(model, long, 1.0, FRAMES, torch.Generator().manual_seed(5))
    assert torch.equal(torch.get_rng_state(), state) and not given.context.requires_grad
    again = torch.Generator().manual_seed(5)
    draws = torch.rand((3, 4), generator=again)
    begin, prompt = (draws[1] * (LONG - FRAMES + 1)).long(), 2 + int(draws[2, 0] * (FRAMES - 1))
    count = LONG - 1 - prompt
    with torch.no_grad():
        made = model.eval().generate(
            long.tokens[:, :prompt], long.actions, long.embodiment, count,
            known=long.action_mask, generator=again,
        )  # fmt: skip
    for row in range(4):
        first = int(begin[row])
        known = torch.cat([long.tokens[row, :prompt], made[row]])[first : first + FRAMES - 1]
        assert torch.equal(given.context[row, :-1], known)


def test_windows_of_padded_episodes_lie_inside_them(model):
    lengths = [LONG, FRAMES + 2, FRAMES, FRAMES - 2] * 2
    inside = torch.arange(LONG) < torch.tensor(lengths).unsqueeze(1)
    for seed in range(20):
        long = replace(long_batch(), frame_mask=inside)
        given = rolled(model, long, 0.0, FRAMES, torch.Generator().manual_seed(seed))
        for begin, length, mask in zip(begins(given), lengths, given.frame_mask):
            assert begin <= max(length - FRAMES, 0)
            assert mask.tolist() == [begin + t < length for t in range(FRAMES)]


def test_rollouts_longer_than_the_episodes_say_what_to_do(tmp_path):
    data = [str(make_shards(tmp_path / "arm", "arm", length=12, episodes=8))]
    recipe = {**TINY, "data": data, "self_rollout": 0.5, "self_rollout_frames": 50}
    with pytest.raises(RecipeError, match=r"self_rollout_frames: asks for \d+ \+ 50 frames.*short=pad"):
        train(make_recipe(recipe), out=tmp_path / "run", show=False)
    padded = make_recipe({**recipe, "short": "pad", "steps": 2, "eval_every": 0})
    assert train(padded, out=tmp_path / "padded", show=False).step == 2
