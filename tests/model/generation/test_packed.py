"""Packed modules: what they compute, and that a row does not depend on the rows beside it."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from hma_data.errors import HMAError
from hma_model.generation import engine
from hma_model.generation.packed import (
    LowConv,
    PackedLinear,
    QuantizedLinear,
    has_bfloat16,
    has_int8,
    packed,
    packs,
)
from hma_model.generation.rollout import Rollout
from hma_model.network.model import HMA
from tests.model.network.test_unet import stored, unet
from tests.model.network_parts import small_batch, small_model

needs_packing = pytest.mark.skipif(not packs(torch.device("cpu")), reason="this platform has no AVX-512")
needs_bfloat16 = pytest.mark.skipif(not has_bfloat16(), reason="this platform does not support bf16")

needs_int8 = pytest.mark.skipif(
    not (packs(torch.device("cpu")) and has_int8()), reason="this platform has no products of int8"
)


type Graphs = list[torch.fx.GraphModule]


@pytest.fixture
def graphs(monkeypatch: pytest.MonkeyPatch) -> Graphs:
    """The graphs that torch.compile records from here on; they run as they are."""
    compile, found = torch.compile, []

    def backend(graph: torch.fx.GraphModule, inputs: list[torch.Tensor]) -> torch.fx.GraphModule:
        found.append(graph)
        return graph

    def traced(function: object, **how: object) -> object:
        return compile(function, backend=backend, fullgraph=True, dynamic=False)  # type: ignore[call-overload]

    monkeypatch.setattr(torch, "compile", traced)
    monkeypatch.setattr(engine, "compiler_fault", lambda device: "")  # the backend above needs none
    torch._dynamo.reset()
    return found


def _frames(model: HMA, **how: object) -> torch.Tensor:
    batch = small_batch(model.config, ["arm", "hand.v1"], frames=8)
    rollout = Rollout(model, batch.embodiment, 2, **how)  # type: ignore[arg-type]
    rollout.prompt(batch.tokens[:, :3], batch.actions, seeds=[1, 2])
    return torch.stack([rollout.step(batch.actions[:, i]) for i in range(2, 7)])


@needs_packing
@pytest.mark.parametrize("activation", ["none", "gelu"])
def test_a_packed_map_equals_the_map_for_any_strides(activation: str) -> None:
    linear, wide = nn.Linear(96, 40), torch.randn(7, 5, 192)
    for x in (wide[..., :96], wide[:, 1:3, 96:], torch.randn(96, 7).T):
        expected = linear(x) if activation == "none" else nn.functional.gelu(linear(x))
        assert torch.allclose(PackedLinear(linear, torch.float32, activation)(x), expected, atol=1e-5)


@needs_packing
@pytest.mark.parametrize("width", [128, 512, 1024])
def test_a_row_of_a_packed_product_has_the_same_bits_beside_any_number_of_others(width: int) -> None:
    linear, x = PackedLinear(nn.Linear(width, 160), torch.float32), torch.randn(1024, width)
    whole = linear(x)
    assert all(torch.equal(linear(x[:rows]), whole[:rows]) for rows in (1, 2, 16, 64, 75, 128, 512))


def test_a_packed_trunk_shares_everything_but_its_maps_and_leaves_the_model_alone() -> None:
    model = small_model()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    made = packed(model.trunk)
    assert made.position is model.trunk.position
    assert made.blocks[0].time_norm.weight is model.trunk.blocks[0].time_norm.weight
    assert isinstance(model.trunk.blocks[0].space.qkv, nn.Linear)
    assert all(torch.equal(before[name], value) for name, value in model.state_dict().items())


@pytest.mark.parametrize("digits", ["together", "chain"])
def test_a_rollout_on_packed_maps_makes_the_frames_of_the_plain_ones(digits, monkeypatch) -> None:
    model = small_model(digit_order=digits, told_noise=True)
    quick = _frames(model, temperature=0.5)
    monkeypatch.setattr(engine, "packs", lambda device: False)
    assert torch.equal(_frames(model, temperature=0.5), quick)


@pytest.mark.parametrize(
    ("precision", "near"),
    [pytest.param("bf16", 0.999, marks=needs_bfloat16), pytest.param("int8", 0.995, marks=needs_int8)],
)
def test_products_of_fewer_bits_keep_the_features_near(precision: str, near: float) -> None:
    model, seen = small_model(), []
    batch = small_batch(model.config, ["arm", "hand.v1"], frames=4)
    for way in ("float32", precision):
        rollout = Rollout(model, batch.embodiment, 2, precision=way)
        rollout.prompt(batch.tokens[:, :3], batch.actions, seeds=[1, 2])
        rollout.step(batch.actions[:, 2])
        seen.append(rollout.state.carried.memory[-1].flatten())
    assert torch.nn.functional.cosine_similarity(*seen, dim=0) > near
    assert not torch.equal(*seen)


@pytest.mark.parametrize(
    ("precision", "compiled", "message"),
    [
        ("fp8", False, "'fp8' is unknown — give float32 or bf16 or int8"),
        ("bf16", False, "does not support bf16 — use float32"),
        ("int8", True, "int8 needs a processor with AVX-512 VNNI, and no --compile"),
    ],
)
def test_a_precision_that_is_not_there_is_refused(precision, compiled, message, monkeypatch) -> None:
    monkeypatch.setattr(engine, "has_bfloat16", lambda: False)
    with pytest.raises(HMAError, match=message):
        Rollout(small_model(), "arm", precision=precision, compile=compiled)


@needs_bfloat16
def test_latents_drawn_by_bfloat16_products_are_near_those_of_float32() -> None:
    model, seen = small_model(kind="continuous"), []
    batch = small_batch(model.config, ["arm", "hand.v1"], frames=4)
    for precision in ("float32", "bf16"):
        rollout = Rollout(model, batch.embodiment, 2, precision=precision, sample_steps=8)
        rollout.prompt(batch.latents[:, :3], batch.actions, seeds=[1, 2])
        seen.append(rollout.step(batch.actions[:, 2]))
    error = (seen[0] - seen[1]).square().mean() / seen[0].square().mean()
    assert 0 < error < 0.01


@needs_int8
def test_a_map_in_int8_is_near_the_plain_one() -> None:
    linear, x = nn.Linear(96, 40), torch.randn(3, 7, 96)
    expected = nn.functional.gelu(linear(x))
    assert (QuantizedLinear(linear, "gelu")(x) - expected).abs().max() < 0.02 * expected.abs().max()


def test_what_a_rollout_returns_can_be_changed_and_trained_on() -> None:
    model = small_model(kind="continuous")
    batch = small_batch(model.config, ["arm"], frames=4)
    rollout = Rollout(model, "arm", sample_steps=1)
    rollout.prompt(batch.latents[:, :3], batch.actions)
    frame = rollout.step(batch.actions[:, 2])
    frame[0] = 0
    weight = torch.ones((), requires_grad=True)
    (weight * frame).sum().backward()


def test_without_a_compiler_the_same_frames_are_made_and_it_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    model = small_model()
    monkeypatch.setattr("torch._inductor.config.cpp.cxx", (None, "/nowhere/g++"))
    with pytest.warns(RuntimeWarning, match=r"compile: a C\+\+ compiler .* missing, so nothing is compiled"):
        frames = _frames(model, compile=True)
    assert torch.equal(frames, _frames(model))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "digits", "temperature"), [("random", "chain", 0.5), ("confidence", "together", 0.0)]
)
def test_trunk_head_and_unmasking_compile_to_one_graph_of_each_pass(order, digits, temperature, graphs):
    model = small_model(masked_input="previous", digit_order=digits, told_noise=True)
    how = {"order": order, "temperature": temperature}
    made = _frames(model, compile=True, **how)
    assert torch.equal(made, _frames(model, **how))
    assert len(graphs) == 2  # over two frames, and over one


@pytest.mark.slow
def test_new_prompts_and_rows_that_begin_anew_compile_nothing_more(graphs: Graphs) -> None:
    model = small_model()
    batch = small_batch(model.config, ["arm", "hand.v1"], frames=8)
    rollout = Rollout(model, batch.embodiment, 2, compile=True, unmask_steps=12)

    def play(prompt: int) -> None:
        rollout.prompt(batch.tokens[:, :prompt], batch.actions, seeds=[prompt, 2])
        for i in range(prompt - 1, 7):
            rollout.step(batch.actions[:, i])

    play(3)
    kinds = len(graphs)  # of passes
    play(4)
    rollout.reset([1], batch.tokens[1:, :2], batch.actions[1:], seeds=[5])
    rollout.step(batch.actions[:, 1])
    rollout.step(batch.actions[:1, 2], rows=[0])
    rollout.prompt(batch.tokens[:, :3], batch.actions, torch.rand(2, 8) < 0.5)
    rollout.step(batch.actions[:, 2], known=torch.tensor([True, False]))
    assert len(graphs) == kinds > 2
    for steps in (1, 3, 4, 5, 6, 7):  # each takes other numbers of tokens, more than torch compiles by itself
        rollout.decoding = replace(rollout.decoding, unmask_steps=steps)
        rollout.step(batch.actions[:, 3])
    assert len(graphs) > torch._dynamo.config.recompile_limit


@needs_packing
@needs_bfloat16
def test_convolutions_of_a_unet_in_bfloat16_make_nearly_the_same_pixels() -> None:
    model, seen = unet(), []
    frames, actions = stored(model, 1, 3), torch.randn(1, 6, 6, generator=torch.Generator().manual_seed(1))
    for precision in ("float32", "bf16"):
        rollout = Rollout(model, "arm", precision=precision)
        kinds = {type(one) for one in rollout.engine.trunk.modules()}
        assert (LowConv in kinds) == (precision == "bf16") and (nn.Conv2d in kinds) != (LowConv in kinds)
        seen.append(model.generate(frames, actions, "arm", 3, precision=precision))
    assert 0 < (seen[0] - seen[1]).abs().mean() < 3
