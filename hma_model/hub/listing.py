"""List the checkpoints of a hub, ours and released ones, and whether they can be used here.

A folder may hold one checkpoint, or many in separate folders. Only JSON files are read.
"""

from collections.abc import Iterable, Mapping
from typing import Any

from hma_data.errors import HMAError, HubError, PluginError, TokenizerError
from hma_data.storage.files import json_object
from hma_data.storage.paths import StrPath
from hma_model.checkpoint.folder import (
    CARD,
    CONFIG,
    LIBRARY,
    PARTS,
    TRUNK,
    digest,
    parse_config,
)  # fmt: skip
from hma_model.hub.stores import Store, embodiment_ids, open_store

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
        `tokenizer`, `trunk_sha256`, `trunk_bytes`, `problems` (why it cannot be used here, or none),
        `from_cache` (the hub was out of reach, and the facts are from the client's cache) and `embodiments`:
        rows of id, action, rate, figures, licence, bytes and problems. Bytes that the cache lacks are None.

    Raises:
        HubError: the source does not exist, cannot be reached, or holds no checkpoint.
    """
    store = open_store(source, revision)
    files = store.files()
    roots = sorted(name.removesuffix(CONFIG) for name in files if f"/{name}".endswith(f"/{CONFIG}"))
    found = [
        one | {"from_cache": store.from_cache}
        for root in roots[:MAX_LISTED]
        if (one := _checkpoint(store, files, root))
    ]
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
    try:
        values = json_object(store.read(root + CONFIG), f"{where}/{CONFIG}", HubError)
    except HMAError as fault:
        return _facts(where, LIBRARY, 0, [fault.fault]) if TRUNK in inside else None
    if values.get("library") == LIBRARY:
        return _ours(store, inside, root, where, values)
    if any(name in inside for name in RELEASED_WEIGHTS) and "num_layers" in values and "d_model" in values:
        return _released(inside, where, values)
    return None


def _ours(
    store: Store, files: Mapping[str, int], root: str, where: str, values: dict[str, Any]
) -> dict[str, Any]:
    size = _total_bytes(store, files, [TRUNK])
    lacks = "the cache lacks" if store.from_cache else "lacks"
    facts = _facts(where, LIBRARY, size, _tokenizer_problems(values.get("tokenizer")))
    try:
        parse_config(values, f"{where}/{CONFIG}")
    except HMAError as fault:
        facts["problems"].append(f"{fault.fault}: {fault.remedy}")
    facts |= {key: values.get(key) for key in ("format_version", "trunk_sha256", "tokenizer", "model")}
    if TRUNK not in files:
        facts["problems"].append(f"{lacks} {TRUNK}")
    store.warm([f"{root}embodiments/{name}/{CARD}" for name in embodiment_ids(files)])
    tokenizer = values.get("tokenizer")
    for name in embodiment_ids(files):
        parts = {f"embodiments/{name}/{part}": part for part in PARTS}
        size, path = _total_bytes(store, files, parts), f"embodiments/{name}/{CARD}"
        try:
            card = json_object(store.read(root + path), f"{where}/{path}", HubError)
            problems = [f"{lacks} {part}" for path, part in parts.items() if path not in files]
            if card.get("trunk_sha256") != values.get("trunk_sha256"):
                problems.append("belongs to another trunk")
            if isinstance(tokenizer, dict) and card.get("tokenizer") != digest(tokenizer):
                problems.append("was trained on another tokenizer")
        except HMAError as fault:
            card, problems = {}, [fault.fault]
        facts["embodiments"].append(_row(name, card, size, problems))
    origins = {_value_of(row["data"], "released_checkpoint") for row in facts["embodiments"]} - {None}
    facts["origin"] = f"imported from {min(map(str, origins))}" if origins else None
    return facts


def _released(files: Mapping[str, int], where: str, values: dict[str, Any]) -> dict[str, Any]:
    size = next(files[name] for name in RELEASED_WEIGHTS if name in files)
    facts = _facts(where, "released", size, ["in the release's layout: bring it in with hma hub import"])
    facts["model"] = {"layers": values.get("num_layers"), "width": values.get("d_model")}
    domains, dims = values.get("action_domains"), values.get("d_actions")
    if isinstance(domains, list) and isinstance(dims, list):
        rows = zip(domains, dims)
        facts["embodiments"] = [_row(str(name)[:100], {"chunk_dim": dim}, 0, []) for name, dim in rows]
    return facts


def _total_bytes(store: Store, files: Mapping[str, int], names: Iterable[str]) -> int | None:
    """Return the bytes of files; None if the hub is out of reach and the cache lacks one of them."""
    sizes = [files.get(name) for name in names]
    if store.from_cache and None in sizes:
        return None
    return sum(size or 0 for size in sizes)


def _facts(where: str, layout: str, size: int | None, problems: list[str]) -> dict[str, Any]:
    unknown = dict.fromkeys(("format_version", "origin", "model", "tokenizer", "trunk_sha256"))
    facts = {"checkpoint": where, "format": layout, **unknown, "trunk_bytes": size}
    return facts | {"problems": problems, "embodiments": []}


def _row(name: str, card: Mapping[str, Any], size: int | None, problems: list[str]) -> dict[str, Any]:
    metrics = card.get("metrics")
    return {
        "embodiment": name,
        "robot": card.get("robot"),
        "action_dim": card.get("action_dim"),
        "chunk_dim": card.get("chunk_dim"),
        "hz": card.get("effective_hz"),
        "stride": card.get("stride"),
        **{key: _value_of(metrics, key) for key in FIGURES},
        "verdict": _value_of(card.get("evaluation"), "verdict"),
        "data": card.get("data"),
        "licence": card.get("license"),
        "bytes": size,
        "problems": problems,
    }


def _tokenizer_problems(tokenizer: Any) -> list[str]:
    """Return the problems that prevent decoding the model's predictions here."""
    from hma_data.tokenizers.catalog import find_entry, other_weights

    name = _value_of(tokenizer, "name")
    try:
        entry = find_entry(str(name))
    except PluginError as fault:
        return [str(fault)]
    except TokenizerError:
        return [f"tokenizer {str(name)[:60]!r} is not one of this release: pictures need it"]
    if isinstance(tokenizer, Mapping) and (digest := other_weights(tokenizer)):
        return [f"tokenizer {name} has weights of its own ({digest[:12]}…): pictures need them"]
    missing = entry.missing()
    return [f"tokenizer {name} needs {', '.join(missing)}: {entry.extra}"] if missing else []


def _value_of(values: Any, key: str) -> Any:
    return values.get(key) if isinstance(values, dict) else None
