"""The precision of a run: what auto chooses, what a resumed run keeps, and what is refused."""

import json

import pytest
import torch

from hma_data.errors import RecipeError
from hma_model.config import HMAConfig
from hma_model.training import runtime
from hma_model.training.loop import train
from hma_model.training.recipe import make_recipe
from hma_model.training.runtime import attention_form, choose_precision
from tests.model.runs import TINY, train_until
from tests.model.shards import make_shards

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


@pytest.fixture(scope="module")
def shards(tmp_path_factory) -> str:
    return str(make_shards(tmp_path_factory.mktemp("shards") / "arm", "arm"))


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


def test_auto_takes_fp32_where_the_processor_has_no_bfloat16(no_bfloat16):
    assert choose_precision(AUTO, HMAConfig(), CPU) == ("fp32", "this processor does not support bf16")


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


def test_bf16_on_a_processor_without_it_is_refused_in_one_line(shards, tmp_path, no_bfloat16):
    asked = make_recipe({**TINY, "data": shards, "precision": "bf16"})
    with pytest.raises(
        RecipeError, match=r"precision=bf16: this processor does not support bf16 — use precision=auto"
    ):
        train(asked, out=tmp_path / "run", show=False)
    assert not (tmp_path / "run").exists()


def test_a_resumed_run_keeps_the_precision_that_it_began_with(shards, tmp_path, bfloat16, capsys):
    given, out = {**TINY, "data": shards}, tmp_path / "run"
    train_until(make_recipe({**given, "precision": "bf16"}), out, 3)
    train(make_recipe({**given, "precision": "auto"}), out=out)  # of this width, auto alone takes fp32
    assert "precision bf16: as at the start of the run; attention: matrix products" in capsys.readouterr().err
    assert json.loads((out / "recipe.json").read_text())["precision"] == "bf16"
    with pytest.raises(RecipeError, match="precision: 'bf16', now 'fp32'"):
        train(make_recipe(given), out=out, show=False)


def test_a_run_says_its_precision_and_attention_first(shards, tmp_path, no_bfloat16, capsys):
    train(make_recipe({**TINY, "data": shards, "precision": "auto"}), out=tmp_path / "run")
    said = capsys.readouterr().err.splitlines()[0]
    assert "precision fp32: this processor does not support bf16; attention: torch's" in said


def test_a_unet_has_no_attention():
    assert attention_form(AUTO, HMAConfig(**UNET), CPU) == "no attention"
