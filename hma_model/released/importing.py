"""Convert the paper's released checkpoints, from a folder or repository, to checkpoints of our format.

A released folder holds config.json and model.safetensors, or pytorch_model.bin. Everything is read and
checked before anything is written. Facts that the release does not state (cameras, rates, units) are marked
unknown in the embodiments' YAML, unless the registry has an embodiment of the domain's name and width.
"""

import pickle
import re
import warnings
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hma_data.errors import CheckpointError, HMAError
from hma_data.registry.embodiment import Embodiment, find
from hma_data.storage.folders import read_json, read_tensors
from hma_data.storage.paths import StrPath, as_address
from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.catalog import find_entry
from hma_model.checkpoint.io import LIBRARY, Checkpoint, save
from hma_model.config import ActionSpace, HMAConfig
from hma_model.network.model import HMA
from hma_model.released.config import LATENT_SCALE, config_from_released
from hma_model.released.state import State, domains_of, state_from_released, state_to_released

CONFIG, WEIGHTS = "config.json", ("model.safetensors", "pytorch_model.bin")
_PREFIXES = ("module.", "_orig_mod.")
_SHOWN = 3  # maximum number of names in an error


def import_released(
    source: StrPath,
    out: StrPath,
    *,
    embodiments: Iterable[str] | None = None,
    grid: tuple[int, int] | None = None,
    tokenizer: str | None = None,
    origin: StrPath | None = None,
) -> Checkpoint:
    """Convert a released checkpoint of this machine to our layout.

    Args:
        source: str or path of a folder with config.json and weights, or of the weights' file in it.
        out: str or path of the folder of the new checkpoint.
        embodiments: domains to take, by their released names or our ids; all by default.
        grid: the tokenizer's (h, w), where a frame is not square.
        tokenizer: name of the one the model was trained on; by default the paper's, where the sizes are its.
        origin: where it is from, for the cards; `source` by default.

    Raises:
        CheckpointError: not a released checkpoint, damaged, or of an architecture the release does not have.
    """
    address = as_address(source)
    folder, weights = _files(address)
    values = _config_values(folder / CONFIG)
    state = _read_state(weights)
    config = _explained(folder, lambda: config_from_released(values, {"grid": grid} if grid else None))
    config = config.replace(tokenizer=_tokenizer_spec(config, tokenizer, folder).to_json())
    _check_fit(weights, state, config, values)
    _check_finite(weights, state)
    names = _choose(_ids(domains_of(state), weights), embodiments, weights)
    trunk, parts = state_from_released(state, config)
    model = HMA(config)
    model.load_trunk(trunk)
    for domain, name in names.items():
        model.load_embodiment(name, *parts[domain])
    spaces = {name: model.embodiments[name] for name in names.values()}
    return save(
        model,
        out,
        embodiment_yaml={name: _yaml(domain, spaces[name]) for domain, name in names.items()},
        stats={name: _stats(space) for name, space in spaces.items()},
        cards={name: _card(domain, as_address(origin or source)) for domain, name in names.items()},
        tokenizer=config.tokenizer,
    )


# -- reading


def _files(source: str | Path) -> tuple[Path, Path]:
    """Return the folder of config.json, and the file of the weights."""
    path = Path(source).expanduser()
    if path.is_file():
        return path.parent, path
    if path.is_dir():
        found = [path / name for name in WEIGHTS if (path / name).is_file()]
        if not found:
            raise CheckpointError(
                path, f"has no {' or '.join(WEIGHTS)}", "give a released checkpoint's folder"
            )
        return path, found[0]
    raise CheckpointError(source, "no such file or folder", "give a folder, or ORGANISATION/NAME")


def _config_values(path: Path) -> dict[str, Any]:
    values = read_json(path)
    if values.get("library") == LIBRARY:
        raise CheckpointError(path, f"is a checkpoint of {LIBRARY} already", "use it as it is")
    missing = [name for name in ("num_layers", "num_heads", "d_model") if name not in values]
    if missing:
        raise CheckpointError(path, f"lacks {missing[0]}", "is it a released checkpoint?")
    return values


def _read_state(path: Path) -> State:
    """Read the tensors of a weights file, without the prefixes that wrappers add to their names."""
    state: Any = read_tensors(path) if path.suffix == ".safetensors" else _unpickled(path)
    for key in ("state_dict", "model"):
        if isinstance(state, Mapping) and isinstance(state.get(key), Mapping):
            state = state[key]
    if not isinstance(state, Mapping) or not state or not all(isinstance(v, Tensor) for v in state.values()):
        raise CheckpointError(path, "holds no state dict of tensors", "give a released checkpoint's weights")
    for prefix in _PREFIXES:
        if all(str(name).startswith(prefix) for name in state):
            state = {str(name).removeprefix(prefix): value for name, value in state.items()}
    return {str(name): value for name, value in state.items()}


def _unpickled(path: Path) -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings of old protocols; the error below covers them
            return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as fault:
        raise CheckpointError(
            path, "holds more than tensors, or is damaged; it is not opened", "convert it to safetensors"
        ) from fault
    except (
        OSError,
        RuntimeError,
        ValueError,
        EOFError,
        KeyError,
        TypeError,
        AttributeError,
        zipfile.BadZipFile,
    ) as fault:
        first = (str(fault).splitlines() or [type(fault).__name__])[0]
        raise CheckpointError(path, f"cannot be read: {first}", "download it again") from fault


# -- checking


def _explained(folder: Path, make: Any) -> HMAConfig:
    """Return the configuration; an error names the path of its file."""
    try:
        config: HMAConfig = make()
    except CheckpointError as fault:
        raise CheckpointError(folder / CONFIG, fault.fault, fault.remedy) from fault
    return config


def _check_fit(path: Path, state: State, config: HMAConfig, values: Mapping[str, Any]) -> None:
    """Raise unless names and shapes fit the released architecture that config.json describes."""
    domains = domains_of(state)
    named = values.get("action_domains") or []
    lacking = [name for name in named if name not in domains]
    if lacking:
        fault = f"lack the domains {_some(lacking)} that {CONFIG} names"
        raise CheckpointError(
            path, fault, f"they have {_some(domains) or 'none'}; is it another model's {CONFIG}?"
        )
    expected = _expected(path, state, config, domains)
    missing, extra = sorted(expected.keys() - state.keys()), sorted(state.keys() - expected.keys())
    shapes = [
        f"{name} is {list(state[name].shape)}, not {list(shape)}"
        for name, shape in sorted(expected.items())
        if name in state and tuple(state[name].shape) != shape
    ]
    faults = [
        f"{what} {_some(found)}" for what, found in (("lacks", missing), ("has unknown", extra)) if found
    ]
    faults += [f"shapes differ: {_some(shapes)}"] if shapes else []
    if faults:
        fault = f"is not the model that {CONFIG} describes: {'; '.join(faults)}"
        raise CheckpointError(path, fault, f"give weights and {CONFIG} of one released checkpoint")


def _expected(path: Path, state: State, config: HMAConfig, domains: list[str]) -> dict[str, tuple[int, ...]]:
    """Return names and shapes of the released layout, by converting a model without data to it."""
    with torch.device("meta"):
        model = HMA(config)
        for domain in domains:
            model.add_embodiment(_space(path, state, domain))
        parts = {domain: (model.stem_state(domain), model.head_state(domain)) for domain in domains}
        released = state_to_released(model.trunk_state(), parts, config)
    return {name: tuple(tensor.shape) for name, tensor in released.items()}


def _space(path: Path, state: State, domain: str) -> ActionSpace:
    """Return the action space of a domain, with the width and stride that its tensors' shapes imply."""
    names = f"action_preprocessor.{domain}.mean", f"action_mlp.{domain}.model.0.weight"
    if any(name not in state for name in names):
        lacking = next(name for name in names if name not in state)
        raise CheckpointError(path, f"lacks {lacking}", "is the file complete?")
    dims, chunk = state[names[0]].numel(), state[names[1]].shape[-1]
    if dims < 1 or chunk % dims:
        fault = f"domain {domain!r} has chunks of {chunk} values and statistics of {dims}"
        raise CheckpointError(path, fault, "they are not of one model")
    return ActionSpace(domain, dims, chunk // dims, (0.0,) * dims, (1.0,) * dims, (True,) * dims, "divide")


def _check_finite(path: Path, state: State) -> None:
    for name, tensor in state.items():
        if not bool(torch.isfinite(tensor).all()):
            raise CheckpointError(path, f"{name} holds values that are not finite", "download it again")
        if name.endswith(".std") and bool((tensor < 0).any()):
            raise CheckpointError(path, f"{name} is negative", "download it again")


def _some(names: list[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more


# -- describing


def _ids(domains: list[str], path: Path) -> dict[str, str]:
    """Return our id for each released domain."""
    ids: dict[str, str] = {}
    for domain in domains:
        name = re.sub(r"[^a-z0-9_-]+", "_", domain.lower())[:100]
        name = name if re.match(r"[a-z0-9]", name) else f"d{name}"[:100]
        if name in ids.values():
            raise CheckpointError(
                path, f"two domains would have the id {name!r}", "import one with embodiments="
            )
        ids[domain] = name
    return ids


def _choose(ids: dict[str, str], wanted: Iterable[str] | None, path: Path) -> dict[str, str]:
    if wanted is None:
        return ids
    chosen = {}
    for name in wanted:
        found = [domain for domain, own in ids.items() if name in (domain, own)]
        if not found:
            raise CheckpointError(path, f"has no domain {name!r}", f"it has: {', '.join(ids) or 'none'}")
        chosen[found[0]] = ids[found[0]]
    return chosen


def _tokenizer_spec(config: HMAConfig, name: str | None, folder: Path) -> TokenizerSpec:
    """Return the tokenizer's spec, without the hash of its weights, which the release does not state."""
    discrete = config.kind == "discrete"
    paper = config.vocab_size == 2**18 if discrete else config.channels == 4
    known = find_entry(name) if name else None
    if known and (known.kind, known.grid) != (config.kind, config.grid):
        theirs = f"{name} gives {known.kind} ones of {known.grid}"
        fault = f"was trained on {config.kind} tokens of a grid {config.grid}, {theirs}"
        raise CheckpointError(folder, fault, "name its own tokenizer")
    own = ("magvit2" if discrete else "svd-vae") if paper else "unknown"
    return TokenizerSpec(
        name=name or own,
        version=1,
        kind="discrete" if discrete else "continuous",
        image_size=known.image_size if known else max(config.grid) * (16 if discrete else 8),
        grid=config.grid,
        vocab_size=config.vocab_size if discrete else None,
        factored=config.factored if discrete else (),
        channels=None if discrete else config.channels,
        latent_scale=1.0 if discrete else LATENT_SCALE,
        dtype="uint32" if discrete else "float16",
    )


def _yaml(domain: str, space: ActionSpace) -> str:
    """Return the YAML of the registry's embodiment, if its width fits; else one with unknown values."""
    try:
        values = find(space.id).to_dict()
    except HMAError:
        values = {}
    parts = values.get("action", {}).get("components", [])
    if sum(part["dims"] for part in parts) != space.action_dim:
        return Embodiment.from_values(_unknown(domain, space), space.id).to_yaml()
    for part in parts:  # the released normalisation covers every value
        part.pop("normalize", None)
    return Embodiment.from_values(values | {"stride": space.stride}, space.id).to_yaml()


def _unknown(domain: str, space: ActionSpace) -> dict[str, Any]:
    unknown = "unknown: a released checkpoint does not state it"
    return {
        "id": space.id,
        "description": f"domain {domain} of a released checkpoint; how it was recorded is unknown",
        "kind": "real",
        "frequency_hz": "unknown",
        "stride": space.stride,
        "action": {"space": "mixed", "components": [{"key": "action", "dims": space.action_dim}]},
        "cameras": [{"name": "primary", "key": "image"}],
        "source": {"format": "rlds"},
        "provenance": dict.fromkeys(("kind", "frequency_hz", "action", "cameras", "source"), unknown),
    }


def _stats(space: ActionSpace) -> dict[str, Any]:
    return {
        "action": {"mean": list(space.mean), "std": list(space.std), "zero_variance": space.zero_variance}
    }


def _card(domain: str, source: str | Path) -> dict[str, Any]:
    shown = Path(source).name if Path(source).exists() else str(source)
    return {"data": {"released_checkpoint": shown, "released_domain": domain}}
