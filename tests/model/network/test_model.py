"""Objectives, losses, states and predictions of the whole model."""

import ast
import itertools
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import hma_model
from hma_data.errors import CheckpointError, HMAError
from hma_model.config import CONDITIONINGS, OBJECTIVES, READOUTS, ActionSpace, Objective
from hma_model.network.masking import draw_video_mask, drop_chunks
from hma_model.network.model import HMA
from hma_model.network.stem import from_digits, patchify, to_digits, unpatchify
from tests.model.network_parts import ARM, HAND, conditions, seeded, small_batch, small_config, small_model

KINDS = ["discrete", "continuous"]


def test_digits_are_low_first_and_come_back() -> None:
    tokens = torch.arange(24)
    digits = to_digits(tokens, (6, 4))
    assert digits[7].tolist() == [1, 1] and digits[5].tolist() == [5, 0]
    assert torch.equal(from_digits(digits, (6, 4)), tokens)


def test_patches_keep_neighbours_together_and_come_back() -> None:
    latents = torch.arange(2 * 3 * 4 * 6).view(1, 2, 3, 4, 6).float()
    patches = patchify(latents, 2)
    assert torch.equal(patches[0, 0, 4].view(3, 2, 2), latents[0, 0, :, 2:4, 2:4])
    assert torch.equal(unpatchify(patches, 2, (2, 3)), latents)


def test_an_untrained_model_knows_nothing() -> None:
    torch.manual_seed(0)
    model = HMA(small_config(width=64, label_smoothing=0.0))
    model.add_embodiment(ARM)
    loss = model(small_batch(model.config, ["arm"] * 8), "forward", seeded()).video_loss
    assert loss is not None and abs(loss.item() - math.log(24)) < 0.1


def test_video_loss_is_the_mean_over_masked_tokens_of_later_frames() -> None:
    model = small_model(label_smoothing=0.0)
    batch = small_batch(model.config, ["arm", "hand.v1", "arm"])
    out = model(batch, "forward", seeded())
    assert not out.masked[:, 0].any() and out.masked[:, 1:].any()
    assert out.video_logits is not None and out.video_loss is not None
    digits = to_digits(batch.tokens, model.config.factored)
    sizes = model.config.factored
    log_p = sum(
        out.video_logits[..., i, : sizes[i]].log_softmax(-1).gather(-1, digits[..., i : i + 1])[..., 0]
        for i in range(len(sizes))
    )
    assert torch.allclose(out.video_loss, -log_p[out.masked].mean(), atol=1e-5)  # type: ignore[index]
    sample = -log_p[1][out.masked[1]].mean()  # type: ignore[index]
    assert torch.allclose(out.per_sample[1], sample, atol=1e-5)


def test_logits_are_not_kept_in_training() -> None:
    model = small_model().train()
    assert model(small_batch(model.config, ["arm"]), "forward", seeded()).video_logits is None


@pytest.mark.parametrize("objective", ["forward", "policy"])
def test_gradients_reach_exactly_the_stems_present(objective: str) -> None:
    model = small_model().train()
    model.add_embodiment(ActionSpace("third", 2, 1, (0.0, 0.0), (1.0, 1.0), (True, True)))
    model(small_batch(model.config, ["arm", "third"]), objective, seeded()).loss.backward()
    for name in ("arm", "third"):
        assert model.stem(name).input.weight.grad.abs().sum() > 0
        assert model.stem(name).modulation.weight.grad.abs().sum() > 0
    assert all(p.grad is None for part in (model.stem, model.head) for p in part("hand.v1").parameters())
    reached = model.head("arm").policy.weight.grad is not None
    assert reached == (objective == "policy")


def _overfit(objective: str, steps: int, **changes: Any) -> list[float]:
    torch.manual_seed(0)
    values = {"layers": 1, "frames": 3, "grid": (2, 2), "corrupt_max": 0.0, "history_probability": 0.0}
    model = HMA(small_config(**(values | {"label_smoothing": 0.0} | changes)))
    model.add_embodiment(ARM)
    batch, generator = small_batch(model.config, ["arm"] * 4), seeded()
    optimizer = torch.optim.AdamW(model.parameters(), 1e-2, weight_decay=0.0)
    losses = []
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = 1e-2 * (1 - step / steps)
        out = model(batch, objective, generator)
        optimizer.zero_grad()
        out.loss.backward()
        optimizer.step()
        losses.append(out.loss.item())
    return losses


OVERFITS = [  # objective, changes, steps, share of the first losses that the last ones stay below
    ("forward", {}, 120, 0.06),
    ("policy", {}, 200, 0.06),
    # the noise of a nearly clean sample stays unknown
    ("policy", {"action_loss": "diffusion"}, 200, 0.5),
    ("forward", {"kind": "continuous", "grid": (4, 4)}, 200, 0.5),
]


@pytest.mark.parametrize(
    ("objective", "changes", "steps", "share"),
    [OVERFITS[0], *(pytest.param(*one, marks=pytest.mark.slow) for one in OVERFITS[1:])],
)
def test_each_head_overfits_a_handful_of_windows(objective, changes, steps, share):
    losses = _overfit(objective, steps, **changes)
    assert sum(losses[-20:]) / 20 < share * sum(losses[:5]) / 5


COMBINATIONS = [c for size in (1, 2, 3, 4) for c in itertools.combinations(CONDITIONINGS, size)]


@pytest.mark.parametrize("conditioning", COMBINATIONS, ids="+".join)
def test_every_parameter_of_every_combination_of_conditionings_learns(conditioning: tuple[str, ...]) -> None:
    model = small_model(conditioning=conditioning, action_tokens=2).train()
    batch = small_batch(model.config, ["arm", "hand.v1"])
    (model(batch, "full", seeded()).loss + model(batch, "inverse", seeded()).loss).backward()
    idle = [
        name
        for name, parameter in model.named_parameters()
        if parameter.grad is None or not parameter.grad.abs().sum() > 0
    ]
    assert not idle


@pytest.mark.parametrize("layout", ["ours", "released"])
def test_action_loss_is_the_mean_over_present_chunks(layout: str) -> None:
    model = small_model(corrupt_max=0.0, layout=layout, objectives={"forward": 1, "policy": 1, "inverse": 1})
    batch = small_batch(model.config, ["arm", "hand.v1", "arm"])
    batch.action_mask[0, 1] = batch.action_mask[1, 3:] = False
    out = model(batch, "policy", seeded(5))
    generator = seeded(5)
    draw_video_mask(model.config, 3, 5, generator)
    known = batch.action_mask & ~drop_chunks(batch.action_mask, generator)
    chunks = model.predict_actions(batch.tokens, batch.embodiment, batch.actions, known)
    losses = []
    for row, name in enumerate(batch.embodiment):
        stem = model.stem(name)
        one, two = (x[row, :, : stem.input.in_features] for x in (chunks, batch.actions))
        if layout == "ours":
            one, two = stem.normalizer(one), stem.normalizer(two)
        losses.append((one - two).pow(2).mean(-1)[batch.action_mask[row]])
    assert out.action_loss is not None
    if layout == "released":
        assert torch.allclose(out.action_loss, torch.cat(losses).mean(), rtol=1e-4)
    else:  # raw predictions have lost what the head says of the hand's constant dim
        expected = torch.stack([losses[0].mean(), losses[2].mean()])
        assert torch.allclose(out.per_sample[[0, 2]], expected, rtol=1e-4)


def test_predicted_actions_are_raw_and_padded() -> None:
    model = small_model(objectives={"forward": 1, "policy": 1, "inverse": 1})
    batch = small_batch(model.config, ["arm", "hand.v1"])
    chunks = model.predict_actions(batch.tokens, batch.embodiment)
    assert chunks.shape == (2, 5, ARM.chunk_dim)
    assert (chunks[1, :, HAND.chunk_dim :] == 0).all()
    assert (chunks[1, :, 1] == 3.0).all()  # the dim that never varies
    alone = model.predict_actions(batch.tokens[1:], "hand.v1")
    assert torch.allclose(chunks[1:, :, :2], alone, atol=1e-5)


@pytest.mark.parametrize(
    ("objectives", "readout", "says"),
    [
        ({"forward": 1.0}, "policy", "act, but for forward.*objectives={policy: 1.0} or {full: 1.0}"),
        ({"passive": 1.0, "policy": 0.0}, "policy", "act, but for passive"),
        ({"policy": 1.0}, "inverse", "infer actions, but for policy.*objectives={inverse: 1.0}"),
        ({"full": 1.0}, "inverse", "infer actions, but for full"),
        ({"inverse": 1.0}, "policy", "act, but for inverse"),
    ],
)
def test_readouts_that_nothing_trained_are_refused(objectives, readout, says) -> None:
    model = small_model(objectives=objectives)
    with pytest.raises(HMAError, match=says):
        model.predict_actions(small_batch(model.config, ["arm"]).tokens, "arm", readout=readout)


def test_the_chunk_after_the_last_frame_is_unknown_to_a_model_that_only_infers() -> None:
    model = small_model(objectives={"inverse": 1.0})
    chunks = model.predict_actions(small_batch(model.config, ["arm"]).tokens, "arm", readout="inverse")
    assert chunks[:, :-1].isfinite().all() and chunks[:, -1].isnan().all()


def test_inverse_reads_the_frame_after_and_policy_does_not() -> None:
    model = small_model(objectives={"forward": 1, "policy": 1, "inverse": 1})
    batch = small_batch(model.config, ["arm"])
    changed = batch.tokens.clone()
    changed[:, 3] = (changed[:, 3] + 1) % 24
    for readout, first in (("policy", 3), ("inverse", 2)):
        one, two = (model.predict_actions(t, "arm", readout=readout) for t in (batch.tokens, changed))
        change = (one - two).abs().amax((0, 2))
        assert (change[:first] == 0).all() and change[first] > 0


def test_masked_latents_are_not_seen() -> None:
    model = small_model(kind="continuous")
    batch = small_batch(model.config, ["arm"])
    mask = torch.zeros(1, 5, 8, 8, dtype=torch.bool)
    mask[:, 2, 2:4, 4:6] = True
    with torch.no_grad():
        one = conditions(model, batch.latents, mask, batch.actions, "arm")
        batch.latents[:, 2, :, 2:4, 4:6] += 5
        assert torch.equal(one, conditions(model, batch.latents, mask, batch.actions, "arm"))
        batch.latents[:, 2, :, 0, 0] += 5
        assert not torch.equal(one, conditions(model, batch.latents, mask, batch.actions, "arm"))


@pytest.mark.parametrize("kind", KINDS)
def test_states_divide_and_join_without_loss(kind: str) -> None:
    model = small_model(kind=kind, conditioning=("concat", "modulation"))
    other = HMA(model.config).eval()
    other.load_trunk(model.trunk_state())
    for name in model.embodiments:
        other.load_embodiment(name, model.stem_state(name), model.head_state(name))
    assert other.embodiments.keys() == model.embodiments.keys()
    batch = small_batch(model.config, ["arm", "hand.v1"])
    assert torch.equal(model(batch, "full", seeded()).loss, other(batch, "full", seeded()).loss)
    parts = {**model.trunk_state(), **model.stem_state("arm"), **model.head_state("arm")}
    assert len(parts) == len({id(p) for p in parts.values()})


def test_a_state_that_does_not_fit_names_every_key() -> None:
    model = small_model()
    state = model.trunk_state()
    state["trunk.extra"] = state.pop("trunk.position")
    state["readout.linear.bias"] = torch.zeros(3)
    with pytest.raises(CheckpointError) as error:
        model.load_trunk(state)
    assert all(
        name in str(error.value) for name in ("trunk.extra", "trunk.position", "readout.linear.bias is (3,)")
    )


def test_another_embodiment_of_the_same_id_is_refused() -> None:
    model = small_model()
    model.add_embodiment(ARM)
    with pytest.raises(CheckpointError, match="arm"):
        model.add_embodiment(ActionSpace("arm", 2, 1, (0.0, 0.0), (1.0, 1.0), (True, True)))


def test_an_embodiment_that_is_not_there_is_named() -> None:
    model = small_model()
    with pytest.raises(HMAError, match="dog: is not in the model, which has: arm, hand.v1"):
        model.video_logits(small_batch(model.config, ["arm"]).tokens, None, "dog")


def test_a_batch_of_another_tokenizer_is_refused() -> None:
    model = small_model()
    batch = small_batch(model.config, ["arm"])
    batch.tokens = batch.tokens[:, :, :2]
    with pytest.raises(HMAError, match=r"a frame has the shape \(2, 4\), but the model takes \(4, 4\)"):
        model(batch)


PACKAGE = Path(hma_model.__file__).parent
NAMES = set(OBJECTIVES) | set(READOUTS)


def compared_names(source: str) -> list[str]:
    """Return the names of objectives and readouts that stand in a comparison, a match or a set operation."""
    found: list[str] = []
    for node in ast.walk(ast.parse(source)):
        operands: list[ast.expr] = []
        if isinstance(node, ast.Compare):
            operands = [node.left, *node.comparators]
        elif isinstance(node, ast.BinOp):
            operands = [node.left, node.right]
        elif isinstance(node, ast.MatchValue):
            operands = [node.value]
        for operand in operands:
            parts = operand.elts if isinstance(operand, ast.Tuple | ast.List | ast.Set) else [operand]
            found += [str(one.value) for one in parts if isinstance(one, ast.Constant) and one.value in NAMES]
    return found


def test_no_module_compares_the_names() -> None:
    wrong = {
        str(path.relative_to(PACKAGE)): names
        for path in PACKAGE.rglob("*.py")
        if (names := compared_names(path.read_text(encoding="utf-8")))
    }
    assert not wrong


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
@pytest.mark.parametrize("objective", OBJECTIVES.values(), ids=list(OBJECTIVES))
def test_losses_follow_the_row(kind: str, objective: Objective) -> None:
    model = small_model(kind=kind)
    batch = small_batch(model.config, ["arm", "hand.v1", "arm", "arm"])
    out = model(batch, objective.name, torch.Generator().manual_seed(0))
    out.loss.backward()
    assert out.objective == objective.name
    assert (out.video_loss is not None) == bool(out.masked.any()) == objective.predicts_video
    assert (out.action_loss is not None) == (objective.readout is not None)
    head = model.head("arm")
    learned = {name for name in READOUTS if head.get_submodule(name).weight.grad is not None}
    assert learned == ({objective.readout.name} if objective.readout else set())
    stem = model.stem("arm").input.weight.grad
    assert (stem is not None and bool(stem.any())) == objective.sees_actions


@pytest.mark.parametrize("objective", sorted(OBJECTIVES))
def test_a_callers_own_batch_needs_no_more_than_frames_actions_and_names(objective: str) -> None:
    model = small_model()
    batch = small_batch(model.config, ["arm", "hand.v1"])
    names = ("embodiment", "actions", "action_mask", "tokens", "latents")
    own = SimpleNamespace(**{name: getattr(batch, name) for name in names})
    losses = [model(one, objective, torch.Generator().manual_seed(0)).loss for one in (batch, own)]
    assert torch.equal(*losses)


def test_an_unknown_name_is_refused() -> None:
    model = small_model()
    batch = small_batch(model.config, ["arm"])
    with pytest.raises(HMAError, match="'dream' is unknown.*forward, passive, policy, full, inverse"):
        model(batch, "dream")
    with pytest.raises(HMAError, match="'dream' is unknown.*policy, inverse"):
        model.predict_actions(batch.tokens, "arm", readout="dream")
