"""Stems and trunk: normalisation, causality, positions, conditioning."""

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from hma_data.errors import HMAError
from hma_model.config import ActionSpace
from hma_model.network.conditioning import ActionConditioning, Groups
from hma_model.network.model import HMA
from hma_model.network.rotary import rotary_angles, rotate
from hma_model.network.stem import Normalizer
from hma_model.network.trunks import transformer
from hma_model.network.trunks.contract import TimePositions, paired_times
from hma_model.network.trunks.transformer import MLP, TemporalAttention
from tests.model.network_parts import ARM, HAND, small_batch, small_config, small_model

LAYOUTS = [
    {"conditioning": ("modulation",)},
    {"conditioning": ("concat", "modulation"), "action_tokens": 3, "layout": "released"},
    {"conditioning": ("add",), "layout": "released"},
    {"conditioning": ("cross_attention",), "qk_norm": True},
    {"conditioning": ("modulation",), "shared_modulation": True, "action_alignment": "current", "mup": True},
    {"conditioning": ("add", "concat"), "qk_norm": True},
    {"conditioning": ("concat", "modulation"), "absent_action": "tokens", "action_alignment": "current"},
]


def _logits(model: HMA, batch: object) -> torch.Tensor:
    with torch.no_grad():
        return model.video_logits(batch.tokens, batch.actions, batch.embodiment)  # type: ignore[attr-defined]


def test_normalised_actions_have_unit_variance_and_come_back() -> None:
    actions = torch.randn(500, 6) * torch.tensor([2.0, 0.5, 1.0] * 2) + torch.tensor([1.0, -2.0, 0.5] * 2)
    normalizer = Normalizer(ARM)
    values = normalizer(actions).unflatten(-1, (2, 3))
    assert (
        values[..., :2].mean((0, 1)).abs().max() < 0.1 and (values[..., :2].std((0, 1)) - 1).abs().max() < 0.1
    )
    assert torch.equal(values[..., 2], actions.unflatten(-1, (2, 3))[..., 2])  # not to be normalised
    assert torch.allclose(normalizer.undo(normalizer(actions)), actions, atol=1e-6)


def test_dims_that_never_vary_become_zero_and_come_back_as_their_mean() -> None:
    normalizer = Normalizer(HAND)
    assert normalizer(torch.tensor([[1.0, 3.0], [2.0, 4.0]]))[:, 1].tolist() == [0.0, 0.0]
    assert normalizer.undo(torch.zeros(1, 2)).tolist() == [[0.0, 3.0]]


def test_float32_rounding_of_a_constant_is_no_variance() -> None:
    space = ActionSpace("x", 1, 1, (1000.1,), (3e-5,), (True,))
    assert Normalizer(space)(torch.tensor([[1000.2]])).item() == 0


def test_a_released_stem_divides_dims_that_never_vary_too() -> None:
    space = ActionSpace("x", 2, 1, (1.0, 2.0), (0.0, 4.0), (True, True), "divide")
    values = Normalizer(space)(torch.tensor([[1.0, 6.0], [2.0, 6.0]]))
    assert torch.allclose(values, torch.tensor([[0.0, 1.0], [1e10, 1.0]]))
    assert torch.allclose(Normalizer(space).undo(values), torch.tensor([[1.0, 6.0], [2.0, 6.0]]))


def test_statistics_stay_float32_when_the_model_is_cast() -> None:
    model = small_model().to(torch.bfloat16)
    assert model.stem("arm").normalizer.mean.dtype == torch.float32
    assert model.stem("arm").input.weight.dtype == torch.bfloat16
    batch = small_batch(model.config, ["arm"])
    assert _logits(model, batch).dtype == torch.float32


@pytest.mark.parametrize("layout", LAYOUTS)
def test_later_frames_and_actions_change_nothing_before_them(layout: dict) -> None:
    model = small_model(**layout)
    batch = small_batch(model.config, ["arm", "hand.v1"])
    before = _logits(model, batch)
    other = small_batch(model.config, ["arm", "hand.v1"], seed=1)
    k = 3
    batch.tokens[:, k:] = other.tokens[:, k:]
    first = k - (model.config.action_alignment == "previous")  # of the chunks in force from frame k on
    batch.actions[:, first:] = other.actions[:, first:]
    after = _logits(model, batch)
    assert torch.equal(before[:, :k], after[:, :k])
    assert (before[:, k:] - after[:, k:]).abs().amax((2, 3, 4, 5)).min() > 1e-4


@pytest.mark.parametrize(("alignment", "first"), [("previous", 3), ("current", 2)])
def test_a_chunk_acts_from_the_frame_on_that_its_alignment_names(alignment: str, first: int) -> None:
    model = small_model(action_alignment=alignment)
    batch = small_batch(model.config, ["arm"])
    before = _logits(model, batch)
    batch.actions[:, 2] += 1
    change = (_logits(model, batch) - before).abs().amax((0, 2, 3, 4, 5))
    assert change[:first].max() == 0 and change[first] > 1e-4


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_mixed_batch_equals_separate_batches(layout: dict) -> None:
    model = small_model(**layout)
    names = ["arm", "hand.v1", "arm", "hand.v1"]
    batch = small_batch(model.config, names)
    mixed = _logits(model, batch)
    for name, space in (("arm", ARM), ("hand.v1", HAND)):
        rows = [i for i, n in enumerate(names) if n == name]
        with torch.no_grad():
            alone = model.video_logits(batch.tokens[rows], batch.actions[rows, :, : space.chunk_dim], name)
        assert (mixed[rows] - alone).abs().max() < 1e-5


def test_rotary_scores_depend_on_the_distance_alone() -> None:
    config = small_model().config
    q, k = torch.randn(1, 1, 8), torch.randn(1, 1, 8)

    def score(at: int, to: int) -> torch.Tensor:
        positions = torch.tensor([at, to])
        angles = [tuple(a[i : i + 1] for a in rotary_angles(config, positions)) for i in (0, 1)]
        return (rotate(q, angles[0]) * rotate(k, angles[1])).sum()

    assert torch.allclose(score(3, 1), score(103, 101), atol=1e-4)
    assert not torch.allclose(score(3, 1), score(3, 2), atol=1e-3)


@pytest.mark.parametrize("frames", [1, 2])
def test_attention_over_the_cache_is_the_same_when_compiled(frames, monkeypatch) -> None:
    attention = TemporalAttention(small_model().config)
    heads, size, slots = attention.heads, 32 // attention.heads, 5
    q, cache = torch.randn(2, frames, 6, heads, size), torch.randn(2, slots, 2, 6, heads, size)
    allowed = torch.rand(2, frames, slots) < 0.5
    allowed[..., 0] = True
    times = TimePositions(torch.zeros(2, frames), allowed, (torch.zeros(0), torch.zeros(0)))
    plain = attention._recall(q, times, cache)
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    assert torch.allclose(attention._recall(q, times, cache), plain, atol=1e-5)


def test_a_window_longer_than_the_configured_sees_only_its_length_back() -> None:
    model = small_model(layers=1)
    batch = small_batch(model.config, ["arm"], frames=8)
    before = _logits(model, batch)
    batch.tokens[:, 0] = (batch.tokens[:, 0] + 1) % model.config.vocab_size
    change = (_logits(model, batch) - before).abs().amax((0, 2, 3, 4, 5))
    assert change[4] > 0 and change[5:].max() == 0


def test_learned_positions_refuse_a_longer_window() -> None:
    model = small_model(layout="released")
    batch = small_batch(model.config, ["arm"], frames=6)
    with pytest.raises(HMAError, match="6 frames where the learned positions end at 5"):
        _logits(model, batch)


def test_absent_actions_can_skip_conditioning_altogether() -> None:
    model = small_model(conditioning=("concat", "modulation"), absent_action="skip")
    batch = small_batch(model.config, ["arm"])
    with torch.no_grad():
        one = model.video_logits(batch.tokens, None, "arm")
        assert torch.equal(one, model.video_logits(batch.tokens, None, "hand.v1"))


def test_without_actions_only_learned_tokens_may_stand_for_them() -> None:
    model = small_model(
        conditioning=("modulation",), absent_action="tokens", action_tokens=3, objectives={"policy": 1.0}
    )
    batch = small_batch(model.config, ["arm"])
    with torch.no_grad():
        one = model.video_logits(batch.tokens, None, "arm")
        assert torch.equal(one, model.video_logits(batch.tokens, None, "hand.v1"))
        chunks = model.predict_actions(batch.tokens, "arm")
        model.trunk.absent += 1
        assert not torch.equal(one, model.video_logits(batch.tokens, None, "arm"))
        assert not torch.equal(chunks, model.predict_actions(batch.tokens, "arm"))


def test_a_hidden_chunk_is_hidden_in_the_tokens_alone_where_the_release_does_so() -> None:
    for conditioning, seen in ((("concat",), False), (("concat", "modulation"), True)):
        model = small_model(conditioning=conditioning, absent_action="tokens")
        batch = small_batch(model.config, ["arm"])
        batch.action_mask[:, 1:3] = False
        with torch.no_grad():
            one = model.video_logits(batch.tokens, batch.actions, "arm", batch.action_mask)
            batch.actions[:, 1:3] += 1
            two = model.video_logits(batch.tokens, batch.actions, "arm", batch.action_mask)
        assert torch.equal(one, two) != seen


def test_absent_chunks_are_not_read() -> None:
    model = small_model()
    batch = small_batch(model.config, ["arm"])
    batch.action_mask[:, 1:3] = False
    with torch.no_grad():
        one = model.video_logits(batch.tokens, batch.actions, "arm", batch.action_mask)
        batch.actions[:, 1:3] = float("nan")
        two = model.video_logits(batch.tokens, batch.actions, "arm", batch.action_mask)
    assert torch.equal(one, two)


def test_what_an_mlp_computes_again_gives_the_gradients_of_its_formula() -> None:
    mlp, norm = MLP(small_config()), torch.nn.LayerNorm(32)
    x = torch.randn(2, 3, 32, generator=torch.Generator().manual_seed(0), requires_grad=True)
    plain = mlp.fc2(torch.nn.functional.gelu(mlp.fc1(norm(x))))
    inputs = [x, *norm.parameters(), *mlp.parameters()]
    found, expected = (torch.autograd.grad(out.square().sum(), inputs) for out in (mlp(x, norm), plain))
    assert all(torch.equal(a, b) for a, b in zip(found, expected))


def test_no_product_is_computed_again() -> None:
    model = small_model(conditioning=("modulation",)).train()
    batch = small_batch(model.config, ["arm"])
    with FlopCounterMode(display=False) as forward:
        loss = model(batch, generator=torch.Generator().manual_seed(0)).loss
    with FlopCounterMode(display=False) as backward:
        loss.backward()
    products = ("aten.addmm", "aten.mm", "aten.bmm", "aten.baddbmm")

    def count(counter: FlopCounterMode) -> int:
        found = counter.get_flop_counts()["Global"]
        return sum(value for name, value in found.items() if str(name) in products)

    assert count(backward) <= 2 * count(forward)


@pytest.mark.parametrize("conditioning", ["modulation", "cross_attention"])
def test_frames_that_nobody_reads_change_neither_features_nor_gradients(conditioning) -> None:
    model = small_model(conditioning=(conditioning,))
    x, made = torch.randn(2, 7, model.config.tokens_per_frame, model.config.width), []
    chunks = small_batch(model.config, ["arm"], frames=7).actions[:1].expand(2, -1, -1)
    for wanted in (0, 3):
        times = paired_times(model.config, 3, 5, "cpu")
        times.wanted = wanted
        given = ActionConditioning(chunks, torch.ones(2, 7, dtype=torch.bool))
        conditions = model.condition(given, Groups.of("arm", 2), times.positions)
        model.zero_grad()
        features = model.trunk(x, conditions, times)
        features[:, 3:].square().sum().backward()
        assert features[:, :wanted].eq(0).all()
        made.append((features[:, 3:], [own.grad for own in model.trunk.parameters() if own.grad is not None]))
    (all_features, all_grads), (features, grads) = made
    assert torch.allclose(features, all_features, atol=1e-5)
    assert all(torch.allclose(a, b, rtol=1e-3, atol=1e-4) for a, b in zip(grads, all_grads, strict=True))


@pytest.mark.parametrize("mask", [None, (5, 5), (1, 1, 5, 5), (7, 1, 5, 5)], ids=str)
def test_many_sequences_are_attended_part_by_part(mask, monkeypatch) -> None:
    q, k, v = torch.randn(3, 7, 2, 5, 4)
    allowed = None if mask is None else torch.ones(mask, dtype=torch.bool).tril(1)
    whole = transformer.attend(q, k, v, allowed, 0.5, causal=mask is None)
    monkeypatch.setattr(transformer, "SEQUENCE_LIMIT", 3)
    assert torch.equal(transformer.attend(q, k, v, allowed, 0.5, causal=mask is None), whole)
