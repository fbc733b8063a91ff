"""The paper's released weights in our modules: their configuration and their names, mapped.

The released layout differs from our default in what `config_from_released` sets: no norm before temporal
attention nor after the last block, copies of the action embedding appended to every frame, a projection per
embodiment after the modulated norm, chunk k at frame k, learned positions over time and space, and action
heads trained on raw actions.

D width, T frames, S tokens of a frame, K = stride * action dim, c channels, p patch side.
"""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from hma_data.errors import CheckpointError
from hma_model.config import HMAConfig

State = dict[str, Tensor]

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


def config_from_released(config: Mapping[str, Any], case: Mapping[str, Any] | None = None) -> HMAConfig:
    """Our configuration of a released `config.json`.

    Args:
        config: the released configuration.
        case: may give `grid`, the tokenizer's (h, w), where a frame is not square.

    Raises:
        CheckpointError: the configuration asks for what no released checkpoint has, or lacks a field.
    """
    try:
        continuous = bool(config.get("Diffusion", config.get("image_vocab_size") is None))
        network = str(config["action_network"])
        if sorted(network.split("+")) != ["concat", "modulate"] or config["qk_norm"]:
            fault = f"action_network {network!r} with qk_norm {config['qk_norm']} was never released"
            raise CheckpointError(
                "config.json", fault, "only concat+modulate without qk_norm can be imported"
            )
        side = math.isqrt(config["S"])
        grid = tuple((case or {}).get("grid", (side, side)))
        if math.prod(grid) != config["S"]:
            raise CheckpointError("config.json", f"S is {config['S']}, which is no square", "name the grid")
        shared = {
            "layers": config["num_layers"],
            "width": config["d_model"],
            "heads": config["num_heads"],
            "mlp_ratio": config["mlp_ratio"],
            "dropout": config["mlp_drop"],
            "frames": config["T"],
            "grid": grid,
            "action_tokens": config["action_token_size"],
            "qkv_bias": config["qkv_bias"],
            "proj_bias": config["proj_bias"],
            "mlp_bias": config["mlp_bias"],
            "mup": config["use_mup"],
            "action_loss_weight": config["action_loss_weight"],
        }
        own = _continuous(config) if continuous else _discrete(config)
    except KeyError as error:
        raise CheckpointError(
            "config.json", f"lacks {error.args[0]}", "is it a released checkpoint?"
        ) from error
    return HMAConfig(**shared, **own, **_LAYOUT)


_LAYOUT: dict[str, Any] = {
    "conditioning": ("concat", "modulation"),
    "modulation_out": "embodiment",
    "absent_action": "skip",
    "action_alignment": "current",
    "action_target": "raw",
    "time_position": "learned",
    "temporal_norm": False,
    "final_norm": False,
}


def _discrete(config: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "kind": "discrete",
        "factored": (config["factored_vocab_size"],) * config["num_factored_vocabs"],
        "corrupt_max": config["max_corrupt_rate"],
        "history_probability": config["non_mlm_ratio"],
        "history_frames": config["num_prompt_frames"],
    }


def _continuous(config: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "kind": "continuous",
        "channels": config["vae_embed_dim"],
        "patch": config["patch_size"],
        "latent_scale": 0.18215,
        "action_loss": "diffusion",
        "diffusion_depth": config["diffloss_d"],
        "diffusion_width": config["diffloss_w"],
        "diffusion_sample_steps": int(config["num_sampling_steps"]),
        "diffusion_repeats": config["diffusion_batch_mul"],
        "diffusion_variance": True,
    }


def state_from_released(
    state: Mapping[str, Tensor], config: HMAConfig
) -> tuple[State, dict[str, tuple[State, State]]]:
    """A released state, divided and renamed.

    Args:
        state: the released names and tensors.
        config: from `config_from_released`.

    Returns:
        What `HMA.load_trunk` takes, and per embodiment the stem and head for `HMA.load_embodiment`; float32.

    Raises:
        CheckpointError: a tensor is missing.
    """
    source = {name: tensor.float() for name, tensor in state.items()}
    domains = sorted({name.split(".")[1] for name in source if name.startswith("action_mlp.")})
    try:
        trunk = _trunk(source, config)
        parts = {domain: (_stem(source, domain, config), _head(source, domain, config)) for domain in domains}
    except KeyError as error:
        raise CheckpointError("released weights", f"lack {error.args[0]}", "is the file complete?") from error
    return trunk, parts


def _take(source: State, old: str, new: str) -> State:
    """The weight and, if there is one, the bias of a module under its new name."""
    names = {f"{new}.weight": source[f"{old}.weight"]}
    if f"{old}.bias" in source:
        names[f"{new}.bias"] = source[f"{old}.bias"]
    return names


def _trunk(source: State, config: HMAConfig) -> State:
    tokens = config.tokens_per_frame + config.appended_tokens
    # the released table of the continuous model is longer than its frames; only its first rows are used
    trunk = {
        "trunk.position": source["pos_embed_TSC"][0, :, :tokens],
        "trunk.absent": source["action_mask_tokens"][0, :, 0],
    }
    for layer in range(config.layers):
        for old, new in _BLOCK.items():
            trunk |= _take(source, f"decoder.layers.{layer}.{old}", f"trunk.blocks.{layer}.{new}")
    return trunk | (_latents(source, config) if config.kind == "continuous" else _tokens(source, config))


def _tokens(source: State, config: HMAConfig) -> State:
    ends = {"trunk.embed.mask": source["token_embed.mask_token_embed"][0]}
    for digit in range(len(config.factored)):
        ends[f"trunk.embed.digits.{digit}"] = source[f"token_embed.factored_embeds.{digit}.weight"]
    return ends | _take(source, "out_x_proj", "readout.linear")


def _latents(source: State, config: HMAConfig) -> State:
    ends = {
        "trunk.embed.mask": source["mask_token"].flatten(),
        "trunk.embed.linear.weight": _channels_first(source["token_embed.weight"], config),
        "readout.position": source["diffusion_pos_embed_learned"][0].unflatten(0, (config.frames, -1)),
    }
    for old, new in (
        ("z_proj_ln", "trunk.embed_norm"),
        ("out_x_proj", "readout.proj"),
        ("decoder_norm", "readout.norm"),
    ):
        ends |= _take(source, old, new)
    return ends | _patch_diffusion(source, config)


def _channels_first(values: Tensor, config: HMAConfig) -> Tensor:
    """Reorder the last axis from a patch's pixels by channels to channels by pixels."""
    return values.unflatten(-1, (config.patch**2, config.channels)).mT.flatten(-2)


def _patch_diffusion(source: State, config: HMAConfig) -> State:
    """The video's diffusion head; its inputs and outputs are patches, so they are reordered too."""
    head = _diffusion(source, "diffloss.net", "readout.diffusion", config)
    prefix = "readout.diffusion"
    head[f"{prefix}.input.weight"] = _channels_first(head[f"{prefix}.input.weight"], config)
    weight, bias = head[f"{prefix}.output.weight"], head[f"{prefix}.output.bias"]
    halves = (2, -1)  # the noise, then its variance
    weight = _channels_first(weight.unflatten(0, halves).movedim(-1, 0), config).movedim(0, -1).flatten(0, 1)
    bias = _channels_first(bias.unflatten(0, halves), config).flatten()
    return head | {f"{prefix}.output.weight": weight.contiguous(), f"{prefix}.output.bias": bias}


def _diffusion(source: State, old: str, new: str, config: HMAConfig) -> State:
    names: State = {}
    for theirs, ours in _DIFFUSION.items():
        names |= _take(source, f"{old}.{theirs}", f"{new}.{ours}")
    for block in range(config.diffusion_depth):
        for theirs, ours in _DIFFUSION_BLOCK.items():
            names |= _take(source, f"{old}.res_blocks.{block}.{theirs}", f"{new}.blocks.{block}.{ours}")
    return names


def _stem(source: State, domain: str, config: HMAConfig) -> State:
    mean = source[f"action_preprocessor.{domain}.mean"]
    stem = {
        "normalizer.mean": mean,
        "normalizer.std": source[f"action_preprocessor.{domain}.std"],
        "normalizer.normalize": torch.ones_like(mean, dtype=torch.bool),
    }
    for old, new in _STEM.items():
        stem |= _take(source, f"action_mlp.{domain}.{old}", new)
    return stem | _modulation(source, domain, config)


def _modulation(source: State, domain: str, config: HMAConfig) -> State:
    """The layers' modulations stacked; the first two maps are kept (in, out)."""

    def stack(name: str) -> Tensor:
        keys = [f"decoder.layers.{layer}.action_projectors.{domain}.{name}" for layer in range(config.layers)]
        return torch.stack([source[key] for key in keys])

    return {
        "modulation.weight_in": stack("adaLN_modulation.0.weight").mT.contiguous(),
        "modulation.bias_in": stack("adaLN_modulation.0.bias").unsqueeze(1),
        "modulation.weight": stack("adaLN_modulation.2.weight").mT.contiguous(),
        "modulation.bias": stack("adaLN_modulation.2.bias").unsqueeze(1),
        "modulation.out_weight": stack("linear_out.weight"),
        "modulation.out_bias": stack("linear_out.bias"),
    }


def _head(source: State, domain: str, config: HMAConfig) -> State:
    """Their only readout serves as both of ours; a diffusion head was given the features as they are."""
    if config.action_loss == "diffusion":
        weight, bias = torch.eye(config.width), torch.zeros(config.width)
        head = _diffusion(source, f"action_diff_losses.{domain}.net", "diffusion", config)
    else:
        weight, bias = (source[f"action_out_projectors.{domain}.{name}"] for name in ("weight", "bias"))
        head = {}
    for readout in ("policy", "inverse"):
        head |= {f"{readout}.weight": weight.clone(), f"{readout}.bias": bias.clone()}
    return head
