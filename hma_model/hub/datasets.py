"""Publish and pull shard sets: in a dataset repository of the hub, a folder, or any fsspec URI.

The files have the layout of `docs/format.md`. README.md tells the hub's viewer which of them are tables.
"""

import tempfile
from pathlib import Path
from shlex import quote
from typing import Any

from hma_data.conversion.publish import SMALL, publish
from hma_data.errors import HubError, ShardError
from hma_data.shards.manifest import (
    EPISODES,
    FILES_BESIDE,
    FINDER,
    MANIFEST,
    SHARD_NAME,
    Manifest,
    damaged_files,
    seal_problem,
)  # fmt: skip
from hma_data.storage.files import file_sha256, write_atomic
from hma_data.storage.paths import REPOSITORY, StrPath, as_address, as_path
from hma_data.storage.yaml_io import write_yaml
from hma_data.tables import fill
from hma_data.tokenizers.catalog import other_weights
from hma_model.checkpoint.model_card import licence, line, number
from hma_model.hub.stores import Store, open_store

_OWN_FILES = {*SMALL, MANIFEST, *FILES_BESIDE}
_PULL_AGAIN = "pull again; if the error stays, push it again"
_DATASETS = "hf://datasets/"
_SPLITS = {"train": "train", "val": "validation"}  # our names, and the hub's names


def push_data(folder: StrPath, target: StrPath, *, private: bool = False) -> str:
    """Publish a shard set.

    Args:
        folder: str or path of a folder that `hma convert` wrote.
        target: organisation/name of a dataset, `hf://datasets/organisation/name`, a folder or a URI.
        private: make a new repository a private one.

    Returns:
        The address of the published set.

    Raises:
        ShardError: the set is not finished, or a shard is not the one its manifest names.
        HubError: the target holds another shard set, or cannot be reached or written.
    """
    folder = as_path(folder)
    manifest = Manifest.load(folder)
    problem, damaged = seal_problem((folder / MANIFEST).read_bytes()), damaged_files(folder, manifest)
    shards = {folder / shard.path: shard.sha256 for shard in manifest.shards}
    damaged += [path for path, sha256 in shards.items() if not _has_sha256(path, sha256)]
    if problem or damaged:
        where, fault = folder / MANIFEST, problem
        if damaged:
            where, fault = damaged[0], f"is not the file that {MANIFEST} names"
        named = quote(str(folder))
        remedy = f"hma shards verify {named} shows all; hma shards restat {named} rebuilds small files"
        raise ShardError(where, fault, remedy)
    store = _open(as_address(target), write=True, private=private)
    page = _page(manifest, store.repo)
    _refuse_others(store, manifest)
    return publish(store, folder, lambda: _refuse_others(store, manifest), page=page)


def pull_data(source: StrPath, out: StrPath, *, revision: str | None = None) -> Path:
    """Fetch a published shard set; files that `out` already has are not transferred again.

    Args:
        source: an address, as the target of `push_data`.
        out: str or path of a new folder, or of one that an interrupted pull has left.
        revision: branch, tag or commit of a repository.

    Returns:
        `out`.

    Raises:
        HubError: there is no such dataset or no shard set in it, or it cannot be reached.
        ShardError: a fetched file is not the one that the manifest names.
    """
    out, store = as_path(out), _open(as_address(source), revision)
    files = store.files()
    manifest, content = _published(store)
    if (out / MANIFEST).is_file() and (out / MANIFEST).read_bytes() != content:
        raise HubError(out, "holds another shard set", "pull to another folder")
    shards = {shard.path: shard.sha256 for shard in manifest.shards}
    lacking = [path for path in shards if path not in files]
    if lacking:
        raise HubError(store.name, f"lacks {len(lacking)} shards, {lacking[0]} first", "push it again")
    wanted = [path for path in shards if not _has_sha256(out / path, shards[path])]
    store.download([*wanted, *(name for name in SMALL if name in files)], out)
    for name in (*wanted, *(name for name in SMALL if name in manifest.files)):
        if not _has_sha256(out / name, shards.get(name) or manifest.files[name]):
            kind = "shard" if name in shards else "file"
            raise ShardError(out / name, f"is not the {kind} that {MANIFEST} names", _PULL_AGAIN)
    write_atomic(out / MANIFEST, content)
    return out


# -- checks


def _open(
    address: str | Path, revision: str | None = None, write: bool = False, private: bool = False
) -> Store:
    if str(address).startswith(_DATASETS):
        name = str(address).removeprefix(_DATASETS)
        if not REPOSITORY.fullmatch(name):
            raise HubError(address, f"is not {_DATASETS}ORGANISATION/NAME", "name a dataset repository")
        address = f"hf://{name}"
    return open_store(address, revision, write, private, "dataset")


def _published(store: Store, remedy: str = "push it again") -> tuple[Manifest, bytes]:
    if MANIFEST not in store.files():
        raise HubError(store.name, f"has no {MANIFEST}", "is it a shard set, and has its push finished?")
    with tempfile.TemporaryDirectory() as folder:
        store.download([MANIFEST], Path(folder))
        try:
            return Manifest.load(Path(folder)), (Path(folder) / MANIFEST).read_bytes()
        except ShardError as fault:
            raise ShardError(f"{store.name}/{MANIFEST}", fault.fault, remedy) from fault


def _refuse_others(store: Store, manifest: Manifest) -> dict[str, int]:
    """Return the published files; raise HubError if they are of another robot, tokenizer or kind."""
    files = store.files()
    strange = [name for name in files if not (name in _OWN_FILES or SHARD_NAME.fullmatch(name))]
    strange = [name for name in strange if not name.endswith(f"/{FINDER}")]
    if strange:
        raise HubError(store.name, f"holds something else: {strange[0]}", "push to another address")
    if MANIFEST not in files:
        return files
    there = _published(store, f"delete {MANIFEST} there if the set is yours, and push again")[0]
    theirs, ours = (
        f"{one.embodiment.id} under {one.tokenizer.name} {one.tokenizer.weights_digest}".strip()
        for one in (there, manifest)
    )
    if ours != theirs:
        fault = f"holds the shard set of {theirs}, not of {ours}"
        raise HubError(store.name, fault, "push to another address")
    return files


def _has_sha256(path: Path, sha256: str) -> bool:
    return path.is_file() and file_sha256(path) == sha256


# -- README.md


def _page(manifest: Manifest, repo: str | None) -> bytes:
    """Return README.md of a set; `repo` is None if the set lies in a folder."""
    robot, spec = manifest.embodiment, manifest.tokenizer
    rate = "unknown" if robot.frequency_hz == "unknown" else number(robot.effective_hz)
    text = fill(
        "hma_model",
        "shard_set.md",
        front=write_yaml(_front(manifest)),
        title=line(robot.id),
        description=line(robot.description) or "Recordings of one robot, tokenized.",
        facts={
            "robot": line(robot.robot),
            "actions": f"{robot.action_dim} dims, {line(robot.action.space)}",
            "frames per second of the model": rate,
            "tokenizer": f"{line(spec.name)}, {'×'.join(map(str, spec.grid))} of "
            f"{spec.image_size} pixels, {line(spec.kind)}",
            "cameras": line(manifest.cameras_line) if len(robot.cameras) > 1 else "",
            "licence": line(robot.license) or "not stated",
            "quarantined episodes": str(manifest.quarantined),
        },
        rows=_rows(manifest),
        name=repo or ".",
        place=f'"{repo}"' if repo else "str(Path.cwd())",
        split=_SPLITS[(_present(manifest) or ["train"])[0]],
        column="tokens" if spec.kind == "discrete" else "latents",
        spec=spec,
        tokenizer=line(spec.name),
        dtype=line(spec.dtype),
        weights=other_weights(spec.to_json()),
    )
    return (text + "\n").encode()


def _present(manifest: Manifest) -> list[str]:
    """Return the splits that have shards."""
    return [split for split in _SPLITS if any(shard.split == split for shard in manifest.shards)]


def _front(manifest: Manifest) -> dict[str, Any]:
    frames = [{"split": _SPLITS[split], "path": f"{split}/*.parquet"} for split in _present(manifest)]
    configs = [{"config_name": "frames", "data_files": frames, "default": True}]
    episodes = {"split": "train", "path": EPISODES}  # of both splits; datasets reserves the name "all"
    configs.append({"config_name": "episodes", "data_files": [episodes]})
    return {
        **licence([manifest.embodiment.license]),
        "task_categories": ["robotics"],
        "tags": ["robotics", "hma", "world-model", f"embodiment:{manifest.embodiment.id}",
                 f"tokenizer:{manifest.tokenizer.name}"],
        "configs": configs if frames else configs[1:],
    }  # fmt: skip


def _rows(manifest: Manifest) -> list[list[str]]:
    rows = []
    for split, counts in manifest.splits.items():
        size = sum(shard.bytes for shard in manifest.shards if shard.split == split) / 1e6
        counted = [f"{counts[key]:,}" for key in ("episodes", "frames", "shards")]
        rows.append([line(split), *counted, f"{size:,.1f}"])
    return rows
