"""Export a checkpoint to the paper's released layout, so that the released code reads it.

Weights that our embodiments share are repeated for each of them. The normalisation of action targets,
variance outputs and readouts before a diffusion head are folded into the weights of the layout. A
configuration that the layout cannot express is refused, with every reason.
"""

import keyword
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from hma_data.errors import CheckpointError
from hma_data.storage.folders import new_folder, to_json, write_tensors
from hma_data.storage.paths import StrPath, as_path
from hma_model.checkpoint.io import Checkpoint, load
from hma_model.released.config import config_to_released
from hma_model.released.state import State, state_to_released

if TYPE_CHECKING:
    from hma_model.network.model import HMA


def export_released(checkpoint: StrPath, out: StrPath, *, embodiments: Iterable[str] | None = None) -> Path:
    """Write config.json and model.safetensors so that the released code's `from_pretrained` reads them.

    Args:
        checkpoint: str or path of its folder, or of the folder of a training run.
        out: str or path of a folder that does not exist or is empty.
        embodiments: ids; all by default.

    Returns:
        The folder.

    Raises:
        CheckpointError: the released layout cannot express the model, or the folder cannot be written.
    """
    from safetensors import SafetensorError

    out = as_path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise CheckpointError(out, "is there already", "choose another folder")
    opened = Checkpoint.open(checkpoint)
    values = config_to_released(opened.config, opened.folder)
    model = load(opened.folder, embodiments)
    domains = _domains(model, opened.folder)
    values |= _actions(model, domains)
    parts = {domain: (model.stem_state(name), model.head_state(name)) for domain, name in domains.items()}
    state = state_to_released(model.trunk_state(), parts, opened.config)
    _check_norms(model, opened.folder)
    stats: dict[str, Tensor] = {
        name: state[name] for name in state if name.startswith("action_preprocessor.")
    }
    values["action_stats"] = [
        [stats[f"action_preprocessor.{domain}.{part}"].tolist() for part in ("mean", "std")]
        for domain in domains
    ] or None
    _write(out, values, state, SafetensorError)
    return out


def _write(out: Path, values: dict[str, Any], state: State, failure: type[Exception]) -> None:
    try:
        with new_folder(out) as folder:
            (folder / "config.json").write_bytes(to_json(values))
            write_tensors(folder / "model.safetensors", state, {"format": "pt"})
    except (OSError, failure) as fault:
        raise CheckpointError(
            out, f"cannot be written: {fault}", "free space or choose another folder"
        ) from fault


def _domains(model: "HMA", where: object) -> dict[str, str]:
    """Return the id of each released name, which has no dots because it is a module's name in their code."""
    domains: dict[str, str] = {}
    for name in model.embodiments:
        domain = name.replace(".", "_")
        if domain in domains or hasattr(nn.ModuleDict(), domain) or keyword.iskeyword(domain):
            fault = f"embodiment {name!r} cannot be a domain called {domain!r}"
            raise CheckpointError(where, fault, "export the others by --embodiment")
        domains[domain] = name
    return domains


def _actions(model: "HMA", domains: dict[str, str]) -> dict[str, Any]:
    if not domains:
        return {"init_actions": False, "use_actions": False, "action_domains": None, "d_actions": None}
    return {
        "init_actions": True,
        "use_actions": True,
        "action_domains": list(domains),
        "d_actions": [model.embodiments[name].chunk_dim for name in domains.values()],
    }


def _check_norms(model: "HMA", where: object) -> None:
    """Raise unless queries and keys have equal norms: the released code has one norm for both."""
    state = model.trunk_state()
    for name in state:
        if ".q_norm." in name and not torch.equal(state[name], state[name.replace(".q_norm.", ".k_norm.")]):
            fault = (
                f"the released layout has one norm of queries and keys; {name} and that of the keys differ"
            )
            raise CheckpointError(where, fault, "the released code cannot read it")
