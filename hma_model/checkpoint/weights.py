"""Read and write the weights of a checkpoint, and check its configuration against them.

A configuration from an untrusted author may ask for more memory than there is. The file of weights limits it:
a network with more values than the file is refused before it is built.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from hma_data.errors import CheckpointError
from hma_data.storage.files import opened_weights
from hma_model.checkpoint.folder import Checkpoint

if TYPE_CHECKING:
    from torch import Tensor

    from hma_model.config import ActionSpace, HMAConfig

State = dict[str, "Tensor"]
STATISTICS = "normalizer."  # the beginning of their names in a stem
LARGEST_COUNT = 1_000_000  # upper limit of every count in a configuration
_COUNTS = (
    *("layers", "width", "heads", "frames", "channels", "patch", "action_tokens", "grid", "views"),
    *("levels", "factored", "diffusion_depth", "diffusion_width", "diffusion_sample_steps"),
)
_REMEDY = "pull the checkpoint again; if the error stays, do not use it"


# -- safetensors files


def read_tensors(path: Path) -> State:
    """Read all tensors of a safetensors file to the CPU."""
    with opened_weights(path, framework="pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118


def write_tensors(
    path: Path, tensors: Mapping[str, "Tensor"], metadata: dict[str, str], half: bool = False
) -> None:
    """Write a safetensors file; the same tensors give the same bytes, whatever device they are on.

    Args:
        half: weights become float16, statistics do not.
    """
    from safetensors.torch import save_file

    plain = {name: tensors[name].detach().cpu().contiguous().clone() for name in sorted(tensors)}
    for name, tensor in plain.items():
        if half and tensor.is_floating_point() and not name.startswith(STATISTICS):
            plain[name] = tensor.half()
            if tensor.isfinite().all() and not plain[name].isfinite().all():
                fault = f"{name} holds {float(tensor.abs().max()):.3g}, which float16 cannot represent"
                raise CheckpointError(path, fault, "store it in float32")
    save_file(plain, path, metadata)
    with path.open("r+b") as file:  # safetensors writes the metadata in a different order each time
        length = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(length))
        values = {"__metadata__": dict(sorted(header.pop("__metadata__").items())), **header}
        content = json.dumps(values, ensure_ascii=False, separators=(",", ":")).encode().ljust(length)
        if len(content) == length:
            file.seek(8)
            file.write(content)


# -- the weights of a checkpoint


def trunk(checkpoint: Checkpoint) -> State:
    """Read the trunk's tensors."""
    path = checkpoint.trunk()
    state = read_tensors(path)
    _require_values(path, state)
    _require_network(checkpoint.config, state, checkpoint.folder)
    return state


def embodiment(checkpoint: Checkpoint, name: str, space: "ActionSpace") -> tuple[State, State]:
    """Read the tensors of an embodiment's stem and head; `space` is the action space of its YAML."""
    states = []
    for part in ("stem", "head"):
        path = checkpoint.path(name, f"{part}.safetensors")
        # A layer has a weight for each value of a chunk, so a file with fewer bytes cannot hold it.
        if space.chunk_dim > path.stat().st_size:
            fault = f"is too small for chunks of {space.chunk_dim:,} values, which embodiment.yaml asks for"
            raise CheckpointError(path, fault, "pull the embodiment again")
        state = read_tensors(path)
        _require_values(path, state)
        states.append(state)
    return states[0], states[1]


def _require_values(where: object, state: Mapping[str, "Tensor"]) -> None:
    """Raise if weights are not finite floating point numbers."""
    for name, tensor in state.items():
        kind = str(tensor.dtype).removeprefix("torch.")
        if kind not in ("float16", "bfloat16", "float32", "float64"):
            if not name.startswith(STATISTICS):
                raise CheckpointError(where, f"holds {name[:80]} as {kind}, not floating point", _REMEDY)
        elif not bool(tensor.isfinite().all()):
            raise CheckpointError(where, f"holds values in {name[:80]} that are not finite", _REMEDY)


def _require_network(config: "HMAConfig", state: Mapping[str, "Tensor"], where: object) -> None:
    """Raise if a network of this configuration has more values than the trunk's file."""
    for key in _COUNTS:
        value = getattr(config, key)
        for count in value if isinstance(value, tuple) else (value,):
            if not isinstance(count, int) or count > LARGEST_COUNT:
                raise CheckpointError(where, f"model.{key} is {value!r}, not a valid network size", _REMEDY)
    values = sum(tensor.numel() for tensor in state.values())
    width, hidden = config.width, config.mlp_ratio * config.width
    needed: dict[str, float] = {}
    if config.trunk == "unet":
        finest = config.levels[0]
        needed["levels"] = config.layers * sum(18 * channels**2 for channels in config.levels)
        needed["grid"] = config.tokens_per_frame // config.views * finest
        needed["frames"] = config.frames * config.views * width * finest
    else:
        needed["layers"] = config.layers * width * max(width, hidden)
        needed["grid"] = config.tokens_per_frame * width
        needed["frames"] = config.frames * width if config.released else 0
    if config.discrete:
        needed["factored"] = sum(config.digits) * width
    else:
        if config.video_loss == "diffusion":
            needed["diffusion_depth"] = config.diffusion_depth * config.diffusion_width**2
        needed["channels"] = config.patch_dim * width
    for key, count in needed.items():
        if not count <= values:
            fault = f"model.{key} asks for {count:.3g} values, its trunk has {values:,}"
            raise CheckpointError(where, fault, _REMEDY)
