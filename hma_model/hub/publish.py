"""Publish and pull checkpoints, one embodiment at a time.

A hub is a folder, any fsspec URI, or a repository of the Hugging Face Hub; all hold the layout of
`hma_model.checkpoint`. `org/name` and `hf://org/name` are repositories; `./org/name` or any other path is a
folder.
"""

import hashlib
import tempfile
from collections.abc import Callable, Iterable
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hma_data.errors import CheckpointError, HMAError, HubError
from hma_data.hub.repository import Repository
from hma_data.registry.embodiment import ID_PATTERN, find
from hma_data.storage.files import cache_folder, file_sha256, json_object
from hma_data.storage.paths import StrPath, addressed, as_address, as_path, as_text, is_repository
from hma_data.storage.remote import RemotePath
from hma_model.checkpoint import io as checkpoints
from hma_model.checkpoint import weights
from hma_model.checkpoint.folder import (
    CARD,
    CONFIG,
    EMBEDDED,
    EMBEDDED_NAME,
    PARTS,
    README,
    SHOWN,
    TRUNK,
    YAML,
    Checkpoint,
    check_id,
    inside,
    parse_config,
    resolve,
)  # fmt: skip
from hma_model.checkpoint.model_card import render
from hma_model.hub.folder import FolderStore

if TYPE_CHECKING:
    import torch

    from hma_model.network.model import HMA

Content = Path | bytes
Store = FolderStore | Repository  # a place where a checkpoint or a shard set is published
LISTED = 50  # ids that an error lists
_ADD_ONE = (
    f"Add one: hma finetune --from {EMBEDDED_NAME} --data SHARDS --out RUN, "
    "with shards of hma convert --tokenizer {name}"
)


def open_store(
    address: StrPath,
    revision: str | None = None,
    write: bool = False,
    private: bool | None = None,
    kind: str = "model",
) -> Store:
    """Open the hub at an address.

    Args:
        address: str or path: `org/name`, a folder or a URI; `org/name@revision` too unless `write` is true.
        private: make a new repository a private one.
        kind: of a repository: model or dataset.

    Raises:
        HubError: the hub does not exist, or cannot be reached.
    """
    place = as_address(address)
    if not write:
        place, revision = addressed(place, revision)
    if is_repository(place):
        return Repository(str(place).removeprefix("hf://"), revision, write, kind, private)
    if revision is not None:
        raise HubError(place, f"is a folder, and has no revision {revision!r}", "leave the revision out")
    return FolderStore(place, write)


def push(
    checkpoint: StrPath,
    target: StrPath,
    embodiments: Iterable[str] | None = None,
    private: bool | None = None,
    told: Callable[[dict[str, int]], None] | None = None,
) -> str:
    """Publish embodiments of a checkpoint, and its trunk if the hub has none yet.

    Args:
        checkpoint: str or path of its folder, or of the folder of a training run.
        target: str or path of a folder, a URI, or a repository; it is made if it does not exist.
        embodiments: ids; None for all.
        private: make a new repository a private one.
        told: called once before anything is sent, with the files to send and their sizes in bytes.

    Returns:
        The address of the published checkpoint: a path, URI or web address.

    Raises:
        CheckpointError: the checkpoint's parts do not belong together or are damaged, or it lacks an
            embodiment; nothing is made or sent then.
        HubError: the target has another trunk or holds something else, or cannot be reached or written.
    """
    source = Checkpoint.open(checkpoint)
    ids = sorted(set(source.embodiments if embodiments is None else embodiments))
    _require_publishable(source, ids)
    store = open_store(target, write=True, private=private)

    tell = [told] if told else []

    def changes() -> dict[str, Content | None]:
        files = _changes(source, ids, store)
        while tell:  # once: a store may ask again
            tell.pop()(_sizes(files, store))
        return files

    message = f"Add {', '.join(ids)}" if ids else "Add the trunk"
    return store.publish(changes, message)


def pull(
    source: StrPath,
    embodiments: Iterable[str] | None = None,
    out: StrPath | None = None,
    revision: str | None = None,
) -> Path:
    """Fetch the trunk and the chosen embodiments, and nothing else.

    Args:
        source: str or path of a folder, a URI, or a repository.
        embodiments: ids; None for all.
        out: str or path of a folder; files that it already has are not transferred again. By default a local
            folder stays where it is, and everything else goes to the cache.
        revision: branch, tag or commit of a repository.

    Returns:
        The checkpoint's folder.

    Raises:
        HubError: the source does not exist, cannot be reached, or has no such embodiment or revision.
        CheckpointError: the fetched files do not belong together.
    """
    return _pull(as_address(source), embodiments, as_path(out) if out else None, revision)[0]


def _pull(
    source: str | Path, embodiments: Iterable[str] | None, out: Path | None, revision: str | None
) -> tuple[Path, list[str]]:
    """Return the checkpoint's folder and the requested ids; the folder may hold older ones too."""
    store, files = open_published(source, revision)
    values = _config(store, files)
    there = embodiment_ids(files)
    wanted = list(dict.fromkeys(there if embodiments is None else embodiments))
    for name in wanted:
        check_id(name, store.name)
        if name not in there:
            known = f"it has: {', '.join(there[:LISTED]) or 'none'}"
            away = " in the cache, and is out of reach" if store.from_cache else ""
            if store.name == str(EMBEDDED):
                raise HubError(
                    EMBEDDED_NAME,
                    f"has no embodiment {name!r}",
                    f"{known}. {_ADD_ONE.format(**values['tokenizer'])}",
                )
            raise HubError(store.name, f"has no embodiment {name!r}{away}", known)
        lacking = [part for part in PARTS if f"embodiments/{name}/{part}" not in files]
        if lacking and not store.from_cache:
            fault = f"lacks {lacking[0]} of embodiment {name!r}"
            raise HubError(store.name, fault, "name the embodiments you want, or have it pushed again")
    if TRUNK not in files and not store.from_cache:
        raise HubError(store.name, f"has no {TRUNK}", "have it pushed again")
    names = [f"embodiments/{name}/{part}" for name in wanted for part in (*SHOWN, *PARTS)]
    names = [CONFIG, TRUNK, *(name for name in names if name in files or not name.endswith(SHOWN))]
    place = folder = store.pull(names)
    if isinstance(folder, RemotePath):
        key = f"{store.name} {values.get('trunk_sha256')}".encode()
        place = cache_folder() / "hub" / hashlib.sha256(key).hexdigest()[:24]
    place = out or place
    if place != folder:
        FolderStore(folder).download(names, place)
    pulled = Checkpoint.open(place)
    pulled.trunk()
    for name in wanted:
        pulled.check(name)
        _require_yaml(pulled, name)
    if out:
        checkpoints.write_readme(out)
    return place, wanted


def open_published(source: StrPath, revision: str | None) -> tuple[Store, dict[str, int]]:
    """Return a hub and its files; a name that may also be a mistyped path is told to be neither."""
    try:
        store = open_store(source, revision)
        return store, store.files()
    except HubError as fault:
        name = as_text(source)
        if not is_repository(source) or "://" in name:
            raise
        if revision:
            raise HubError(f"{name}@{revision}", fault.fault, fault.remedy) from fault
        both = f"is no folder here; as a repository of the hub: {fault.fault}"
        remedy = f"give the path of a checkpoint or run, or: {fault.remedy}"
        raise HubError(name, both, remedy) from fault


def list_embodiments(source: StrPath, revision: str | None = None) -> list[dict[str, Any]]:
    """Return a row for each published embodiment; see `hma_model.hub.listing.survey`."""
    from hma_model.hub.listing import survey

    return [row for found in survey(source, revision) for row in found["embodiments"]]


def from_pretrained(
    source: StrPath,
    embodiments: Iterable[str] | None = None,
    revision: str | None = None,
    device: "str | torch.device" = "cpu",
) -> "HMA":
    """Load a model as `HMA.from_pretrained` does; the source may also be a training run's folder."""
    folder, ids = located(source, embodiments, revision)
    return checkpoints.load(folder, ids, str(device))


def located(
    source: StrPath, embodiments: Iterable[str] | None = None, revision: str | None = None
) -> tuple[Path, list[str]]:
    """Return the local folder of a checkpoint, and the requested ids; a published one is fetched.

    Args:
        source: str or path of a checkpoint or training run, a URI, `org/name` or `org/name@revision`.
        embodiments: ids; None for all.

    Raises:
        HubError, CheckpointError: as `pull`.
    """
    address, revision = addressed(as_address(source), revision)
    if not is_repository(address) and "://" not in str(address):
        address = resolve(Path(address).expanduser())
    return _pull(address, embodiments, None, revision)


def push_model(model: "HMA", target: StrPath, embodiments: Iterable[str] | None = None) -> str:
    """Publish a model as `HMA.push_to_hub` does, with the YAML, statistics and cards that it was loaded with.

    Raises:
        HubError: an embodiment has no YAML, neither in the model's source nor in the registry.
    """
    known = model.source
    yaml, stats, cards = {}, {}, {}
    for name, space in model.embodiments.items():
        if known and name in known.embodiments:
            yaml[name] = known.embodiment(name).to_yaml()
            stats[name] = known.stats(name)
            cards[name] = {key: known.card(name).get(key, {}) for key in ("data", "metrics", "training")}
        else:
            try:
                yaml[name] = find(name).to_yaml()
            except HMAError as fault:
                text = "has no YAML where the model was loaded from, nor in the registry"
                remedy = "save with hma_model.checkpoint.io.save and push the folder"
                raise HubError(f"embodiment {name}", text, remedy) from fault
            action = {"mean": list(space.mean), "std": list(space.std), "zero_variance": space.zero_variance}
            stats[name] = {"action": action}
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "model"
        same = known if known and _has_trunk(model, known) else None
        checkpoints.save(model, made, embodiment_yaml=yaml, stats=stats, cards=cards, base=same)
        return push(made, target, list(model.embodiments) if embodiments is None else embodiments)


def _has_trunk(model: "HMA", stored: Checkpoint) -> bool:
    """Check whether a model still has a checkpoint's trunk, which may be stored in float16."""
    if model.config != stored.config:
        return False
    own, theirs = model.trunk_state(), weights.trunk(stored)
    return own.keys() == theirs.keys() and all(
        bool((own[name].cpu() == theirs[name].to(own[name].dtype)).all()) for name in own
    )


def _require_publishable(source: Checkpoint, embodiments: Iterable[str]) -> None:
    """Raise unless others can load the embodiments."""
    source.trunk()
    for name in embodiments:
        _require_yaml(source, name)
        checkpoints.read_embodiment(source, name)
        if source.card(name).get("id", name) != name:
            fault = f"is the card of {str(source.card(name)['id'])[:60]!r}"
            raise CheckpointError(source.path(name, CARD), fault, "save the checkpoint again")


def _require_yaml(source: Checkpoint, name: str) -> None:
    """Raise CheckpointError unless embodiment.yaml is the file that the embodiment was saved with."""
    files = source.card(name).get("files")
    recorded = files.get(YAML) if isinstance(files, dict) else None
    path = source.path(name, YAML)
    if recorded not in (None, file_sha256(path)):
        remedy = "put the one back that it was trained with; facts for readers can be changed in the card"
        raise CheckpointError(path, f"is not the file that {CARD} names", remedy)


def _changes(source: Checkpoint, ids: list[str], store: Store) -> dict[str, Content | None]:
    from hma_data.shards.manifest import MANIFEST  # imports pyarrow

    files = store.files()
    present: dict[str, Content | None] = {}
    if CONFIG in files:
        _require_trunk(source, _config(store, files), store.name)
    else:
        if MANIFEST in files:
            raise HubError(store.name, "holds a shard set", "push to a place of its own")
        present[CONFIG] = inside(source.folder, CONFIG)
    if TRUNK not in files:
        present[TRUNK] = inside(source.folder, TRUNK)
    for name in ids:
        home = source.folder / "embodiments" / name
        shown = [part for part in SHOWN if (home / part).is_file()]
        present.update({f"embodiments/{name}/{part}": source.path(name, part) for part in (*shown, *PARTS)})
        stale = (f"embodiments/{name}/{part}" for part in SHOWN if part not in shown)
        present.update({path: None for path in stale if path in files})  # it shows what earlier weights did
    others = [name for name in embodiment_ids(files) if name not in ids]
    store.warm([f"embodiments/{name}/{CARD}" for name in others])
    cards = {name: _readable_card(store, name) for name in others}
    cards.update({name: source.card(name) for name in ids})
    there = [path for path in {*files, *present} if path not in present or present[path] is not None]
    samples = {path.removeprefix("embodiments/") for path in there if path.endswith(SHOWN)}
    config = checkpoints.config_json(source.config, source.trunk_sha256)
    present[README] = render(config, cards, repo=store.repo, samples=samples)
    return present


def _sizes(files: dict[str, Content | None], store: Store) -> dict[str, int]:
    """Return the sizes in bytes of the files that the store has not yet."""
    return {
        name: content.stat().st_size if isinstance(content, Path) else len(content)
        for name, content in files.items()
        if content is not None and not store.has(name, content)
    }


def _require_trunk(source: Checkpoint, there: dict[str, Any], where: str) -> None:
    if there.get("trunk_sha256") != source.trunk_sha256:
        theirs, ours = str(there.get("trunk_sha256"))[:16], source.trunk_sha256[:16]
        fault = f"has another trunk: {theirs}, this checkpoint's is {ours}"
        remedy = "push to a hub of its own, or finetune on the trunk that is there"
        raise HubError(where, fault, remedy)
    if there.get("tokenizer") != source.config.to_json()["tokenizer"]:
        raise HubError(where, "has the same trunk with another tokenizer", "push to a hub of its own")


def _config(store: Store, files: dict[str, int]) -> dict[str, Any]:
    """Return the values of config.json, checked."""
    if CONFIG not in files:
        raise HubError(store.name, f"has no {CONFIG}", "it is no checkpoint of hma-toolkit; check the name")
    values = json_object(store.read(CONFIG), f"{store.name}: {CONFIG}", HubError)
    try:
        parse_config(values, f"{store.name}: {CONFIG}")
    except CheckpointError as fault:
        raise HubError(fault.where, fault.fault, fault.remedy) from fault
    return values


def embodiment_ids(files: Iterable[str]) -> list[str]:
    """Return the ids that have a card, which is written last, in a listing of a checkpoint's files."""
    found = {path.split("/")[1] for path in files if fnmatchcase(path, f"embodiments/*/{CARD}")}
    return sorted(name for name in found if ID_PATTERN.fullmatch(name) and ".." not in name)


def _readable_card(store: Store, name: str) -> dict[str, Any]:
    """Return the card of an embodiment that is not pushed now; an empty card if it cannot be read."""
    path = f"embodiments/{name}/{CARD}"
    try:
        return json_object(store.read(path), f"{store.name}: {path}", HubError)
    except HubError:
        return {}
