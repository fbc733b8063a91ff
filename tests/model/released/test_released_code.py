"""Import and export against the released code itself, where it can be imported as `hma`.

It is not a dependency: these tests run where its repository, `mup` and `einops` are on the path. Its weights
are made here at random, saved and loaded by its own `save_pretrained` and `from_pretrained`.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hma_data.registry.embodiment import Embodiment
from hma_model import hub
from hma_model.checkpoint.io import save
from hma_model.config import POLICY, ActionSpace, HMAConfig
from hma_model.network.model import HMA
from tests.model.network_parts import conditions

os.environ.setdefault("XFORMERS_DISABLED", "true")  # read when its attention is imported
try:
    from hma import config as configs
    from hma.model import st_mar as continuous
    from hma.model import st_mask_git as released
except ImportError:
    released = None

pytestmark = pytest.mark.skipif(
    released is None, reason="the paper's released code is not on the path as `hma`, with mup and einops"
)

SIZES = {"arm7": (7, 5), "pusher": (2, 3)}
BASE: dict[str, Any] = {
    "num_layers": 2, "num_heads": 4, "d_model": 32, "T": 5, "S": 16, "num_factored_vocabs": 2,
    "qk_norm": False, "action_network": "concat+modulate", "action_token_size": 4, "init_actions": True,
}  # fmt: skip
LATENTS = {"S": 64, "image_vocab_size": None, "patch_size": 2, "diffloss_d": 2, "diffloss_w": 24}
DISCRETE: dict[str, dict[str, Any]] = {
    "base": {}, "muP": {"use_mup": True, "d_model": 64}, "qk norm": {"qk_norm": True},
    "modulate": {"action_network": "modulate"}, "concat": {"action_network": "concat"},
    "mlp": {"action_network": "mlp"}, "concat+mlp": {"action_network": "concat+mlp"},
    "one action token": {"action_token_size": 1}, "joint": {"jointly_predict_actions": True},
    "joint modulate": {"jointly_predict_actions": True, "action_network": "modulate"},
    "joint mlp, more action tokens than others": {
        "jointly_predict_actions": True, "action_network": "mlp", "action_token_size": 20},
    "joint muP": {"jointly_predict_actions": True, "use_mup": True, "d_model": 64},
    "policy only": {"jointly_predict_actions": True, "jointly_predict_states": False},
    "narrow MLP": {"mlp_ratio": 2.5},
    "one digit": {"image_vocab_size": 1000, "num_factored_vocabs": 1},
    "three digits": {"image_vocab_size": 4096, "num_factored_vocabs": 3},
    "a dim that never varies": {"still": True},
}  # fmt: skip
CONTINUOUS: dict[str, dict[str, Any]] = {
    "base": {}, "muP": {"use_mup": True, "d_model": 256, "num_heads": 8, "num_layers": 1},
    "joint": {"jointly_predict_actions": True}, "modulate": {"action_network": "modulate"},
    "mlp": {"action_network": "mlp"}, "patch of 1": {"patch_size": 1, "S": 16},
    "patch of 4": {"patch_size": 4}, "sixteen channels": {"vae_embed_dim": 16}, "qk norm": {"qk_norm": True},
}  # fmt: skip


def _theirs(folder: Path, kind: str, **changes: Any) -> Any:
    """A model of theirs with random weights, saved to a folder and loaded from it."""
    still = changes.pop("still", False)
    generator = torch.Generator().manual_seed(7)
    stats = []
    for dims, _ in SIZES.values():
        mean, std = torch.randn(dims, generator=generator), torch.rand(dims, generator=generator) + 0.5
        std[0] = 0.0 if still else std[0]
        stats.append([mean.tolist(), std.tolist()])
    values = BASE | (LATENTS if kind == "continuous" else {}) | changes
    values |= {"action_domains": list(SIZES), "d_actions": [a * s for a, s in SIZES.values()]}
    if kind == "continuous":
        model = continuous.STMAR(configs.DiffusionGenieConfig(**values, action_stats=stats))
    else:
        model = released.STMaskGIT(configs.GenieConfig(**values, action_stats=stats))
    with torch.no_grad():
        for parameter in model.parameters():
            scale = parameter.shape[-1] ** -0.5 if parameter.ndim == 2 else 0.2
            parameter.add_(scale * torch.randn(parameter.shape, generator=generator))
    model.save_pretrained(folder)
    return type(model).from_pretrained(str(folder)).eval()


def _close(ours: torch.Tensor, theirs: torch.Tensor) -> None:
    tolerance = 1e-4 * max(1.0, theirs.abs().max().item() / 5)  # what float32 makes of either
    assert (ours - theirs).abs().max() < tolerance


def _actions(model: Any, name: str) -> torch.Tensor:
    dims, stride = SIZES[name]
    stat = model.action_preprocessor[name]
    noise = torch.randn(2, model.config.T, stride, dims, generator=torch.Generator().manual_seed(1))
    return (noise * stat.std + stat.mean).flatten(2)


def _one_by_one(call: Any, x: torch.Tensor, actions: torch.Tensor | None) -> tuple[Any, Any]:
    """Their code cannot leave out the actions of more than one sample when it predicts them."""
    rows = [call(x[i : i + 1], None if actions is None else actions[i : i + 1]) for i in range(len(x))]
    return tuple(None if part[0] is None else torch.cat(part) for part in zip(*rows))  # type: ignore[return-value]


@torch.no_grad()
def _compare_discrete(theirs: Any, ours: HMA) -> None:
    side, config = int(theirs.config.S**0.5), theirs.config
    shape = (2, config.T, side, side)
    tokens = torch.randint(0, config.image_vocab_size + 1, shape, generator=torch.Generator().manual_seed(2))
    for name in SIZES:
        for actions in (_actions(theirs, name), None):
            theirs.relevant_action_mask = None
            logits, chunks = _one_by_one(
                lambda x, a, name=name: theirs.compute_logits(x, action_ids=a, domain=[name]), tokens, actions
            )
            if logits is not None:
                expected = logits.unflatten(1, (config.num_factored_vocabs, -1)).permute(0, 3, 4, 5, 1, 2)
                _close(ours.video_logits(tokens, actions, name), expected)
            if chunks is not None:
                _close(ours.predict_actions(tokens, name, actions), chunks)


@pytest.mark.parametrize("case", DISCRETE)
def test_an_imported_discrete_model_computes_the_same(tmp_path: Path, case: str) -> None:
    theirs = _theirs(tmp_path / "theirs", "discrete", **DISCRETE[case])
    hub.import_released(tmp_path / "theirs", tmp_path / "ours")
    _compare_discrete(theirs, HMA.from_pretrained(str(tmp_path / "ours")))


def test_hidden_chunks_are_hidden_as_in_the_released_code(tmp_path: Path) -> None:
    theirs = _theirs(tmp_path / "theirs", "discrete", jointly_predict_actions=True)
    hub.import_released(tmp_path / "theirs", tmp_path / "ours")
    ours = HMA.from_pretrained(str(tmp_path / "ours"))
    tokens = torch.randint(0, 262144, (2, 5, 4, 4), generator=torch.Generator().manual_seed(2))
    known = torch.rand(2, 5, generator=torch.Generator().manual_seed(3)) < 0.5
    theirs.relevant_action_mask = (~known).long()[..., None, None]
    actions = _actions(theirs, "arm7")
    with torch.no_grad():
        logits, chunks = theirs.compute_logits(tokens, action_ids=actions, domain=["arm7"])
        found = ours.video_logits(tokens, actions, "arm7", known)
    _close(found, logits.unflatten(1, (2, -1)).permute(0, 3, 4, 5, 1, 2))
    _close(ours.predict_actions(tokens, "arm7", actions, known), chunks)


@pytest.mark.parametrize("case", ["base", "modulate", "mlp", "qk norm", "joint"])
@pytest.mark.parametrize("passive", [False, True])
def test_an_imported_model_rolls_out_the_same(tmp_path: Path, case: str, passive: bool) -> None:
    theirs = _theirs(tmp_path / "theirs", "discrete", **DISCRETE[case])
    hub.import_released(tmp_path / "theirs", tmp_path / "ours")
    ours = HMA.from_pretrained(str(tmp_path / "ours"))
    prompt = torch.randint(0, 262144, (1, 2, 4, 4), generator=torch.Generator().manual_seed(2))
    actions = None if passive else _actions(theirs, "arm7")[:1]
    expected = theirs.generate(
        prompt.flatten(1), None, 3 * 16, maskgit_steps=1, action_ids=actions, domain=["arm7"], h=[4], w=[4]
    )
    found = ours.generate(prompt, actions, "arm7", 3, unmask_steps=1, temperature=0.0)
    assert torch.equal(found.flatten(1), expected.reshape(1, -1)[:, 2 * 16 :])


@pytest.mark.parametrize("case", CONTINUOUS)
@torch.no_grad()
def test_an_imported_continuous_model_computes_the_same(tmp_path: Path, case: str) -> None:
    theirs = _theirs(tmp_path / "theirs", "continuous", **CONTINUOUS[case])
    hub.import_released(tmp_path / "theirs", tmp_path / "ours")
    ours, config = HMA.from_pretrained(str(tmp_path / "ours")), theirs.config
    side, generator = int(config.S**0.5), torch.Generator().manual_seed(2)
    latents = torch.randn(2, config.T, side, side, config.vae_embed_dim, generator=generator)
    mask = torch.rand(2, config.T, side, side, generator=generator) < 0.4
    hidden = latents.clone()
    hidden[mask] = theirs.mask_token[0, 0]
    for name in SIZES:
        for actions in (_actions(theirs, name), None):
            z, _ = _one_by_one(
                lambda x, a, name=name: theirs.compute_latents(x, action_ids=a, domain=[name]),
                theirs.patchify(hidden),
                actions,
            )
            found = conditions(ours, latents.permute(0, 1, 4, 2, 3), mask, actions, name)
            _close(found, z.permute(0, 2, 3, 4, 1))
        level, condition = torch.tensor([0, 1, 500, 999]), torch.randn(4, config.d_model, generator=generator)
        noisy = torch.randn(4, SIZES[name][0] * SIZES[name][1], generator=generator)
        noise = theirs.action_diff_losses[name].net(noisy, level, condition)[:, : noisy.shape[1]]
        head = ours.head(name)
        assert head.diffusion is not None
        _close(head.diffusion(noisy, level, head(condition, POLICY)), noise)


SPACES = (
    ActionSpace("arm.v2", 3, 2, (1.0, -2.0, 0.5), (2.0, 0.5, 1.0), (True, True, False)),
    ActionSpace("hand", 2, 1, (0.0, 3.0), (1.0, 0.0), (True, True)),
)
OURS: dict[str, Any] = {
    "layers": 2, "width": 32, "heads": 4, "frames": 5, "grid": (4, 4), "layout": "released",
    "action_alignment": "current", "absent_action": "skip",
}  # fmt: skip
EXPORTED: dict[str, dict[str, Any]] = {
    "modulation": {},
    "concat+modulation": {"conditioning": ("concat", "modulation"), "action_tokens": 3},
    "actions": {"absent_action": "tokens", "objectives": {"full": 1.0}},
    "qk norm": {"qk_norm": True},
    "muP": {
        "mup": True,
        "width": 64,
        "conditioning": ("concat",),
        "absent_action": "tokens",
        "objectives": {"full": 1.0},
    },
    "three digits": {"factored": (8, 8, 8)},
}


def _yaml(space: ActionSpace) -> str:
    parts = [{"key": f"a{i}", "dims": 1, "normalize": flag} for i, flag in enumerate(space.normalize)]
    values = {
        "id": space.id, "kind": "simulation", "frequency_hz": 2, "stride": space.stride,
        "action": {"space": "mixed", "components": parts}, "cameras": [{"name": "c", "key": "c"}],
        "source": {"format": "hdf5"},
    }  # fmt: skip
    return Embodiment.from_values(values, space.id).to_yaml()


@pytest.mark.parametrize("case", EXPORTED)
@torch.no_grad()
def test_the_released_code_reads_an_exported_model(tmp_path: Path, case: str) -> None:
    torch.manual_seed(0)
    ours = HMA(HMAConfig(**(OURS | EXPORTED[case])))
    for space in SPACES:
        ours.add_embodiment(space)
    for name, parameter in ours.named_parameters():
        parameter.add_(0.1 * torch.randn_like(parameter))
        if ".k_norm." in name:
            parameter.copy_(ours.get_parameter(name.replace(".k_norm.", ".q_norm.")))
    ours.eval()
    stats = {s.id: {"action": {"mean": list(s.mean), "std": list(s.std)}} for s in SPACES}
    yaml = {space.id: _yaml(space) for space in SPACES}
    ours.config = ours.config.replace(tokenizer={"name": "x"})
    save(ours, tmp_path / "ours", embodiment_yaml=yaml, stats=stats, cards={})
    hub.export_released(tmp_path / "ours", tmp_path / "out")
    theirs = released.STMaskGIT.from_pretrained(str(tmp_path / "out"), strict=True).eval()
    tokens = torch.randint(0, ours.config.vocab_size + 1, (2, 5, 4, 4))
    for space in SPACES:
        given, name = torch.randn(2, 5, space.chunk_dim), space.id.replace(".", "_")
        given[..., np.tile(space.std, space.stride) == 0] = 3.0
        for actions in (given, None):
            logits, chunks = _one_by_one(
                lambda x, a, name=name: theirs.compute_logits(x, action_ids=a, domain=[name]), tokens, actions
            )
            expected = logits.unflatten(1, (len(ours.config.factored), -1)).permute(0, 3, 4, 5, 1, 2)
            _close(ours.video_logits(tokens, actions, space.id), expected)
            if chunks is not None:
                _close(ours.predict_actions(tokens, space.id, actions), chunks)
