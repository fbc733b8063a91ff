"""Publish and pull checkpoints, one embodiment at a time.

A hub is a folder, any fsspec URI, or a repository of the Hugging Face Hub; all hold the layout of
`hma_model.checkpoint`. `org/name` and `hf://org/name` are repositories; `./org/name` or any other path is a
folder.
"""

import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hma_data.errors import CheckpointError, HMAError, HubError
from hma_data.registry.embodiment import find
from hma_data.storage.files import cache_folder, short_sha256
from hma_data.storage.paths import StrPath, addressed, as_address, as_path, is_repository
from hma_data.storage.remote import RemotePath
from hma_model.checkpoint import io as checkpoints
from hma_model.checkpoint import weights
from hma_model.checkpoint.folder import (
    CARD,
    CONFIG,
    EMBEDDED_NAME,
    PARTS,
    PICTURES,
    README,
    TRUNK,
    Checkpoint,
    check_id,
    parse_config,
)  # fmt: skip
from hma_model.checkpoint.model_card import JUDGED, render
from hma_model.hub.stores import FolderStore, Store, embodiment_ids, open_published, open_store, read_object

if TYPE_CHECKING:
    import torch

    from hma_model.network.model import HMA

Content = Path | bytes
PAGE = "page/"  # begins the names of the files of a page
ENV = "env.py"  # lerobot's EnvHub reads it
ENV_CODE = '''"""Offer this checkpoint to lerobot as environments of its robots; pip install hma-toolkit."""


def make_env(n_envs=1, use_async_envs=False, cfg=None):
    from hma_model.lerobot_env import published_envs

    return published_envs(__file__, {repo!r}, n_envs, cfg)
'''
MAX_NAMED = 50  # ids that an error lists
_ADD_ONE = (
    f"Add one: hma finetune SHARDS --from {EMBEDDED_NAME} --out RUN, "
    "with shards of hma convert --tokenizer palette-64 (drawn images) or fsq-lab (photographs)"
)


# -- pushing


def push(
    checkpoint: StrPath | Checkpoint,
    target: StrPath,
    embodiments: Iterable[str] | None = None,
    private: bool | None = None,
    page: Path | None = None,
) -> str:
    """Publish embodiments of a checkpoint, and its trunk if the hub has none yet.

    Args:
        checkpoint: an open one, or str or path of its folder, or of the folder of a training run.
        target: str or path of a folder, a URI, or a repository; it is made if it does not exist.
        embodiments: ids; None for all.
        private: make a new repository a private one.
        page: a folder of `hma export`, published as `page/` in the place of an older one.

    Returns:
        The address of the published checkpoint: a path, URI or web address.

    Raises:
        CheckpointError: the checkpoint's parts do not belong together or are damaged, or it lacks an
            embodiment; nothing is made or sent then.
        HubError: the target has another trunk or holds something else, or cannot be reached or written.
    """
    source = Checkpoint.open(checkpoint, embodiments)
    ids = sorted(source.chosen(embodiments))
    weights.trunk(source)  # others must be able to load what is published
    for name in ids:
        checkpoints.read_embodiment(source, name)
        stated = source.card(name).get("id", name)
        if stated != name:
            fault = f"is the card of {str(stated)[:60]!r}"
            raise CheckpointError(source.path(name, CARD), fault, "save the checkpoint again")
    store = open_store(target, write=True, private=private)
    message = f"Add {', '.join(ids)}" if ids else "Add the trunk"
    return store.publish(lambda: _changes(source, ids, store, page), message)


def push_model(model: "HMA", target: StrPath, embodiments: Iterable[str] | None = None) -> str:
    """Publish a model as `HMA.push_to_hub` does, with the YAML, statistics and cards of its source."""
    source = model.source
    # The trunk's file is taken over where it is unchanged: its hash tells which stems fit it.
    base = source if source and source.config == model.config else None
    if base and not _is_same(model.trunk_state(), weights.trunk(base)):
        base = None
    yaml, stats, cards = {}, {}, {}
    for name, space in model.embodiments.items():
        if source and name in source.embodiments:
            yaml[name] = source.embodiment(name).to_yaml()
            stats[name] = source.stats(name)
            card = source.card(name)
            cards[name] = {key: card.get(key, {}) for key in ("data", "metrics", "training")}
            judged = {part: card[part] for part in JUDGED if part in card}
            if base and judged:  # they stay if they judged these weights
                stem, head = weights.embodiment(base, name, space)
                if _is_same(model.stem_state(name), stem) and _is_same(model.head_state(name), head):
                    cards[name] |= judged
            continue
        try:
            yaml[name] = find(name).to_yaml()
        except HMAError as fault:
            text = "has no YAML where the model was loaded from, nor in the registry"
            remedy = "save with hma_model.checkpoint.io.save and push the folder"
            raise HubError(f"embodiment {name}", text, remedy) from fault
        stats[name] = space.stats()
    with tempfile.TemporaryDirectory() as folder:
        saved = checkpoints.save(
            model, Path(folder) / "model", embodiment_yaml=yaml, stats=stats, cards=cards, base=base
        )
        return push(saved, target, list(model.embodiments) if embodiments is None else embodiments)


def _is_same(own: weights.State, stored: weights.State) -> bool:
    """Check whether tensors are those that were stored, perhaps in float16."""
    return own.keys() == stored.keys() and all(
        bool((own[name].cpu() == stored[name].to(own[name].dtype)).all()) for name in own
    )


def _changes(
    source: Checkpoint, ids: list[str], store: Store, page: Path | None
) -> dict[str, Content | None]:
    """Return what a push writes (contents) and deletes (None), by name, on top of what the hub has now."""
    from hma_data.shards.manifest import MANIFEST  # imports pyarrow

    files = store.files()
    changes: dict[str, Content | None] = {}
    if CONFIG in files:
        there, own_place = _config(store, files), "push to another address"
        if there.get("trunk_sha256") != source.trunk_sha256:
            theirs, ours = str(there.get("trunk_sha256"))[:16], source.trunk_sha256[:16]
            fault = f"has another trunk: {theirs}, this checkpoint's is {ours}"
            raise HubError(store.name, fault, f"{own_place}, or finetune from the published trunk")
        if there.get("tokenizer") != source.config.to_json()["tokenizer"]:
            raise HubError(store.name, "has the same trunk with another tokenizer", own_place)
    else:
        # A push begins with these; git's files are no content. A repository keeps what is overwritten.
        own = (TRUNK, ".git", ".gitattributes", "embodiments")
        foreign = [name for name in sorted(files) if name.split("/")[0] not in own]
        if foreign and (store.repo is None or MANIFEST in foreign):
            named = "a shard set" if MANIFEST in foreign else f"something else: {foreign[0]}"
            raise HubError(store.name, f"holds {named}", "push to another address")
        changes[CONFIG] = source.folder / CONFIG
    if TRUNK not in files:
        changes[TRUNK] = source.folder / TRUNK
    if not {CONFIG, ENV} <= files.keys():
        changes[ENV] = ENV_CODE.format(repo=store.repo).encode()
    if page is not None:
        changes |= {name: None for name in files if name.startswith(PAGE)}
        parts = [path for path in page.rglob("*") if path.is_file()]
        changes |= {f"{PAGE}{path.relative_to(page).as_posix()}": path for path in parts}
    for name in ids:
        # A picture that is there shows what earlier weights did.
        changes |= {path: None for part in PICTURES if (path := f"embodiments/{name}/{part}") in files}
        changes |= source.files(name)
    others = {name: f"embodiments/{name}/{CARD}" for name in embodiment_ids(files) if name not in ids}
    store.warm(list(others.values()))
    cards = source.cards(ids)
    for name, path in others.items():
        cards[name] = {}
        with suppress(HubError):  # a card of somebody else that cannot be read stops no push
            cards[name] = read_object(store, path)
    after = {path for path in {*files, *changes} if changes.get(path, b"") is not None}
    samples = {path.removeprefix("embodiments/") for path in after if path.endswith(PICTURES)}
    config = checkpoints.config_json(source.config, source.trunk_sha256)
    paged = f"{PAGE}index.html" in after
    changes[README] = render(config, cards, repo=store.repo, samples=samples, page=paged)
    return changes


# -- pulling


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
    return _pull(as_address(source), embodiments, as_path(out) if out else None, revision)[0].folder


def from_pretrained(
    source: StrPath,
    embodiments: Iterable[str] | None = None,
    revision: str | None = None,
    device: "str | torch.device" = "cpu",
) -> "HMA":
    """Load a model as `HMA.from_pretrained` does; the source may also be a training run's folder."""
    return checkpoints.load(*located(source, embodiments, revision), str(device))


def located(
    source: StrPath, embodiments: Iterable[str] | None = None, revision: str | None = None
) -> tuple[Checkpoint, list[str]]:
    """Open a checkpoint, and return it with the requested ids; a published one is fetched.

    Args:
        source: str or path of a checkpoint or training run, a URI, `org/name` or `org/name@revision`.
        embodiments: ids; None for all.
    """
    address, revision = addressed(as_address(source), revision)
    if is_repository(address) or "://" in str(address):
        return _pull(address, embodiments, None, revision)
    checkpoint = Checkpoint.open(Path(address).expanduser(), embodiments)
    checkpoint.trunk()
    try:
        return checkpoint, checkpoint.chosen(embodiments)
    except CheckpointError as fault:
        if not checkpoint.bundled:
            raise
        raise CheckpointError(fault.where, fault.fault, f"{fault.remedy}. {_ADD_ONE}") from fault


def _pull(
    source: str | Path, embodiments: Iterable[str] | None, out: Path | None, revision: str | None
) -> tuple[Checkpoint, list[str]]:
    """Return the fetched checkpoint and the requested ids; its folder may hold older ones too."""
    store, files = open_published(source, revision)
    values = _config(store, files)
    there = embodiment_ids(files)
    wanted = list(dict.fromkeys(there if embodiments is None else embodiments))
    for name in wanted:
        check_id(name, store.name)
        if name not in there:
            away = " in the cache, and is out of reach" if store.from_cache else ""
            known = f"it has: {', '.join(there[:MAX_NAMED]) or 'none'}"
            raise HubError(store.name, f"has no embodiment {name!r}{away}", known)
        lacking = [part for part in PARTS if f"embodiments/{name}/{part}" not in files]
        if lacking and not store.from_cache:
            fault = f"lacks {lacking[0]} of embodiment {name!r}"
            raise HubError(store.name, fault, "name the embodiments you want, or push it again")
    if TRUNK not in files and not store.from_cache:
        raise HubError(store.name, f"has no {TRUNK}", "push it again")
    names = [CONFIG, TRUNK]
    for name in wanted:
        shown = [part for part in PICTURES if f"embodiments/{name}/{part}" in files]
        names += [f"embodiments/{name}/{part}" for part in (*shown, *PARTS)]
    place = folder = store.pull(names)
    if isinstance(folder, RemotePath):
        key = f"{store.name} {values.get('trunk_sha256')}"
        place = cache_folder() / "hub" / short_sha256(key, 24)
    place = out or place
    if place != folder:
        FolderStore(folder).download(names, place)
    pulled = Checkpoint.open(place)
    pulled.trunk()
    for name in wanted:
        pulled.check(name)
    if out:
        checkpoints.write_readme(pulled)
    return pulled, wanted


def _config(store: Store, files: dict[str, int]) -> dict[str, Any]:
    if CONFIG not in files:
        raise HubError(
            store.name, f"has no {CONFIG}", "it is not a checkpoint of hma-toolkit; check the name"
        )
    values = read_object(store, CONFIG)
    try:
        parse_config(values, f"{store.name}/{CONFIG}")
    except CheckpointError as fault:
        raise HubError(fault.where, fault.fault, fault.remedy) from fault
    return values
