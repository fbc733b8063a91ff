"""Convert the tensors of the paper's released checkpoints to our names and layout, and ours to theirs.

Most modules are only renamed (`_renamed`). The others differ as follows. The values of a patch lie channels
first in ours and pixels first in theirs. In ours the modulation of all layers is stacked, with maps of shape
(in, out). The released action heads read the pooled features directly; our readout before a diffusion head is
therefore the identity after an import, and is folded into the head by an export.

D width, T frames, S tokens of a frame, K = stride * action dim, c channels, p patch side.
"""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from hma_model.config import READOUTS, HMAConfig
from hma_model.network.stem import varying

State = dict[str, Tensor]
Parts = dict[str, tuple[State, State]]

_STEM = {"model.0": "input", "model.1": "norm", "model.3": "output"}
_BLOCK = {
    "norm1": "space_norm",
    "spatial_attn.qkv": "space.qkv",
    "spatial_attn.proj": "space.proj",
    "temporal_attn.qkv": "time.qkv",
    "temporal_attn.proj": "time.proj",
    "norm2": "mlp_norm",
    "mlp.fc1": "mlp.fc1",
    "mlp.fc2": "mlp.fc2",
}
_DIFFUSION = {
    "time_embed.mlp.0": "level_in",
    "time_embed.mlp.2": "level_out",
    "cond_embed": "condition",
    "input_proj": "input",
    "final_layer.adaLN_modulation.1": "modulation",
    "final_layer.linear": "output",
}
_DIFFUSION_BLOCK = {"in_ln": "norm", "mlp.0": "fc1", "mlp.2": "fc2", "adaLN_modulation.1": "modulation"}
_MODULATION = {"adaLN_modulation.0": "_in", "adaLN_modulation.2": ""}


def domains_of(state: Mapping[str, Tensor]) -> list[str]:
    """Return the released names of the embodiments in a released state."""
    return sorted({name.split(".")[1] for name in state if name.startswith("action_mlp.")})


def state_from_released(state: Mapping[str, Tensor], config: HMAConfig) -> tuple[State, Parts]:
    """Split and rename a released state.

    Args:
        state: the released names and tensors, which fit the configuration.
        config: the result of `config_from_released`.

    Returns:
        The state for `HMA.load_trunk`, and the stem and head of each embodiment, all float32.
    """
    source = {name: tensor.float() for name, tensor in state.items()}
    parts = {name: (_stem(source, name, config), _head(source, name, config)) for name in domains_of(state)}
    return _trunk(source, config), parts


def state_to_released(
    trunk: Mapping[str, Tensor], parts: Mapping[str, tuple[State, State]], config: HMAConfig
) -> State:
    """Convert a trunk and the (stem, head) of embodiments, by released name, to a released state.

    The configuration must be one that `config_to_released` accepts. Tensors may be on the meta device.
    """
    position, rows = trunk["trunk.position"], math.prod(config.grid) + config.action_tokens
    unused = position.new_zeros(position.shape[0], rows - position.shape[1], config.width)
    released = _back(trunk, _renamed(config)) | {
        "pos_embed_TSC": torch.cat([position, unused], dim=1).unsqueeze(0),
        "action_mask_tokens": trunk["trunk.absent"][None, :, None],
    }
    for theirs, ours in _norms(config):
        released |= _move(trunk, f"{ours}.q_norm", theirs)
    if not config.discrete:
        released |= _patches_back(trunk, config)
    else:
        released["token_embed.mask_token_embed"] = trunk["trunk.embed.mask"].unsqueeze(0)
        released |= {theirs: trunk[ours] for theirs, ours in _digits(config).items()}
    for name, (stem, head) in parts.items():
        released |= _stem_back(stem, name, config) | _head_back(head, stem, name, config)
    return {name: tensor.float().contiguous() for name, tensor in released.items()}


def _renamed(config: HMAConfig) -> dict[str, str]:
    """Return the modules of the trunk that are only renamed: their name -> our name."""
    names = {}
    for layer in range(config.layers):
        for theirs, ours in _BLOCK.items():
            if not (config.qk_norm and theirs.startswith("norm")):
                names[f"decoder.layers.{layer}.{theirs}"] = f"trunk.blocks.{layer}.{ours}"
    if config.discrete:
        return names | {"out_x_proj": "readout.linear"}
    names |= {"z_proj_ln": "trunk.embed_norm", "out_x_proj": "readout.proj", "decoder_norm": "readout.norm"}
    return names | _diffusion("diffloss.net", "readout.diffusion", config)


def _diffusion(theirs: str, ours: str, config: HMAConfig) -> dict[str, str]:
    names = {f"{theirs}.{old}": f"{ours}.{new}" for old, new in _DIFFUSION.items()}
    for block in range(config.diffusion_depth):
        for old, new in _DIFFUSION_BLOCK.items():
            names[f"{theirs}.res_blocks.{block}.{old}"] = f"{ours}.blocks.{block}.{new}"
    return names


def _move(source: Mapping[str, Tensor], old: str, new: str) -> State:
    """Return the weight and, if there is one, the bias of a module under its new name."""
    names = {f"{new}.weight": source[f"{old}.weight"]}
    if f"{old}.bias" in source:
        names[f"{new}.bias"] = source[f"{old}.bias"]
    return names


def _forth(source: Mapping[str, Tensor], names: Mapping[str, str]) -> State:
    return {key: value for old, new in names.items() for key, value in _move(source, old, new).items()}


def _back(source: Mapping[str, Tensor], names: Mapping[str, str]) -> State:
    return _forth(source, {ours: theirs for theirs, ours in names.items()})


# -- the trunk


def _trunk(source: State, config: HMAConfig) -> State:
    tokens = config.tokens_per_frame + max(config.appended_tokens, config.absent_tokens)
    # the released table has rows for all pixels and action tokens; only the first ones are used
    trunk = _forth(source, _renamed(config)) | {
        "trunk.position": source["pos_embed_TSC"][0, :, :tokens],
        "trunk.absent": source["action_mask_tokens"][0, :, 0],
    }
    for theirs, ours in _norms(config):
        trunk |= _move(source, theirs, f"{ours}.q_norm") | _move(source, theirs, f"{ours}.k_norm")
    if not config.discrete:
        return trunk | _latents(source, trunk, config)
    trunk["trunk.embed.mask"] = source["token_embed.mask_token_embed"][0]
    return trunk | {ours: source[theirs] for theirs, ours in _digits(config).items()}


def _norms(config: HMAConfig) -> list[tuple[str, str]]:
    """Return each of their norms, which queries and keys share, with our attention module."""
    sides = (("spatial_attn", "space"), ("temporal_attn", "time")) if config.qk_norm else ()
    return [
        (f"decoder.layers.{layer}.{theirs}.norm", f"trunk.blocks.{layer}.{ours}")
        for layer in range(config.layers)
        for theirs, ours in sides
    ]


def _digits(config: HMAConfig) -> dict[str, str]:
    """Return the embeddings of digits: their name -> our name."""
    digits = range(len(config.factored))
    return {f"token_embed.factored_embeds.{i}.weight": f"trunk.embed.digits.{i}" for i in digits}


def _latents(source: State, renamed: State, config: HMAConfig) -> State:
    """Convert embedding, positions and diffusion head of the continuous model; reorder their patches."""
    prefix = "readout.diffusion"
    halves = renamed[f"{prefix}.output.weight"].unflatten(0, (2, -1))  # the noise, then its variance
    weight = _channels_first(halves.movedim(-1, 0), config).movedim(0, -1).flatten(0, 1)
    bias = _channels_first(renamed[f"{prefix}.output.bias"].unflatten(0, (2, -1)), config).flatten()
    return {
        "trunk.embed.mask": source["mask_token"].flatten(),
        "trunk.embed.linear.weight": _channels_first(source["token_embed.weight"], config),
        "readout.position": source["diffusion_pos_embed_learned"][0].unflatten(0, (config.frames, -1)),
        f"{prefix}.input.weight": _channels_first(renamed[f"{prefix}.input.weight"], config),
        f"{prefix}.output.weight": weight.contiguous(),
        f"{prefix}.output.bias": bias,
    }


def _patches_back(trunk: Mapping[str, Tensor], config: HMAConfig) -> State:
    theirs, prefix = "diffloss.net", "readout.diffusion"
    weight, bias = _with_variance(
        trunk[f"{prefix}.output.weight"], trunk[f"{prefix}.output.bias"], config.patch_dim
    )
    halves = weight.unflatten(0, (2, -1)).movedim(-1, 0)
    return {
        "mask_token": trunk["trunk.embed.mask"].view(1, 1, -1),
        "token_embed.weight": _pixels_first(trunk["trunk.embed.linear.weight"], config),
        "diffusion_pos_embed_learned": trunk["readout.position"].flatten(0, 1).unsqueeze(0),
        f"{theirs}.input_proj.weight": _pixels_first(trunk[f"{prefix}.input.weight"], config),
        f"{theirs}.final_layer.linear.weight": _pixels_first(halves, config).movedim(0, -1).flatten(0, 1),
        f"{theirs}.final_layer.linear.bias": _pixels_first(bias.unflatten(0, (2, -1)), config).flatten(),
    }


def _channels_first(values: Tensor, config: HMAConfig) -> Tensor:
    """Reorder the last axis from a patch's pixels by channels to channels by pixels."""
    return values.unflatten(-1, (-1, config.channels)).mT.flatten(-2)


def _pixels_first(values: Tensor, config: HMAConfig) -> Tensor:
    """Reorder the last axis from a patch's channels by pixels to pixels by channels."""
    return values.unflatten(-1, (config.channels, -1)).mT.flatten(-2)


def _with_variance(weight: Tensor, bias: Tensor, values: int) -> tuple[Tensor, Tensor]:
    """Return an output layer with variance outputs; missing ones become 0, the middle of their range."""
    if len(bias) == 2 * values:
        return weight, bias
    return torch.cat([weight, torch.zeros_like(weight)]), torch.cat([bias, torch.zeros_like(bias)])


# -- an embodiment


def _stem(source: State, domain: str, config: HMAConfig) -> State:
    mean = source[f"action_preprocessor.{domain}.mean"]
    stem = {
        "normalizer.mean": mean,
        "normalizer.std": source[f"action_preprocessor.{domain}.std"],
        "normalizer.normalize": torch.ones_like(mean, dtype=torch.bool),
        "normalizer.divide": torch.tensor(True),
    }
    for old, new in _STEM.items():
        stem |= _move(source, f"action_mlp.{domain}.{old}", new)
    if "modulation" not in config.conditioning:
        return stem

    def stack(name: str) -> Tensor:
        layers = (f"decoder.layers.{layer}.action_projectors.{domain}" for layer in range(config.layers))
        return torch.stack([source[f"{layer}.{name}"] for layer in layers])

    for part in ("weight", "bias"):
        stem[f"modulation.out_{part}"] = stack(f"linear_out.{part}")
    for old, suffix in _MODULATION.items():
        stem[f"modulation.weight{suffix}"] = stack(f"{old}.weight").mT.contiguous()
        stem[f"modulation.bias{suffix}"] = stack(f"{old}.bias").unsqueeze(1)
    return stem


def _stem_back(stem: State, domain: str, config: HMAConfig) -> State:
    """Convert a stem to released names.

    Dims that pass through get mean 0 and std 1. Dims that never vary get no weight, because our stem sets
    them to 0.
    """
    mean, std = stem["normalizer.mean"].float(), stem["normalizer.std"].float()
    plain, still = ~stem["normalizer.normalize"], _still(stem)
    weight = stem["input.weight"]
    columns = still.repeat(weight.shape[1] // len(mean))
    released = {
        f"action_preprocessor.{domain}.mean": mean.masked_fill(plain, 0.0),
        f"action_preprocessor.{domain}.std": std.masked_fill(plain | still, 1.0),
    }
    for old, new in _STEM.items():
        released |= _move(stem, new, f"action_mlp.{domain}.{old}")
    released[f"action_mlp.{domain}.model.0.weight"] = weight.masked_fill(columns, 0.0)
    return released | (_modulation_back(stem, domain, config) if "modulation" in config.conditioning else {})


def _still(stem: State) -> Tensor:
    """Return (A,) bool, True for dims that `Normalizer` sets to 0."""
    mean, std, normalize = (stem[f"normalizer.{name}"] for name in ("mean", "std", "normalize"))
    if "normalizer.divide" in stem:
        return torch.zeros_like(normalize)
    return ~varying(mean, std) & normalize


def _modulation_back(stem: State, domain: str, config: HMAConfig) -> State:
    released = {}
    for layer in range(config.layers):
        theirs = f"decoder.layers.{layer}.action_projectors.{domain}"
        for old, suffix in _MODULATION.items():
            released[f"{theirs}.{old}.weight"] = stem[f"modulation.weight{suffix}"][layer].mT
            released[f"{theirs}.{old}.bias"] = stem[f"modulation.bias{suffix}"][layer, 0]
        released[f"{theirs}.linear_out.weight"] = stem["modulation.out_weight"][layer]
        released[f"{theirs}.linear_out.bias"] = stem["modulation.out_bias"][layer]
    return released


def _head(source: State, domain: str, config: HMAConfig) -> State:
    """Convert a head: its one readout becomes both of ours, or the identity before a diffusion head."""
    if config.action_loss == "diffusion":
        weight, bias = torch.eye(config.width), torch.zeros(config.width)
        head = _forth(source, _diffusion(f"action_diff_losses.{domain}.net", "diffusion", config))
    else:
        weight, bias = (source[f"action_out_projectors.{domain}.{name}"] for name in ("weight", "bias"))
        head = {}
    for readout in READOUTS:
        head |= {f"{readout}.weight": weight.clone(), f"{readout}.bias": bias.clone()}
    return head


def _head_back(head: State, stem: State, domain: str, config: HMAConfig) -> State:
    weight, bias = head["policy.weight"].float(), head["policy.bias"].float()
    if config.action_loss == "diffusion":
        theirs = f"action_diff_losses.{domain}.net"
        released = _back(head, _diffusion(theirs, "diffusion", config))
        into = head["diffusion.condition.weight"].float()
        released[f"{theirs}.cond_embed.weight"] = into @ weight
        released[f"{theirs}.cond_embed.bias"] = head["diffusion.condition.bias"].float() + into @ bias
        values = stem["input.weight"].shape[1]
        weight, bias = _with_variance(head["diffusion.output.weight"], head["diffusion.output.bias"], values)
        last = f"{theirs}.final_layer.linear"
        return released | {f"{last}.weight": weight, f"{last}.bias": bias}
    return {f"action_out_projectors.{domain}.weight": weight, f"action_out_projectors.{domain}.bias": bias}
