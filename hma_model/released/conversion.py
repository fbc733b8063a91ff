"""Convert the paper's released checkpoints to checkpoints of our format, and ours to theirs.

A released folder holds config.json and model.safetensors, or pytorch_model.bin. An import reads and checks
everything before it writes anything. Facts that the release does not state (cameras, rates, units) are marked
unknown in the embodiments' YAML, unless the registry has an embodiment of the domain's name and width.

An export takes models of that layout. It folds variance outputs and readouts before a diffusion head into its
weights, and refuses what the layout cannot express, with every reason.
"""

import keyword
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from hma_data.errors import CheckpointError, HMAError, HubError
from hma_data.hub.repository import Repository
from hma_data.registry.embodiment import Embodiment, find
from hma_data.storage.files import new_folder, read_json, to_json
from hma_data.storage.paths import StrPath, addressed, as_address, as_path, is_repository
from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.catalog import find_entry
from hma_data.tokenizers.checkpoints import read_tensors
from hma_model.checkpoint.folder import CONFIG, LIBRARY, Checkpoint
from hma_model.checkpoint.io import load, save
from hma_model.checkpoint.weights import write_tensors
from hma_model.config import ActionSpace, HMAConfig
from hma_model.network.model import HMA
from hma_model.network.states import check_fit, some_of
from hma_model.released.config import LATENT_SCALE, config_from_released, config_to_released
from hma_model.released.state import State, domains_of, state_from_released, state_to_released

WEIGHTS = ("model.safetensors", "pytorch_model.bin")
_PREFIXES = ("module.", "_orig_mod.")  # which wrappers add to the names of weights


def import_released(
    source: StrPath,
    out: StrPath,
    *,
    embodiments: Iterable[str] | None = None,
    grid: tuple[int, int] | None = None,
    tokenizer: str | None = None,
    revision: str | None = None,
) -> Checkpoint:
    """Convert a released checkpoint to our layout.

    Args:
        source: str or path of a folder with config.json and weights, or of the weights' file in it, or a hub
            repository.
        out: str or path of the folder of the new checkpoint.
        embodiments: domains to take, by their released names or our ids; all by default.
        grid: the tokenizer's (h, w), where a frame is not square.
        tokenizer: name of the one the model was trained on; by default the paper's, where the sizes are its.
        revision: branch, tag or commit of a repository.

    Raises:
        CheckpointError: not a released checkpoint, damaged, or of an architecture the release does not have.
        HubError: the repository is not there or out of reach.
    """
    address = as_address(source)
    weights = _weights(address, revision)
    folder, origin = weights.parent, Path(address).name if Path(address).exists() else str(address)
    values = read_json(folder / CONFIG)
    if values.get("library") == LIBRARY:
        raise CheckpointError(folder, f"is a checkpoint of {LIBRARY} already", "use it as it is")
    state = read_tensors(weights, CheckpointError)
    for prefix in _PREFIXES:
        if all(name.startswith(prefix) for name in state):
            state = {name.removeprefix(prefix): value for name, value in state.items()}
    config = config_from_released(values, grid, folder / CONFIG)
    config = config.replace(tokenizer=_tokenizer_spec(config, tokenizer, folder).to_json())
    _check_fit(weights, state, config, values)
    for name, tensor in state.items():
        if not tensor.isfinite().all():
            raise CheckpointError(weights, f"{name} holds values that are not finite", "download it again")
        if name.endswith(".std") and (tensor < 0).any():
            raise CheckpointError(weights, f"{name} is negative", "download it again")
    names = _choose(domains_of(state), embodiments, weights)
    trunk, parts = state_from_released(state, config)
    model = HMA(config)
    model.load_trunk(trunk)
    for domain, name in names.items():
        model.load_embodiment(name, *parts[domain])
    yaml, stats, cards = {}, {}, {}
    for domain, name in names.items():
        space = model.embodiments[name]
        yaml[name], stats[name] = _yaml(domain, space), space.stats()
        cards[name] = {"data": {"released_checkpoint": origin, "released_domain": domain}}
    return save(model, out, embodiment_yaml=yaml, stats=stats, cards=cards)


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
        raise CheckpointError(out, "already exists", "choose another folder")
    opened = Checkpoint.open(checkpoint)
    values = config_to_released(opened.config, opened.folder)
    model = load(opened, embodiments)
    domains = _domains(model, opened.folder)
    values |= {"init_actions": bool(domains), "use_actions": bool(domains)}
    values["action_domains"] = list(domains) or None
    values["d_actions"] = [model.embodiments[name].chunk_dim for name in domains.values()] or None
    parts = {domain: (model.stem_state(name), model.head_state(name)) for domain, name in domains.items()}
    if waved := [name for name in domains.values() if model.stem(name).waves is not None]:
        fault = f"the stem of {some_of(waved)} takes waves of the actions; the released layout has none"
        raise CheckpointError(opened.folder, fault, "the released code cannot read it")
    state = state_to_released(model.trunk_state(), parts, opened.config)
    for name, tensor in model.trunk_state().items():
        if ".q_norm." in name and not torch.equal(tensor, model.get_parameter(name.replace(".q_", ".k_"))):
            fault = f"{name} differs from that of the keys; the released layout has one norm for both"
            raise CheckpointError(opened.folder, fault, "the released code cannot read it")
    values["action_stats"] = [
        [state[f"action_preprocessor.{domain}.{part}"].tolist() for part in ("mean", "std")]
        for domain in domains
    ] or None
    try:
        with new_folder(out) as folder:
            (folder / CONFIG).write_bytes(to_json(values))
            write_tensors(folder / WEIGHTS[0], state, {"format": "pt"})
    except (OSError, SafetensorError) as fault:
        remedy = "free space or choose another folder"
        raise CheckpointError(out, f"cannot be written: {fault}", remedy) from fault
    return out


# -- reading a released checkpoint


def _weights(address: str | Path, revision: str | None) -> Path:
    """Return the file of the weights, beside config.json; fetch both from a repository."""
    path = Path(address).expanduser()
    if path.is_file():
        return path
    if path.is_dir():
        if found := [path / name for name in WEIGHTS if (path / name).is_file()]:
            return found[0]
        raise CheckpointError(path, f"has no {' or '.join(WEIGHTS)}", "give a released checkpoint's folder")
    address, revision = addressed(address, revision)
    if not is_repository(address):
        raise CheckpointError(address, "no such file or folder", "give a folder, or ORGANISATION/NAME")
    store = Repository(str(address).removeprefix("hf://"), revision)
    there = store.files()
    names = [name for name in WEIGHTS if name in there][:1]
    if CONFIG not in there or not names:
        fault = f"has no {CONFIG} with {' or '.join(WEIGHTS)}"
        raise HubError(store.name, fault, "is it a released checkpoint?")
    return store.pull([CONFIG, *names]) / names[0]


# -- checking


def _check_fit(path: Path, state: State, config: HMAConfig, values: Mapping[str, Any]) -> None:
    """Raise unless names and shapes fit the released architecture that config.json describes."""
    domains = domains_of(state)
    named = values.get("action_domains") or []
    if lacking := [name for name in named if name not in domains]:
        remedy = f"they have {some_of(domains) or 'none'}; is it another model's {CONFIG}?"
        raise CheckpointError(path, f"lacks the domains {some_of(lacking)} that {CONFIG} names", remedy)
    with torch.device("meta"):  # names and shapes of the layout, from a model without data
        model = HMA(config)
        for domain in domains:
            model.add_embodiment(_space(path, state, domain))
        parts = {domain: (model.stem_state(domain), model.head_state(domain)) for domain in domains}
        made = state_to_released(model.trunk_state(), parts, config)
    try:
        check_fit(path, state, made)
    except CheckpointError as wrong:
        fault = f"is not the model that {CONFIG} describes: {wrong.fault}"
        raise CheckpointError(path, fault, f"give weights and {CONFIG} of one released checkpoint") from wrong


def _space(path: Path, state: State, domain: str) -> ActionSpace:
    """Return the action space of a domain, with the width and stride that its tensors' shapes imply."""
    names = f"action_preprocessor.{domain}.mean", f"action_mlp.{domain}.model.0.weight"
    for name in names:
        if name not in state:
            raise CheckpointError(path, f"lacks {name}", "is the file complete?")
    dims, chunk = state[names[0]].numel(), state[names[1]].shape[-1]
    if dims < 1 or chunk % dims:
        fault = f"domain {domain!r} has chunks of {chunk} values and statistics of {dims}"
        raise CheckpointError(path, fault, "they are not of one model")
    return ActionSpace(domain, dims, chunk // dims, (0.0,) * dims, (1.0,) * dims, (True,) * dims, "divide")


# -- describing


def _choose(domains: list[str], wanted: Iterable[str] | None, path: Path) -> dict[str, str]:
    """Return our id for each released domain, or for those that are wanted by either name."""
    ids: dict[str, str] = {}
    for domain in domains:
        name = re.sub(r"[^a-z0-9_-]+", "_", domain.lower())[:100]
        name = name if re.match(r"[a-z0-9]", name) else f"d{name}"[:100]
        if name in ids.values():
            fault = f"two domains would have the id {name!r}"
            raise CheckpointError(path, fault, "import one of them by embodiments=")
        ids[domain] = name
    names = list(ids if wanted is None else wanted)
    for name in names:
        if name not in ids and name not in ids.values():
            raise CheckpointError(path, f"has no domain {name!r}", f"it has: {', '.join(ids) or 'none'}")
    return {domain: own for domain, own in ids.items() if domain in names or own in names}


def _tokenizer_spec(config: HMAConfig, name: str | None, folder: Path) -> TokenizerSpec:
    """Return the tokenizer's spec, without the hash of its weights, which the release does not state."""
    discrete = config.discrete
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


# -- describing ours to the release


def _domains(model: HMA, where: object) -> dict[str, str]:
    """Return the id of each released name, which has no dots because it is a module's name in their code."""
    domains: dict[str, str] = {}
    for name in model.embodiments:
        domain = name.replace(".", "_")
        if domain in domains or hasattr(nn.ModuleDict(), domain) or keyword.iskeyword(domain):
            fault = f"embodiment {name!r} cannot be a domain called {domain!r}"
            raise CheckpointError(where, fault, "export the others by --embodiment")
        domains[domain] = name
    return domains
