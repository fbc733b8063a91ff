"""The network against the paper's released code, on weights and outputs in its layout."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from hma_data.errors import CheckpointError
from hma_model.model import HMA
from hma_model.released import config_from_released, state_from_released

pytestmark = pytest.mark.real


def _load(folder: Path) -> tuple[HMA, dict[str, torch.Tensor], list[str]]:
    config = json.loads((folder / "config.json").read_text())
    case = json.loads((folder / "case.json").read_text())
    model = HMA(config_from_released(config, case)).eval()
    trunk, parts = state_from_released(load_file(folder / "model.safetensors"), model.config)
    model.load_trunk(trunk)
    for embodiment, (stem, head) in parts.items():
        model.load_embodiment(embodiment, stem, head)
    with np.load(folder / "io.npz") as arrays:
        return model, {name: torch.from_numpy(arrays[name]) for name in arrays}, case["domains"]


@pytest.mark.parametrize("name", ["discrete", "discrete_mup"])
def test_logits_equal_the_released_code(real_data: Path, name: str) -> None:
    model, io, embodiments = _load(real_data / "parity" / name)
    for embodiment in embodiments:
        with torch.no_grad():
            logits = model.video_logits(io[f"{embodiment}.tokens"], io[f"{embodiment}.actions"], embodiment)
        expected = io[f"{embodiment}.logits"].unflatten(1, (2, 512)).permute(0, 3, 4, 5, 1, 2)
        assert (logits - expected).abs().max() < 1e-4


def test_conditions_equal_the_released_code(real_data: Path) -> None:
    model, io, embodiments = _load(real_data / "parity" / "continuous")
    for embodiment in embodiments:
        latents = io[f"{embodiment}.latents"].permute(0, 1, 4, 2, 3)
        with torch.no_grad():
            z = model.video_conditions(
                latents, io[f"{embodiment}.mask"], io[f"{embodiment}.actions"], embodiment
            )
        assert (z - io[f"{embodiment}.z"].permute(0, 2, 3, 4, 1)).abs().max() < 1e-4


def test_embodiments_of_one_released_model_may_share_a_batch(real_data: Path) -> None:
    model, io, embodiments = _load(real_data / "parity" / "discrete")
    widest = max(io[f"{e}.actions"].shape[-1] for e in embodiments)
    pads = [(0, widest - io[f"{e}.actions"].shape[-1]) for e in embodiments]
    actions = torch.stack(
        [
            torch.nn.functional.pad(io[f"{e}.actions"][i], pad)
            for i in (0, 1)
            for e, pad in zip(embodiments, pads)
        ]
    )
    tokens = torch.stack([io[f"{e}.tokens"][i] for i in (0, 1) for e in embodiments])
    with torch.no_grad():
        mixed = model.video_logits(tokens, actions, embodiments * 2)
    for row, name in enumerate(embodiments * 2):
        expected = io[f"{name}.logits"][row // 2].unflatten(0, (2, 512)).permute(2, 3, 4, 0, 1)
        assert (mixed[row] - expected).abs().max() < 1e-4


def test_a_missing_released_tensor_is_named(real_data: Path) -> None:
    folder = real_data / "parity" / "discrete"
    config = config_from_released(json.loads((folder / "config.json").read_text()))
    state = load_file(folder / "model.safetensors")
    del state["out_x_proj.weight"]
    with pytest.raises(CheckpointError, match=r"out_x_proj\.weight"):
        state_from_released(state, config)


def test_a_layout_that_was_never_released_is_refused(real_data: Path) -> None:
    config = json.loads((real_data / "parity" / "discrete" / "config.json").read_text())
    with pytest.raises(CheckpointError, match="cross_attention"):
        config_from_released(config | {"action_network": "cross_attention"})
