"""The network against the paper's released code: weights in its layout, inputs and outputs it computed.

Everything goes the way a user's checkpoint goes: imported to a folder, loaded from it.
"""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from hma_model import hub
from hma_model.network.model import HMA
from tests.model.network_parts import conditions

pytestmark = pytest.mark.real


@pytest.fixture(scope="module")
def imported(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    out = tmp_path_factory.mktemp("imported")
    names = ("discrete", "discrete_mup", "continuous")
    return {
        name: hub.import_released(real_data / "parity" / name, out / name).folder
        for name in names
        if (real_data / "parity" / name).is_dir()
    }


def _io(folder: Path) -> tuple[dict[str, torch.Tensor], list[str]]:
    case = json.loads((folder / "case.json").read_text())
    with np.load(folder / "io.npz") as arrays:
        return {name: torch.from_numpy(arrays[name]) for name in arrays}, case["domains"]


@pytest.mark.parametrize("name", ["discrete", "discrete_mup"])
def test_logits_equal_the_released_code(imported: dict[str, Path], real_data: Path, name: str) -> None:
    io, embodiments = _io(real_data / "parity" / name)
    model = HMA.from_pretrained(str(imported[name]), embodiments=embodiments)
    for embodiment in embodiments:
        with torch.no_grad():
            logits = model.video_logits(io[f"{embodiment}.tokens"], io[f"{embodiment}.actions"], embodiment)
        expected = io[f"{embodiment}.logits"].unflatten(1, (2, 512)).permute(0, 3, 4, 5, 1, 2)
        assert (logits - expected).abs().max() < 1e-4


def test_conditions_equal_the_released_code(imported: dict[str, Path], real_data: Path) -> None:
    io, embodiments = _io(real_data / "parity" / "continuous")
    for embodiment in embodiments:
        model = HMA.from_pretrained(str(imported["continuous"]), embodiments=[embodiment])
        latents = io[f"{embodiment}.latents"].permute(0, 1, 4, 2, 3)
        with torch.no_grad():
            z = conditions(model, latents, io[f"{embodiment}.mask"], io[f"{embodiment}.actions"], embodiment)
        assert (z - io[f"{embodiment}.z"].permute(0, 2, 3, 4, 1)).abs().max() < 1e-4


def test_embodiments_of_one_released_model_may_share_a_batch(imported, real_data) -> None:
    io, embodiments = _io(real_data / "parity" / "discrete")
    model = HMA.from_pretrained(str(imported["discrete"]))
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


@pytest.mark.parametrize("name", ["discrete", "discrete_mup", "continuous"])
def test_an_imported_checkpoint_exports_to_the_same_tensors(imported, real_data, tmp_path, name) -> None:
    hub.export_released(imported[name], tmp_path / "out")
    before = load_file(real_data / "parity" / name / "model.safetensors")
    after = load_file(tmp_path / "out" / "model.safetensors")
    config = json.loads((real_data / "parity" / name / "config.json").read_text())
    used = (
        16 + config["action_token_size"]
    )  # of the continuous model's table, which is longer than its frames
    for state in (before, after):
        state["pos_embed_TSC"] = state["pos_embed_TSC"][:, :, :used]
    assert before.keys() == after.keys()
    for key, tensor in before.items():
        assert torch.allclose(tensor.float(), after[key], atol=1e-6), key


def test_statistics_and_sizes_of_each_domain_are_carried(imported: dict[str, Path], real_data: Path) -> None:
    from hma_model.checkpoint.io import Checkpoint

    case = json.loads((real_data / "parity" / "discrete" / "case.json").read_text())
    state = load_file(real_data / "parity" / "discrete" / "model.safetensors")
    checkpoint = Checkpoint.open(imported["discrete"])
    for domain, dims, stride in zip(case["domains"], case["action_dims"], case["strides"]):
        embodiment = checkpoint.embodiment(domain)
        assert (embodiment.action_dim, embodiment.stride) == (dims, stride)
        for part in ("mean", "std"):
            expected = state[f"action_preprocessor.{domain}.{part}"].float().tolist()
            assert checkpoint.stats(domain)["action"][part] == expected
