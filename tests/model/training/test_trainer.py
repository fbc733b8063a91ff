"""Options of a step: precision, accumulation, averages, recomputation, compilation."""

import json
from collections import defaultdict

import numpy as np
import pytest
import torch

from hma_data.errors import RecipeError
from hma_data.tokenizers.training.muon import muon_step
from hma_model.config import HMAConfig
from hma_model.training import run, runtime
from hma_model.training.data import TrainData, share
from hma_model.training.guards import listed
from hma_model.training.logging import read_metrics
from hma_model.training.loop import train
from hma_model.training.optim import (
    Average,
    learning_rate,
    load_optimizer_state,
    lr_scale,
    make_optimizer,
    optimizer_state,
    parameter_groups,
    set_lr,
)
from hma_model.training.parallel import Ranks
from hma_model.training.recipe import make_recipe
from hma_model.training.run import Run
from hma_model.training.runtime import attention_form, choose_precision
from tests.model.robots import CONFIG, make_model
from tests.model.runs import TINY, train_until, weights


def losses(recipe, out, **changes) -> list[float]:
    return [loss for _, loss in train(recipe(**changes), out=out, show=False).losses]


def gradients(recipe, out, batches) -> dict[str, torch.Tensor]:
    out.mkdir()
    run = Run(recipe, out, torch.device("cpu"))
    run.prepare(None)
    assert run.train_data.passes == len(batches)
    run.train_data.step = lambda: iter(enumerate(batches))
    run.parallel_model.clip = lambda limit: 1.0
    run.optimizer.step = lambda: None
    run.advance()
    return {n: p.grad.clone() for n, p in run.model.named_parameters() if p.grad is not None}


def part(batch, rows: slice):
    cut = {k: v[rows] if v is not None else None for k, v in vars(batch).items()}
    return type(batch)(**cut)


def test_accumulated_passes_have_the_gradient_of_the_whole_batch(recipe, tmp_path):
    model = {
        **TINY["model"],
        "training_pass": "pairs",
        "whole_share": 1.0,
        "corrupt_max": 0.0,
        "history_probability": 0.0,
    }
    whole = recipe(batch_size=8, model=model)
    _, batch = next(TrainData(whole, Run(whole, tmp_path, torch.device("cpu")).sets, Ranks()).step())
    one = gradients(whole, tmp_path / "one", [batch])
    halves = [part(batch, slice(0, 4)), part(batch, slice(4, 8))]
    two = gradients(recipe(batch_size=4, accumulate=2, model=model), tmp_path / "two", halves)
    assert one.keys() == two.keys()
    for name, value in one.items():
        assert torch.allclose(value, two[name], atol=1e-6), name


def test_recomputing_activations_changes_no_loss(recipe, finished, tmp_path):
    result = train(recipe(checkpointing=True), out=tmp_path / "run", show=False)
    assert result.losses == finished.losses


@pytest.mark.slow
def test_compiled_blocks_give_the_same_losses(recipe, tmp_path, monkeypatch):
    compiled, plain = [], torch.nn.Module.compile

    def traced(self, **options):
        compiled.append(self)
        plain(self, backend="eager")

    monkeypatch.setattr(torch.nn.Module, "compile", traced)
    monkeypatch.setattr(run, "compiler_fault", lambda device: "")
    given = losses(recipe, tmp_path / "a", steps=3, compile=True)
    assert len(compiled) == 1 and given == pytest.approx(losses(recipe, tmp_path / "b", steps=3), rel=1e-5)


def test_without_a_compiler_training_runs_as_it_is_and_says_so(
    recipe, finished, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(run, "compiler_fault", lambda device: "compile: a compiler is missing")
    result = train(recipe(compile=True), out=tmp_path / "run")
    assert result.losses == finished.losses
    assert "compile: a compiler is missing" in capsys.readouterr().err


def test_bf16_stays_near_full_precision_with_weights_in_float32(recipe, finished, tmp_path, monkeypatch):
    monkeypatch.setattr(runtime, "has_bfloat16", lambda: True)  # elsewhere torch imitates the products
    full = [loss for _, loss in finished.losses]
    result = train(recipe(precision="bf16"), out=tmp_path / "half", show=False)
    assert [loss for _, loss in result.losses] == pytest.approx(full, rel=0.02)
    assert all(t.dtype != torch.bfloat16 for t in weights(result.checkpoint).values())


def test_the_average_moves_by_its_decay():
    model = torch.nn.Linear(1, 1, bias=False)
    model.weight.data.fill_(0.0)
    average = Average(model, 0.5)
    model.weight.data.fill_(1.0)
    values = []
    for step in (1, 2, 1000, 1001):
        average.update(step)
        values.append(float(average.state()["weight"]))
    early = [1 - 2 / 11, 1 - 2 / 11 * 3 / 12]
    assert values == pytest.approx([*early, 1 - (1 - early[1]) * 0.5, 1 - (1 - early[1]) * 0.25])


def test_averaged_weights_are_what_is_saved_and_training_goes_on_from_its_own(recipe, finished, tmp_path):
    result = train(recipe(ema=0.9), out=tmp_path / "run", show=False)
    assert result.losses == finished.losses
    averaged, trained = weights(result.checkpoint), weights(finished.checkpoint)
    name = "trunk.blocks.0.mlp.fc1.weight"
    assert torch.equal(averaged[f"training/weights.safetensors:{name}"], trained[f"trunk.safetensors:{name}"])
    assert not torch.equal(averaged[f"trunk.safetensors:{name}"], trained[f"trunk.safetensors:{name}"])
    assert result.masked_val_loss != finished.masked_val_loss


def test_the_evaluation_is_that_of_the_averaged_weights(recipe, tmp_path):
    run = Run(recipe(ema=0.9), tmp_path, torch.device("cpu"))
    run.prepare(None)
    for _ in range(4):
        run.advance()
    found = run.evaluate()["loss"]
    run.model.load_state_dict(run.average.state())
    run.average = None
    assert run.evaluate()["loss"] == pytest.approx(found, abs=1e-6)


def test_time_memory_and_waiting_are_in_the_log(recipe, tmp_path):
    train(recipe(steps=2), out=tmp_path / "run", show=False)
    line = next(read_metrics(tmp_path / "run"))
    assert 0 < line["data_seconds"] < line["step_seconds"] and line["memory_mib"] > 50


@pytest.mark.parametrize("objective", ["passive", "policy", "inverse", "full"])
def test_what_is_trained_is_what_is_evaluated(recipe, tmp_path, objective):
    result = train(recipe(objectives={objective: 1}, steps=2), out=tmp_path / "run", show=False)
    (evaluation,) = result.evaluations
    assert evaluation["objective"] == objective and np.isfinite(evaluation["loss"])
    assert ("baseline" in evaluation) == (objective == "full")


def test_long_lists_of_windows_are_cut():
    assert listed(["a", "b"]) == "a; b" and listed(list("abcdefg")) == "a; b; c; d and 3 more"


@pytest.mark.parametrize(
    ("batch", "accumulate", "ranks", "shared"),
    [(8, 1, 1, (1, 8)), (8, 4, 1, (4, 8)), (8, 4, 2, (4, 8)), (8, 1, 2, (2, 4)), (64, 1, 8, (8, 8))],
)
def test_a_step_is_the_same_windows_on_any_number_of_ranks(recipe, batch, accumulate, ranks, shared):
    given = recipe(batch_size=batch, accumulate=accumulate)
    passes, size = share(given, ranks)
    assert (passes, size) == shared and passes * size == batch * accumulate and passes % ranks == 0


def test_windows_that_cannot_be_shared_are_refused(recipe):
    with pytest.raises(RecipeError, match="9 windows per step cannot be shared evenly by 2 ranks.*as 10"):
        share(recipe(batch_size=9), 2)


def test_ranks_see_what_one_would_see_and_each_window_once(recipe, data, tmp_path):
    given = recipe(batch_size=4, accumulate=2)
    sets = Run(given, tmp_path, torch.device("cpu")).sets
    alone = TrainData(given, sets, Ranks())
    pair = [TrainData(given, sets, Ranks(rank, 2)) for rank in range(2)]
    for _ in range(5):
        single = dict(alone.step())
        shared = {number: batch for feed in pair for number, batch in feed.step()}
        assert shared.keys() == single.keys() == {0, 1}
        for number, batch in single.items():
            assert torch.equal(batch.tokens, shared[number].tokens)
            assert torch.equal(batch.frame, shared[number].frame)


CPU = torch.device("cpu")
AUTO = make_recipe({})
UNET = {
    "kind": "continuous", "trunk": "unet", "video_loss": "regression", "copy_previous": True, "grid": (8, 8),
    "patch": 1, "shared_modulation": True, "training_pass": "pairs", "whole_share": 1.0,
}  # fmt: skip


@pytest.fixture
def bfloat16(monkeypatch):
    monkeypatch.setattr(runtime, "has_bfloat16", lambda: True)
    monkeypatch.setattr(runtime, "bfloat16_pays", lambda: True)


@pytest.fixture
def no_bfloat16(monkeypatch):
    monkeypatch.setattr(runtime, "has_bfloat16", lambda: False)


@pytest.mark.parametrize(
    ("network", "chosen", "why"),
    [
        ({"width": 256}, "bf16", "width 256 is faster"),
        ({"width": 128}, "bf16", "width 128 is faster"),
        ({"width": 64}, "fp32", "width 64 is no faster in bf16"),
        ({**UNET, "levels": (32, 64)}, "bf16", "width 32 is faster"),
        ({**UNET, "levels": (16, 32)}, "fp32", "width 16 is no faster in bf16"),
    ],
)
def test_auto_takes_bf16_on_a_processor_that_has_it_from_some_width_on(network, chosen, why, bfloat16):
    precision, reason = choose_precision(AUTO, HMAConfig(**network), CPU)
    assert precision == chosen and why in reason


def test_auto_takes_fp32_where_products_of_bfloat16_are_no_faster(bfloat16, monkeypatch):
    monkeypatch.setattr(runtime, "bfloat16_pays", lambda: False)
    precision, reason = choose_precision(AUTO, HMAConfig(width=256), CPU)
    assert precision == "fp32" and "no faster" in reason
    asked = make_recipe({"precision": "bf16"})
    assert choose_precision(asked, HMAConfig(width=256), CPU) == ("bf16", "as the recipe says")


@pytest.mark.parametrize(("there", "chosen"), [(True, "bf16"), (False, "fp32")])
def test_auto_takes_bf16_on_a_gpu_that_has_it(there, chosen, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: there)
    assert choose_precision(AUTO, HMAConfig(width=64), torch.device("cuda"))[0] == chosen


def test_what_was_not_measured_stays_in_fp32(bfloat16):
    compiled = make_recipe({"compile": True})
    assert choose_precision(compiled, HMAConfig(), CPU) == ("fp32", "bf16 was not measured compiled")
    assert choose_precision(AUTO, HMAConfig(), torch.device("mps"))[0] == "fp32"


def test_bf16_on_a_processor_without_it_is_refused_in_one_line(arm_shards, tmp_path, no_bfloat16):
    asked = make_recipe({**TINY, "data": str(arm_shards), "precision": "bf16"})
    with pytest.raises(
        RecipeError, match=r"precision=bf16: this processor does not support bf16 — use precision=auto"
    ):
        train(asked, out=tmp_path / "run", show=False)
    assert not (tmp_path / "run").exists()


def test_a_resumed_run_keeps_the_precision_that_it_began_with(arm_shards, tmp_path, bfloat16, capsys):
    given, out = {**TINY, "data": str(arm_shards)}, tmp_path / "run"
    train_until(make_recipe({**given, "precision": "bf16"}), out, 3)
    train(make_recipe({**given, "precision": "auto"}), out=out)  # of this width, auto alone takes fp32
    assert "precision bf16: as at the start of the run; attention: matrix products" in capsys.readouterr().err
    assert json.loads((out / "recipe.json").read_text())["precision"] == "bf16"
    with pytest.raises(RecipeError, match="precision: 'bf16', now 'fp32'"):
        train(make_recipe(given), out=out, show=False)


def test_a_run_says_its_precision_and_attention_first(arm_shards, tmp_path, no_bfloat16, capsys):
    train(make_recipe({**TINY, "data": str(arm_shards), "precision": "auto"}), out=tmp_path / "run")
    said = capsys.readouterr().err.splitlines()[0]
    assert "precision fp32: this processor does not support bf16; attention: torch's" in said


def test_a_unet_has_no_attention():
    assert attention_form(AUTO, HMAConfig(**UNET), CPU) == "no attention"


# -- optimizers


ROBOTS = {"arm": 2, "hand": 3}


def by_name(model, lr=1.0, decay=0.1) -> dict[str, tuple[float, float]]:
    groups = parameter_groups(model, lr, decay)
    return {name: (g["lr"], g["weight_decay"]) for g in groups for name in g["names"]}


def test_only_matrices_decay():
    model = make_model(ROBOTS, config=CONFIG.replace(qk_norm=True))
    for name, (_, decay) in by_name(model).items():
        kind = name.rsplit(".", 1)[-1]
        vector = kind.startswith("bias") or kind in ("mask", "position", "absent") or "norm" in name
        assert decay == (0.0 if vector or ".digits." in name else 0.1), name


def test_mup_scales_what_grows_in_both_directions_and_keeps_lr_times_decay():
    model = make_model(ROBOTS, config=CONFIG.replace(mup=True, base_width=4))
    found = by_name(model)
    assert found["trunk.blocks.0.mlp.fc1.weight"] == pytest.approx((0.25, 0.4))
    assert found["stems.id_arm.modulation.weight"] == pytest.approx((0.25, 0.4))
    assert found["stems.id_arm.input.weight"] == (1.0, 0.1)
    assert found["readout.linear.weight"] == (1.0, 0.1)
    assert found["trunk.position"] == (1.0, 0.0)


def test_frozen_parameters_are_left_out():
    model = make_model(ROBOTS)
    model.trunk.requires_grad_(False)
    assert not any(name.startswith("trunk.") for name in by_name(model))


@pytest.mark.parametrize("changes", [{}, *({"mup": True, "width": n, "base_width": n} for n in (32, 128))])
def test_without_mup_and_at_its_base_width_every_group_has_the_same_lr(changes):
    model = make_model({"arm": 2}, config=CONFIG.replace(**changes))
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
