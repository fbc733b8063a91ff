"""Start a model on another list of colours: each new colour begins with the weights of the nearest old one.

The embedding and the readout have a row for each colour. Both belong to the trunk, so it must be tuned.

F digits of a token, V colours of the model, N new ones, D width.
"""

import numpy as np
import torch

from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.shapes import parse_colors
from hma_model.checkpoint.weights import State
from hma_model.config import HMAConfig

OF_COLORS = {"colors", "factored", "vocab_size", "dtype"}  # the fields of a spec that follow from its colours
PER_DIGIT = ("trunk.embed.digits.", "readout.chain.digits.", "readout.chain.output.")  # tensors (V, D)
ALL_DIGITS = "readout.linear."  # (F * V, …), digit after digit


def recolored(config: HMAConfig, spec: TokenizerSpec) -> HMAConfig:
    """Return the configuration for the colours of `spec`; unchanged if it differs in more, or in nothing."""
    ours, theirs = dict(config.tokenizer), spec.to_json()
    differing = {key for key in ours | theirs if ours.get(key) != theirs.get(key)}
    if not (ours.get("colors") and spec.colors) or not differing or differing - OF_COLORS:
        return config
    return config.replace(tokenizer=theirs, factored=spec.factored)


def carried(state: State, config: HMAConfig, to: HMAConfig) -> State:
    """Return the weights of a trunk and its readout with rows for the colours of the configuration `to`.

    New colours with the same nearest one share its probability.
    """
    if config.tokenizer == to.tokenizer:
        return state
    old, new = (
        parse_colors(each.tokenizer["colors"], "tokenizer").astype(np.float32) for each in (config, to)
    )
    nearest = torch.cdist(torch.from_numpy(new), torch.from_numpy(old)).argmin(1)  # (N,)
    shared = nearest.bincount(minlength=len(old))[nearest].log()
    made = dict(state)
    for name, values in state.items():
        if name.startswith(PER_DIGIT):
            made[name] = values[nearest]
        elif name.startswith(ALL_DIGITS):
            rows = values.unflatten(0, (-1, len(old)))[:, nearest]
            made[name] = (rows - shared if name.endswith("bias") else rows).flatten(0, 1)
    return made
