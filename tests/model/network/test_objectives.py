"""The table of objectives: losses follow its rows, and no other code compares the names."""

import ast
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import hma_model
from hma_data.errors import HMAError
from hma_model.config import OBJECTIVES, READOUTS, Objective
from tests.model.network_parts import small_batch, small_model

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
