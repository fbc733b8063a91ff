"""Training on the model's own past: which frames, from what, and that the loss still asks for the truth."""

from dataclasses import replace

import pytest
import torch

from hma_data.errors import RecipeError
from hma_data.loading.dataset import Batch
from hma_model.training.loop import train
from hma_model.training.parallel import Ranks
from hma_model.training.recipe import make_recipe
from hma_model.training.run import Run
from hma_model.training.scheduled_sampling import SAMPLE_STEPS, forwarded
from tests.model.robots import CONFIG, make_model
from tests.model.runs import TINY

FRAMES = 6
ROBOTS = {"arm": 2, "hand": 3}


def batch(size: int = 4, continuous: bool = False, grid: tuple[int, int] = (2, 3)) -> Batch:
    g = torch.Generator().manual_seed(0)
    names = ["arm", "hand"] * (size // 2)
    actions = torch.randn(size, FRAMES, 6, generator=g)
    known = torch.ones(size, FRAMES, dtype=torch.bool)
    if continuous:
        return Batch(names, actions, known, latents=torch.randn(size, FRAMES, 2, 4, 4, generator=g))
    return Batch(names, actions, known, tokens=torch.randint(64, (size, FRAMES, *grid), generator=g))


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


def test_a_past_of_its_own_begins_at_its_step(arm_shards, tmp_path):
    data = [str(arm_shards)]
    own, plain = (
        train(
            make_recipe({**TINY, "data": data, "self_forward": 0.5, "self_forward_from": step}),
            out=tmp_path / f"from{step}",
            show=False,
        )
        for step in (2, 100)
    )
    assert plain.losses[:2] == own.losses[:2] and plain.losses != own.losses


SKIPS = {"objectives": {"forward": 0.5, "passive": 0.5}, "model": {**TINY["model"], "absent_action": "skip"}}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"self_forward": 0.5}, "self_forward: does not work with parallel=fsdp"),
        (SKIPS, "absent_action: skip does not work with parallel=fsdp"),
    ],
)
def test_sharded_ranks_are_refused_where_they_would_disagree(arm_shards, tmp_path, changes, said):
    recipe = make_recipe({**TINY, "data": [str(arm_shards)], "parallel": "fsdp", **changes})
    with pytest.raises(RecipeError, match=f"{said}.* use parallel=ddp"):
        Run(recipe, tmp_path, torch.device("cpu"), Ranks(0, 2))


CONTINUOUS = {
    "kind": "continuous", "grid": (4, 4), "channels": 2, "patch": 2, "diffusion_width": 16,
    "diffusion_depth": 1, "latent_scale": 0.5,
}  # fmt: skip


DISCRETE = {
    "discrete": {}, "chain": {"digit_order": "chain"}, "copies": {"copy_previous": True},
    "squares": {"merge": 2, "grid": (2, 4)},
}  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "alignment", "seed"),
    [
        ("discrete", "previous", 0),
        ("discrete", "current", 1),
        ("chain", "previous", 0),
        ("copies", "previous", 1),
        ("squares", "current", 0),
        ("noise", "previous", 2),
        ("noise", "current", 1),
        ("velocity", "previous", 1),
    ],
)
def test_a_past_of_its_own_is_what_generation_makes_of_the_same_prompt_and_actions(
    kind, alignment, seed, monkeypatch
):
    continuous = kind in ("noise", "velocity")
    own = {**CONTINUOUS, "diffusion_target": kind} if continuous else DISCRETE[kind]
    config = CONFIG.replace(frames=FRAMES, action_alignment=alignment, **own)
    model = make_model(ROBOTS, seed=seed, config=config).train()
    torch.manual_seed(seed)
    with torch.no_grad():  # fresh gates, modulations and outputs are zero, so that actions would not matter
        for parameter in model.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))
    monkeypatch.setattr("hma_model.network.head.randn", lambda shape, *_: torch.full(tuple(shape), 0.3))
    true, depth = batch(4, continuous, config.grid), 1 + seed
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


def test_no_gradient_flows_through_the_past_and_the_draws_of_training_stay_as_they_were(model):
    state = torch.get_rng_state()
    given = forwarded(model, batch(), 1.0, 2, torch.Generator().manual_seed(3))
    assert not given.context.requires_grad and torch.equal(torch.get_rng_state(), state)
    assert all(parameter.grad is None for parameter in model.parameters())
