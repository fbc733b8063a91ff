"""Released checkpoints in and out, without the released code: every layout there and back, and bad ones."""

import json
import pickle
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from typer.testing import CliRunner

from hma_data.errors import CheckpointError, HMAError, HubError
from hma_data.registry.embodiment import find
from hma_data.storage.files import to_json
from hma_model import hub
from hma_model.checkpoint.folder import Checkpoint, require_tokenizer
from hma_model.cli import app
from hma_model.config import ActionSpace
from hma_model.network.model import HMA
from hma_model.released.config import config_to_released
from hma_model.released.state import state_to_released
from tests.command import fails, hma
from tests.hub_server import connect, serve
from tests.model.network_parts import conditions, small_batch, small_config

RELEASED: dict[str, Any] = {
    "layout": "released", "action_alignment": "current", "absent_action": "skip", "base_width": 256,
    "factored": (6, 6), "diffusion_target": "noise",
}  # fmt: skip
CONTINUOUS = {"kind": "continuous", "action_loss": "diffusion", "latent_scale": 0.18215}
LAYOUTS: dict[str, dict[str, Any]] = {
    "concat+modulate": {"conditioning": ("concat", "modulation"), "action_tokens": 3},
    "modulate": {"conditioning": ("modulation",)},
    "concat": {"conditioning": ("concat",), "action_tokens": 1},
    "mlp": {"conditioning": ("add",)},
    "joint": {"conditioning": ("concat", "modulation"), "action_tokens": 3, "absent_action": "tokens",
              "objectives": {"full": 1.0}},
    "joint modulate": {"absent_action": "tokens", "action_tokens": 2, "objectives": {"full": 1.0}},
    "qk norm": {"qk_norm": True},
    "mup": {"mup": True},
    "continuous": CONTINUOUS,
    "continuous joint": CONTINUOUS | {"absent_action": "tokens", "objectives": {"full": 1.0}},
}  # fmt: skip


def _model(seed: int = 0, **changes: Any) -> HMA:
    torch.manual_seed(seed)
    model = HMA(small_config(**(RELEASED | changes)))
    model.add_embodiment(ActionSpace("arm", 3, 2, (1.0, -2.0, 0.5), (2.0, 0.5, 0.0), (True,) * 3, "divide"))
    model.add_embodiment(ActionSpace("pusher", 2, 1, (0.0, 3.0), (1.0, 1e-8), (True, True), "divide"))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
        for name, parameter in model.named_parameters():
            if ".k_norm." in name:
                parameter.copy_(model.get_parameter(name.replace(".k_norm.", ".q_norm.")))
        if model.config.action_loss == "diffusion":
            for name in model.embodiments:
                model.head(name).policy.weight.copy_(torch.eye(model.config.width))
                model.head(name).policy.bias.zero_()
    return model.eval()


def _write(model: HMA, folder: Path, **config: Any) -> Path:
    """The model in the released layout, as the release's own code would have written it."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = {name: (model.stem_state(name), model.head_state(name)) for name in model.embodiments}
    save_file(state_to_released(model.trunk_state(), parts, model.config), folder / "model.safetensors")
    values = config_to_released(model.config, folder) | {
        "action_domains": list(model.embodiments),
        "d_actions": [space.chunk_dim for space in model.embodiments.values()],
    }
    (folder / "config.json").write_bytes(to_json(values | config))
    return folder


def _outputs(model: HMA) -> list[torch.Tensor]:
    outputs = []
    for name, space in model.embodiments.items():
        batch = small_batch(model.config, [name, name])
        mean = torch.tensor(space.mean).repeat(space.stride)
        for actions in (mean.expand(2, model.config.frames, -1), None):
            with torch.no_grad():
                if model.config.kind == "discrete":
                    outputs.append(model.video_logits(batch.tokens, actions, name))
                    if model.config.trained_readouts:
                        outputs.append(model.predict_actions(batch.tokens, name, actions))
                else:
                    mask = torch.rand(2, model.config.frames, 8, 8, generator=torch.Generator()) < 0.3
                    outputs.append(conditions(model, batch.latents, mask, actions, name))
                    generator = torch.Generator().manual_seed(1)
                    if model.config.trained_readouts:
                        chunks = model.predict_actions(batch.latents, name, actions, generator=generator)
                        outputs.append(chunks)
    return outputs


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_comes_in_and_goes_out_without_loss(tmp_path: Path, layout: str) -> None:
    model = _model(**LAYOUTS[layout])
    source = _write(model, tmp_path / "released")
    hub.import_released(source, tmp_path / "ours")
    imported = HMA.from_pretrained(str(tmp_path / "ours"))
    for expected, found in zip(_outputs(model), _outputs(imported), strict=True):
        assert torch.allclose(expected, found, atol=1e-5)
    hub.export_released(tmp_path / "ours", tmp_path / "again")
    before, after = (load_file(folder / "model.safetensors") for folder in (source, tmp_path / "again"))
    assert before.keys() == after.keys()
    assert all(torch.equal(before[key], after[key]) for key in before)


@pytest.mark.parametrize("suffix", ["pytorch_model.bin", "nested.bin", "wrapped.safetensors"])
def test_other_files_of_weights_come_in(tmp_path: Path, suffix: str) -> None:
    model = _model()
    source = _write(model, tmp_path / "released")
    state = load_file(source / "model.safetensors")
    (source / "model.safetensors").unlink()
    if suffix == "pytorch_model.bin":
        torch.save(state, source / suffix)
    elif suffix == "nested.bin":
        torch.save({"state_dict": state}, source / suffix)
    else:
        save_file({f"module.{key}": value for key, value in state.items()}, source / suffix)
    path = source if suffix == "pytorch_model.bin" else source / suffix
    made = hub.import_released(path, tmp_path / "ours")
    assert made.embodiments == ("arm", "pusher")


def test_a_model_without_action_domains_comes_in(tmp_path: Path) -> None:
    model = HMA(small_config(**RELEASED)).eval()
    source = _write(model, tmp_path / "released", action_domains=None, d_actions=None)
    assert hub.import_released(source, tmp_path / "ours").embodiments == ()
    imported = HMA.from_pretrained(str(tmp_path / "ours"))
    tokens = small_batch(model.config, ["arm"]).tokens
    with torch.no_grad():
        assert torch.equal(
            imported.video_logits(tokens, None, "arm"), model.video_logits(tokens, None, "arm")
        )


def test_only_the_domains_asked_for_are_taken(tmp_path: Path) -> None:
    source = _write(_model(), tmp_path / "released")
    assert hub.import_released(source, tmp_path / "ours", embodiments=["pusher"]).embodiments == ("pusher",)
    with pytest.raises(CheckpointError, match=r"no domain 'dog'.*arm, pusher"):
        hub.import_released(source, tmp_path / "ours", embodiments=["dog"])


def test_a_domain_of_the_registry_gets_its_yaml_but_the_released_normalisation(tmp_path: Path) -> None:
    known = find("language_table")
    model = _model()
    dims = known.action_dim
    space = ActionSpace(known.id, dims, 3, (0.5,) * dims, (2.0,) * dims, (True,) * dims, "divide")
    model.add_embodiment(space)
    hub.import_released(_write(model, tmp_path / "released"), tmp_path / "ours")
    checkpoint = Checkpoint.open(tmp_path / "ours")
    found = checkpoint.embodiment(known.id)
    assert found.stride == 3 and found.normalize_mask.all() and found.source == known.source
    assert checkpoint.embodiment("arm").frequency_hz == "unknown"
    assert HMA.from_pretrained(str(tmp_path / "ours")).embodiments[known.id] == space


def test_names_that_are_no_ids_become_ones(tmp_path: Path) -> None:
    model = _model()
    source = _write(model, tmp_path / "released")
    state = {
        k.replace(".pusher.", ".Pusher V2."): v for k, v in load_file(source / "model.safetensors").items()
    }
    save_file(state, source / "model.safetensors")
    values = json.loads((source / "config.json").read_text()) | {"action_domains": ["arm", "Pusher V2"]}
    (source / "config.json").write_text(json.dumps(values))
    made = hub.import_released(source, tmp_path / "ours")
    assert made.embodiments == ("arm", "pusher_v2")
    assert made.card("pusher_v2")["data"]["released_domain"] == "Pusher V2"


def test_the_tokenizer_is_the_papers_where_the_sizes_are(tmp_path: Path) -> None:
    from hma_data.tokenizers.base import TokenizerSpec

    model = _model(factored=(512, 512), grid=(16, 16), layers=1, frames=2)
    source = _write(model, tmp_path / "released")
    config = hub.import_released(source, tmp_path / "ours").config
    assert config.tokenizer["name"] == "magvit2" and config.tokenizer["image_size"] == 256
    shards = TokenizerSpec(
        "magvit2", 1, "discrete", 256, (16, 16), 2**18, (512, 512), weights_sha256="f" * 64
    )
    require_tokenizer(config, shards, "shards")
    assert (
        hub.import_released(source, tmp_path / "fsq", tokenizer="fsq-16").config.tokenizer["name"] == "fsq-16"
    )
    with pytest.raises(CheckpointError, match="fsq-8"):
        hub.import_released(source, tmp_path / "no", tokenizer="fsq-8")


def test_a_repository_of_the_hub_comes_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = _write(_model(), tmp_path / "released")
    files = {name: (source / name).read_bytes() for name in ("config.json", "model.safetensors")}
    with serve() as server:
        connect(monkeypatch, server, tmp_path / "cache", None)
        repository = server.create("liruiw/hma-base-disc")
        repository.commit({**files, "README.md": b"", "optimizer.bin": b"x"})
        made = hub.import_released("liruiw/hma-base-disc", tmp_path / "ours")
        assert made.embodiments == ("arm", "pusher")
        assert sorted(server.sent()) == sorted(files)
        assert made.card("arm")["data"]["released_checkpoint"] == "liruiw/hma-base-disc"
        repository.commit({"config.json": None})
        with pytest.raises(HubError, match=r"has no config\.json"):
            hub.import_released("liruiw/hma-base-disc", tmp_path / "again")


def _truncate(folder: Path) -> None:
    path = folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-100])


def _edit(change: Any) -> Any:
    def edit(folder: Path) -> None:
        state = load_file(folder / "model.safetensors")
        change(state)
        save_file(state, folder / "model.safetensors")

    return edit


def _configure(**changes: Any) -> Any:
    def configure(folder: Path) -> None:
        values = json.loads((folder / "config.json").read_text())
        values = {key: value for key, value in (values | changes).items() if value != "gone"}
        (folder / "config.json").write_text(json.dumps(values))

    return configure


def _pickle(folder: Path) -> None:
    (folder / "model.safetensors").unlink()
    (folder / "pytorch_model.bin").write_bytes(pickle.dumps({"a": Path("x")}))


def _saved(value: Any) -> Any:
    def write(folder: Path) -> None:
        (folder / "model.safetensors").unlink()
        torch.save(value, folder / "pytorch_model.bin")

    return write


def _noise(folder: Path) -> None:
    _saved({})(folder)
    (folder / "pytorch_model.bin").write_bytes(b"x" * 99)


def _another(folder: Path) -> None:
    save_file({"encoder.conv_in.weight": torch.zeros(3)}, folder / "model.safetensors")


BAD = {
    "truncated": (_truncate, "not a complete safetensors file"),
    "missing statistics": (_edit(lambda s: s.pop("action_preprocessor.arm.mean")), "preprocessor.arm.mean"),
    "extra key": (_edit(lambda s: s.update(lora=torch.zeros(2))), "unknown lora"),
    "another shape": (_edit(lambda s: s.update(pos_embed_TSC=torch.zeros(1, 9, 17, 32))), "pos_embed_TSC is"),
    "not finite": (_edit(lambda s: s["out_x_proj.bias"].fill_(float("nan"))), "not finite"),
    "negative std": (_edit(lambda s: s["action_preprocessor.arm.std"].fill_(-1.0)), "negative"),
    "another architecture": (_another, "lacks the domains arm, pusher"),
    "another architecture, no domains named": (
        lambda f: (_another(f), _configure(action_domains=None)(f)),
        "not the model that config.json describes: missing .* and .* more",
    ),
    "pickle of objects": (_pickle, "holds more than tensors"),
    "empty": (_saved({}), "without weights by name"),
    "a file of noise": (_noise, "is not a torch checkpoint"),
    "no weights": (lambda f: (f / "model.safetensors").unlink(), "has no model.safetensors or pytorch_model"),
    "no config": (lambda f: (f / "config.json").unlink(), "config.json"),
    "broken config": (lambda f: (f / "config.json").write_text("{"), "not valid JSON"),
    "config of something else": (_configure(d_model="gone"), "lacks d_model"),
    "config with text for a number": (_configure(num_layers="two"), "num_layers is 'two'"),
    "config of a billion layers": (_configure(num_layers=10**9), "num_layers is 1000000000"),
    "config of no vocabulary": (_configure(image_vocab_size=-4), "wrong type"),
    "config of another width": (_configure(d_model=64), r"is \(.*, not \("),
    "heads that do not divide": (_configure(num_heads=5), "heads"),
    "no power": (_configure(image_vocab_size=37), "no power of 2"),
    "no square": (_configure(S=15), "S is 15"),
    "cross attention": (_configure(action_network="cross_attention"), "cross_attention"),
    "resampler": (_configure(action_network="resampler_concat"), "resampler"),
    "no actions at all": (_configure(action_network="none"), "uses actions in an unknown way"),
    "another conditioning": (_configure(action_network="concat"), "unknown decoder.layers.0.action_proj"),
    "ours": (_configure(library="hma-toolkit"), "already"),
    "domain that is not there": (_configure(action_domains=["arm", "dog"]), "lacks the domains dog"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_bad_release_is_refused_in_one_line_and_nothing_written(tmp_path: Path, case: str) -> None:
    spoil, message = BAD[case]
    source = _write(_model(), tmp_path / "released")
    spoil(source)
    with pytest.raises(HMAError, match=message) as error:
        hub.import_released(source, tmp_path / "ours")
    assert len(str(error.value)) < 600 and "\n" not in str(error.value)
    assert [path.name for path in tmp_path.iterdir()] == ["released"]


def test_a_folder_that_is_no_checkpoint_is_not_replaced(tmp_path: Path) -> None:
    source = _write(_model(), tmp_path / "released")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years")
    with pytest.raises(CheckpointError, match="is not a checkpoint"):
        hub.import_released(source, tmp_path / "mine")
    hub.import_released(source, tmp_path / "ours")
    with pytest.raises(CheckpointError, match="already exists"):
        hub.export_released(tmp_path / "ours", tmp_path / "mine")
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "years"


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"layout": "ours"}, "layout 'ours'"),
        ({"action_alignment": "previous"}, "action_alignment 'previous'"),
        ({"absent_action": "embedding"}, "absent_action 'embedding'"),
        ({"conditioning": ("cross_attention",)}, "action_network '' uses actions in an unknown way"),
        ({"conditioning": ("add", "modulation")}, r"conditioning \('add', 'modulation'\)"),
        ({"grid": (4, 5)}, "S is 20, which is not 4 x 4"),
        ({"objectives": {"inverse": 1.0}}, "objective inverse"),
        ({"objectives": {"policy": 1.0}}, "objective policy"),
        ({"mup": True, "base_width": 64}, "base_width 64"),
        ({"factored": (6, 4)}, "24 is no power of 2 equal digits"),
        ({"told_noise": True, "digit_order": "chain"}, "told_noise True; digit_order 'chain'"),
        ({"action_waves": 2}, "action_waves 2"),
        ({"action_loss": "diffusion"}, "action_loss 'diffusion'"),
        (CONTINUOUS | {"latent_scale": 1.0}, "latent_scale 1.0"),
        (CONTINUOUS | {"mup": True}, "use_mup and width 32"),
        (CONTINUOUS | {"diffusion_target": "velocity"}, "diffusion_target 'velocity'"),
    ],
)
def test_what_the_release_cannot_express_is_named(change: dict[str, Any], named: str) -> None:
    with pytest.raises(CheckpointError, match=named):
        config_to_released(small_config(**(RELEASED | change)), "model")


def test_the_command_line_imports_and_exports(tmp_path: Path) -> None:
    source = _write(_model(), tmp_path / "released")
    here = CliRunner()
    done = here.invoke(
        app, ["hub", "import", str(source), "--out", str(tmp_path / "ours"), "-e", "arm", "--json"]
    )
    assert json.loads(done.stdout)["embodiments"] == ["arm"]
    done = here.invoke(app, ["hub", "export", str(tmp_path / "ours"), "--out", str(tmp_path / "again")])
    assert done.exit_code == 0
    assert not any(".pusher." in name for name in load_file(tmp_path / "again" / "model.safetensors"))
    failed = hma("hub", "import", str(tmp_path / "nowhere"), "--out", str(tmp_path / "x"))
    fails(failed, 1, "nowhere")
