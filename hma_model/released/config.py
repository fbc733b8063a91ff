"""Convert the configuration of the paper's released checkpoints to ours, and ours to theirs.

Released weights have the layout that `HMAConfig.layout` explains, and chunk k at frame k. Substrings of their
`action_network` state how actions enter the network: "concat" appends copies of the embedding to every frame;
"mlp" (added in every block), "cross_attention" or "modulate" acts in the blocks.

D width, T frames, S tokens of a frame.
"""

import math
from collections.abc import Mapping
from typing import Any

from hma_data.errors import CheckpointError, RecipeError
from hma_model.config import INVERSE, OBJECTIVES, POLICY, HMAConfig

LATENT_SCALE = 0.18215  # the factor by which the released loader multiplies stored latents
_WHERE = "config.json"
_REMEDY = "is it a released checkpoint?"
_LAYOUT: dict[str, Any] = {"layout": "released", "action_alignment": "current"}
# What an export need not keep: read by training alone, or folded into the weights.
_FREE = {
    "diffusion_variance", "label_smoothing", "latent_noise", "objectives", "position_init", "tokenizer",
    "training_pass", "whole_share",
}  # fmt: skip
_DISCRETE_ONLY = {"factored", "corrupt_max", "history_probability"}
_CONTINUOUS_ONLY = {
    "channels", "patch", "latent_scale", "diffusion_target", "diffusion_depth", "diffusion_width",
    "diffusion_sample_steps",
}  # fmt: skip
# Their field: ours with the same meaning.
_SAME = {
    "num_layers": "layers", "num_heads": "heads", "d_model": "width", "T": "frames", "mlp_ratio": "mlp_ratio",
    "mlp_bias": "mlp_bias", "qkv_bias": "qkv_bias", "qk_norm": "qk_norm", "use_mup": "mup",
    "action_token_size": "action_tokens",
}  # fmt: skip
_SAME_DISCRETE = {"max_corrupt_rate": "corrupt_max", "non_mlm_ratio": "history_probability"}
_SAME_CONTINUOUS = {
    "vae_embed_dim": "channels", "patch_size": "patch", "diffloss_d": "diffusion_depth",
    "diffloss_w": "diffusion_width",
}  # fmt: skip
# Our objective by their (jointly_predict_actions, jointly_predict_states). Without the first, the second is
# ignored: video is predicted.
_OBJECTIVE = {
    (False, False): "forward",
    (False, True): "forward",
    (True, False): "policy",
    (True, True): "full",
}
# The values of fields that a released file does not state.
_DEFAULTS: dict[str, Any] = {
    "T": 12, "S": 256, "image_vocab_size": 262144, "num_factored_vocabs": 1,
    "max_corrupt_rate": 0.2, "non_mlm_ratio": 0.2,
    "action_network": "mlp", "jointly_predict_actions": False, "jointly_predict_states": True,
    "action_token_size": 64,
    "use_mup": False, "qk_norm": True, "qkv_bias": False, "mlp_ratio": 4.0, "mlp_bias": True,
}  # fmt: skip
_CONTINUOUS_DEFAULTS: dict[str, Any] = {
    "image_vocab_size": None, "patch_size": 1, "vae_embed_dim": 4,
    "diffloss_d": 4, "diffloss_w": 1024, "num_sampling_steps": "100",
}  # fmt: skip
_COUNTS = {"num_layers": 1000, "diffloss_d": 1000, "num_factored_vocabs": 64} | dict.fromkeys(
    ("num_heads", "d_model", "T", "S", "action_token_size", "patch_size", "vae_embed_dim", "diffloss_w"),
    1_000_000,
)  # fmt: skip


def config_from_released(
    config: Mapping[str, Any], grid: tuple[int, int] | None = None, where: object = "config.json"
) -> HMAConfig:
    """Convert a released `config.json` to our configuration.

    Args:
        config: the released configuration.
        grid: the tokenizer's (h, w), if a frame is not square.
        where: the file, for the errors.
    """
    continuous = bool(config.get("Diffusion", config.get("image_vocab_size", 0) is None))
    given = {key: value for key, value in config.items() if value is not None}
    values = _DEFAULTS | (_CONTINUOUS_DEFAULTS if continuous else {}) | given
    try:
        for name, most in _COUNTS.items():
            value = values.get(name, 1)
            if type(value) is not int or not 1 <= value <= most:
                raise CheckpointError(
                    _WHERE, f"{name} is {value!r}, not a whole number from 1 to {most}", _REMEDY
                )
        if not values.get("proj_bias", True):
            raise CheckpointError(_WHERE, "has no proj_bias, unlike every release", _REMEDY)
        shared = _shared(values, grid)
        own = _continuous(values) if continuous else _discrete(values)
        return HMAConfig(**_LAYOUT, **shared, **own)
    except CheckpointError as error:
        raise CheckpointError(where, error.fault, error.remedy) from error
    except KeyError as error:
        raise CheckpointError(where, f"lacks {error.args[0]}", _REMEDY) from error
    except RecipeError as error:
        fault = f"{error.where.removeprefix('model.')}: {error.fault}"
        raise CheckpointError(where, fault, _REMEDY) from error
    except (TypeError, ValueError, ArithmeticError) as error:
        raise CheckpointError(where, f"has a value of the wrong type: {error}", _REMEDY) from error


def _renamed(values: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    """Return our fields, each with the type of its default."""
    return {ours: type(getattr(HMAConfig, ours))(values[theirs]) for theirs, ours in names.items()}


def _shared(values: Mapping[str, Any], grid: Any) -> dict[str, Any]:
    joint, tokens = bool(values["jointly_predict_actions"]), values["S"]
    height, width = (math.isqrt(tokens),) * 2 if grid is None else (int(part) for part in grid)
    if height * width != tokens:
        raise CheckpointError(_WHERE, f"S is {tokens}, which is not {height} x {width}", "name the grid")
    objective = _OBJECTIVE[joint, bool(values["jointly_predict_states"])]
    return _renamed(values, _SAME) | {
        "grid": (height, width),
        "conditioning": _conditioning(str(values["action_network"])),
        "absent_action": "tokens" if joint else "skip",
        "objectives": {objective: 1.0},
    }


def _conditioning(network: str) -> tuple[str, ...]:
    """Return the conditioning of an action_network, by the substrings that the released code looks for."""
    if "cross_attention" in network and "mlp" not in network:
        fault = f"action_network {network!r}: the released cross-attention mixes up rows and samples"
        raise CheckpointError(_WHERE, fault, "it cannot be imported")
    if "resampler" in network:
        fault = f"action_network {network!r}: the released code has no resampler"
        raise CheckpointError(_WHERE, fault, "it cannot be imported")
    found = ["concat"] if "concat" in network else []
    if "mlp" in network:
        found.append("add")
    elif "modulate" in network:
        found.append("modulation")
    if not found:
        fault = f"action_network {network!r} uses actions in an unknown way"
        raise CheckpointError(_WHERE, fault, "known are mlp, modulate, concat and concat+modulate")
    return tuple(found)


def _discrete(values: Mapping[str, Any]) -> dict[str, Any]:
    vocab, digits = values["image_vocab_size"], values["num_factored_vocabs"]
    size = round(vocab ** (1 / digits))
    if size**digits != vocab:
        raise CheckpointError(_WHERE, f"image_vocab_size {vocab} is no power of {digits} equal digits")
    return {"kind": "discrete", "factored": (size,) * digits, **_renamed(values, _SAME_DISCRETE)}


def _continuous(values: Mapping[str, Any]) -> dict[str, Any]:
    if values["use_mup"] and values["d_model"] != 256:
        fault = f"is continuous with use_mup and width {values['d_model']}"
        raise CheckpointError(_WHERE, fault, "the released code makes such a model only at width 256")
    # The steps of a respacing: `N`, `ddimN`, numbers to add up, or an empty text for all 1000.
    text = str(values["num_sampling_steps"]).removeprefix("ddim")
    return {
        "kind": "continuous",
        "latent_scale": LATENT_SCALE,
        "action_loss": "diffusion",
        "diffusion_target": "noise",
        "diffusion_sample_steps": sum(int(part) for part in text.split(",")) if text else 1000,
        "diffusion_variance": True,
        **_renamed(values, _SAME_CONTINUOUS),
    }


def config_to_released(config: HMAConfig, where: object) -> dict[str, Any]:
    """Convert a configuration to the released `config.json`, without its action domains."""
    discrete = config.discrete
    named = {"concat": "concat", "modulation": "modulate", "add": "mlp"}
    same = _SAME | _SAME_DISCRETE | ({} if discrete else _SAME_CONTINUOUS)
    values = {theirs: getattr(config, ours) for theirs, ours in same.items()} | {
        "proj_bias": True,
        "S": math.prod(config.grid),
        "image_vocab_size": config.vocab_size if discrete else None,
        "num_factored_vocabs": len(config.factored) if discrete else 2,
        "action_network": "+".join(theirs for ours, theirs in named.items() if ours in config.conditioning),
        "jointly_predict_actions": config.absent_action == "tokens",
        "jointly_predict_states": any(OBJECTIVES[name].predicts_video for name in config.objectives),
    }
    if not discrete:
        values |= {"Diffusion": True, "num_sampling_steps": str(config.diffusion_sample_steps)}
    free = _FREE | (_CONTINUOUS_ONLY if discrete else _DISCRETE_ONLY)
    free |= set() if config.mup else {"base_width"}
    try:
        again = config_from_released(values, where=where)
        faults = [
            f"{name} {value!r}"
            for name, value in vars(config).items()
            if name not in free and value != getattr(again, name)
        ]
    except CheckpointError as error:
        faults = [error.fault]
    for one in sorted(config.trained, key=lambda one: one.name):
        if one.readout == INVERSE or (one.readout == POLICY and config.absent_action != "tokens"):
            faults.append(f"objective {one.name} with absent_action {config.absent_action!r}")
    if faults:
        fault = f"the released layout cannot express {'; '.join(faults)}"
        raise CheckpointError(where, fault, "the released code cannot read it")
    return values
