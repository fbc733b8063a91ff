"""List the checkpoints of a hub, ours and released ones, and whether they can be used here.

A folder may hold one checkpoint, or many in separate folders. Only JSON files are read.
"""

from collections.abc import Mapping
from typing import Any

from hma_data.errors import HMAError, HubError, PluginError, TokenizerError
from hma_data.storage.paths import StrPath
from hma_model.checkpoint.folder import CARD, CONFIG, LIBRARY, PARTS, TRUNK, digest, parse_config, value_of
from hma_model.hub.stores import Store, embodiment_ids, open_store, read_object

RELEASED_WEIGHTS = ("model.safetensors", "pytorch_model.bin")
FIGURES = ("val_loss", "baseline_loss", "psnr", "ssim")
MAX_LISTED = 200  # checkpoints of one folder


def survey(source: StrPath, revision: str | None = None) -> list[dict[str, Any]]:
    """Describe every checkpoint of a repository or folder.

    Args:
        source: str or path of a folder, a URI, or a repository.
        revision: branch, tag or commit of a repository.

    Returns:
        For each: `checkpoint` (address), `format` (hma-toolkit or released), `format_version`, `model`,
        `tokenizer`, `trunk_sha256`, `trunk_bytes`, `problems` (why it cannot be used here, or none) and
        `embodiments`: rows of id, action, rate, figures, licence, bytes and problems.

    Raises:
        HubError: the source does not exist, cannot be reached, or holds no checkpoint.
    """
    store = open_store(source, revision)
    files = store.files()
    if store.from_cache:  # which has what was pulled, not what is there
        raise HubError(store.name, "is out of reach", "go online and list again")
    roots = sorted(name.removesuffix(CONFIG) for name in files if f"/{name}".endswith(f"/{CONFIG}"))
    described = (_checkpoint(store, files, root) for root in roots[:MAX_LISTED])
    found = [facts for facts in described if facts]
    if not found:
        fault = f"has no {CONFIG} of a checkpoint of {LIBRARY} or of the release"
        raise HubError(store.name, fault, "check the name: it is not of hma-toolkit")
    return found


def list_embodiments(source: StrPath, revision: str | None = None) -> list[dict[str, Any]]:
    """Return a row for each published embodiment; see `survey`."""
    return [row for found in survey(source, revision) for row in found["embodiments"]]


def _checkpoint(store: Store, files: Mapping[str, int], root: str) -> dict[str, Any] | None:
    """Describe the checkpoint in a folder of a hub; return None if config.json is of something else."""
    inside = {name.removeprefix(root): size for name, size in files.items() if name.startswith(root)}
    where = store.name + (f"/{root.rstrip('/')}" if root else "")
    facts: dict[str, Any] = {
        "checkpoint": where, "format": LIBRARY, "format_version": None, "origin": None, "model": None,
        "tokenizer": None, "trunk_sha256": None, "trunk_bytes": inside.get(TRUNK, 0), "problems": [],
        "embodiments": [],
    }  # fmt: skip
    try:
        values = read_object(store, root + CONFIG)
    except HMAError as fault:
        return facts | {"problems": [fault.fault]} if TRUNK in inside else None
    if values.get("library") == LIBRARY:
        _add_ours(facts, store, inside, root, values)
        return facts
    weights = [inside[name] for name in RELEASED_WEIGHTS if name in inside]
    if not weights or not {"num_layers", "d_model"} <= values.keys():
        return None
    facts |= {"format": "released", "trunk_bytes": weights[0]}
    facts["problems"] = ["in the release's layout: convert it with hma hub import"]
    facts["model"] = {"layers": values["num_layers"], "width": values["d_model"]}
    domains, dims = values.get("action_domains"), values.get("d_actions")
    if isinstance(domains, list) and isinstance(dims, list):
        for name, dim in zip(domains, dims):
            facts["embodiments"].append(_row(str(name)[:100], {"chunk_dim": dim}, 0, []))
    return facts


def _add_ours(
    facts: dict[str, Any], store: Store, files: Mapping[str, int], root: str, values: dict[str, Any]
) -> None:
    """Add what config.json and the cards of a checkpoint of ours say, and what is wrong with them."""
    where, problems, tokenizer = facts["checkpoint"], facts["problems"], values.get("tokenizer")
    facts |= {key: values.get(key) for key in ("format_version", "trunk_sha256", "tokenizer", "model")}
    problems += _tokenizer_problems(tokenizer)
    try:
        parse_config(values, f"{where}/{CONFIG}")
    except HMAError as fault:
        problems.append(f"{fault.fault}: {fault.remedy}")
    if TRUNK not in files:
        problems.append(f"lacks {TRUNK}")
    ids = embodiment_ids(files)
    store.warm([f"{root}embodiments/{name}/{CARD}" for name in ids])
    for name in ids:
        home = f"embodiments/{name}"
        wrong = [f"lacks {part}" for part in PARTS if f"{home}/{part}" not in files]
        size = sum(files.get(f"{home}/{part}", 0) for part in PARTS)
        try:
            card = read_object(store, f"{root}{home}/{CARD}")
            if card.get("trunk_sha256") != values.get("trunk_sha256"):
                wrong.append("belongs to another trunk")
            if isinstance(tokenizer, dict) and card.get("tokenizer") != digest(tokenizer):
                wrong.append("was trained on another tokenizer")
        except HMAError as fault:
            card, wrong = {}, [fault.fault]
        if origin := value_of(card.get("data"), "released_checkpoint"):
            facts["origin"] = f"imported from {origin}"
        facts["embodiments"].append(_row(name, card, size, wrong))


def _row(name: str, card: Mapping[str, Any], size: int, problems: list[str]) -> dict[str, Any]:
    return {
        "embodiment": name,
        **{key: card.get(key) for key in ("robot", "action_dim", "chunk_dim", "stride", "data")},
        "hz": card.get("effective_hz"),
        **{key: value_of(card.get("metrics"), key) for key in FIGURES},
        "verdict": value_of(card.get("evaluation"), "verdict"),
        "licence": card.get("license"),
        "bytes": size,
        "problems": problems,
    }


def _tokenizer_problems(tokenizer: Any) -> list[str]:
    """Return the problems that prevent decoding the model's predictions here."""
    from hma_data.tokenizers.catalog import find_entry, other_weights

    name = value_of(tokenizer, "name")
    try:
        entry = find_entry(str(name))
    except PluginError as fault:
        return [str(fault)]
    except TokenizerError:
        return [f"tokenizer {str(name)[:60]!r} is not one of this release: decoding needs it"]
    if isinstance(tokenizer, Mapping) and (digest := other_weights(tokenizer)):
        return [f"tokenizer {name} has weights of its own ({digest[:12]}…): decoding needs them"]
    missing = entry.missing()
    return [f"tokenizer {name} needs {', '.join(missing)}: {entry.extra}"] if missing else []
