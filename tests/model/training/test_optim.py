"""The optimizer: what decays, muP's scaling, schedules, and moments that come back."""

from collections import defaultdict

import pytest
import torch

from hma_data.tokenizers.training.muon import muon_step
from hma_model.training.optim import (
    learning_rate,
    load_optimizer_state,
    lr_scale,
    make_optimizer,
    optimizer_state,
    parameter_groups,
    set_lr,
)
from hma_model.training.recipe import make_recipe
from tests.model.robots import CONFIG, make_model

ROBOTS = {"arm": 2, "hand": 3}


def by_name(model, lr=1.0, decay=0.1) -> dict[str, tuple[float, float]]:
    groups = parameter_groups(model, lr, decay)
    return {name: (g["lr"], g["weight_decay"]) for g in groups for name in g["names"]}


def test_every_parameter_is_in_exactly_one_group():
    model = make_model(ROBOTS)
    names = [name for group in parameter_groups(model, 1.0, 0.1) for name in group["names"]]
    assert sorted(names) == sorted(name for name, _ in model.named_parameters())


def test_only_matrices_decay():
    model = make_model(ROBOTS, config=CONFIG.replace(qk_norm=True))
    for name, (_, decay) in by_name(model).items():
        kind = name.rsplit(".", 1)[-1]
        vector = kind.startswith("bias") or kind in ("mask", "position", "absent") or "norm" in name
        assert decay == (0.0 if vector or ".digits." in name else 0.1), name


def test_frozen_parameters_are_left_out():
    model = make_model(ROBOTS)
    model.trunk.requires_grad_(False)
    assert not any(name.startswith("trunk.") for name in by_name(model))


def test_without_mup_every_group_has_the_same_lr():
    assert {lr for lr, _ in by_name(make_model(ROBOTS)).values()} == {1.0}


def test_mup_scales_what_grows_in_both_directions_and_keeps_lr_times_decay():
    model = make_model(ROBOTS, config=CONFIG.replace(mup=True, base_width=4))
    found = by_name(model)
    assert found["trunk.blocks.0.mlp.fc1.weight"] == pytest.approx((0.25, 0.4))
    assert found["stems.id_arm.modulation.weight"] == pytest.approx((0.25, 0.4))
    assert found["stems.id_arm.input.weight"] == (1.0, 0.1)
    assert found["readout.linear.weight"] == (1.0, 0.1)
    assert found["trunk.position"] == (1.0, 0.0)


@pytest.mark.parametrize("width", [32, 128])
def test_at_its_base_width_mup_changes_no_rate(width):
    model = make_model({"arm": 2}, config=CONFIG.replace(mup=True, width=width, base_width=width))
    assert {lr for lr, _ in by_name(model).values()} == {1.0}


def test_the_constant_schedule_warms_up_and_stays():
    recipe = make_recipe({"steps": 10, "warmup": 4})
    scales = [lr_scale(step, recipe) for step in range(10)]
    assert scales == [0.25, 0.5, 0.75, 1.0] + [1.0] * 6


def test_the_cosine_schedule_ends_at_its_share():
    recipe = make_recipe({"steps": 21, "warmup": 0, "schedule": "cosine", "lr_end": 0.2})
    scales = [lr_scale(step, recipe) for step in range(21)]
    assert scales[0] == 1.0 and scales[20] == pytest.approx(0.2) and scales[10] == pytest.approx(0.6)
    assert scales == sorted(scales, reverse=True)


@pytest.mark.parametrize(("windows", "factor"), [(8, 1), (64, 1), (128, 2), (512, 8), (4096, 8)])
def test_the_papers_rule_grows_with_the_batch_up_to_eight_times(windows, factor):
    recipe = make_recipe({"lr": 1e-4, "lr_rule": "paper", "batch_size": windows // 4, "accumulate": 4})
    assert learning_rate(recipe) == pytest.approx(1e-4 * factor)


@pytest.mark.parametrize("optimizer", ["adamw", "muon"])
def test_moments_come_back_and_the_next_step_is_the_same(optimizer):
    recipe = make_recipe({"optimizer": optimizer})
    first, second = make_model(ROBOTS), make_model(ROBOTS)
    optimizers = make_optimizer(first, recipe), make_optimizer(second, recipe)

    def step(model, optimizer, seed):
        torch.manual_seed(seed)
        for name, parameter in model.named_parameters():
            parameter.grad = None if "hand" in name else torch.randn_like(parameter)
        optimizer.step()

    step(first, optimizers[0], 1)
    second.load_state_dict(first.state_dict())
    load_optimizer_state(optimizers[1], optimizer_state(optimizers[0]))
    for model, optimizer in zip((first, second), optimizers):
        step(model, optimizer, 2)
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters()))


def test_muon_takes_the_blocks_matrices_and_adamw_the_rest():
    model = make_model(ROBOTS)
    optimizer = make_optimizer(model, make_recipe({"optimizer": "muon", "muon_lr": 0.01, "lr": 1e-3}))
    by_muon = {n for group in optimizer.param_groups if group["muon"] for n in group["names"]}
    assert by_muon == {n for n, p in model.named_parameters() if n.startswith("trunk.blocks") and p.ndim == 2}
    names = [name for group in optimizer.param_groups for name in group["names"]]
    assert sorted(names) == sorted(name for name, _ in model.named_parameters())
    assert set_lr(optimizer, 0.5) == 5e-4


@pytest.mark.parametrize("shape", [(24, 8), (8, 24), (16, 16)])
def test_a_step_of_muon_is_the_gradient_made_orthogonal(shape):
    torch.manual_seed(0)
    matrices = [torch.nn.Parameter(torch.randn(shape)) for _ in range(3)]
    before = [matrix.detach().clone() for matrix in matrices]
    for matrix in matrices:
        matrix.grad = torch.randn(shape)
    muon_step(matrices, defaultdict(dict), lr=0.1, momentum=0.0, decay=0.5)
    tall = max(1.0, shape[0] / shape[1]) ** 0.5
    for matrix, old in zip(matrices, before):
        step = (old * (1 - 0.1 * 0.5) - matrix.detach()) / (0.1 * tall)
        u, _, v = torch.linalg.svd(matrix.grad.double(), full_matrices=False)
        values = torch.linalg.svdvals(step.double())
        along = (u.T @ step.double() @ v.T).diagonal()  # the gradient's own directions
        assert 0.6 < along.median() < 1.3 and along.min() > 0 and values.max() < 1.3
