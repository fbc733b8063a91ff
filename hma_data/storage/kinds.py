"""Tell what a path holds, for errors: a recording where shards are wanted, a Git LFS pointer, no permission.

Only names and first bytes are looked at, and only after something else has failed.
"""

import os
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from itertools import islice
from pathlib import Path

from hma_data.storage.remote import is_remote

LFS = b"version https://git-lfs.github.com/spec/"
_RECORDED = (".hdf5", ".h5", ".bag", ".mcap", ".db3", ".mp4", ".mkv", ".avi", ".mov", ".webm")
_ARRAYS, _TABLES = (".zarr", ".png", ".jpg", ".jpeg", ".npz", ".npy", ".pkl"), (".csv", ".json")
_DESCRIBED = ("meta/info.json", "features.json", "dataset_info.json", "metadata.yaml")
_USE = {
    "a recording": "hma inspect shows it, hma convert makes shards of it",
    "a shard set": "hma shards info shows it, hma train takes it as data",
    "a checkpoint": "hma evaluate, hma generate and hma play take it",
    "a YAML file": "give the YAML of an embodiment by --embodiment (-e)",
}


def kind_of(path: Path) -> str:
    """Return what is at a path of this machine, one of `_USE`; empty where it is nothing of these."""
    with suppress(OSError):
        if path.suffix.lower() in (".yaml", ".yml") and path.is_file():
            return "" if path.name == "metadata.yaml" else "a YAML file"
        if (path / "trunk.safetensors").is_file() or any(path.glob("checkpoints/step-*")):
            return "a checkpoint"
        if any(path.glob("train/shard-*.parquet")) or any(path.glob("val/shard-*.parquet")):
            return "a shard set"
        files = [path] if path.is_file() else islice(path.rglob("*"), 2000)
        described = any((path / name).is_file() for name in _DESCRIBED)
        if described or any(file.suffix.lower() in _RECORDED or ".tfrecord" in file.name for file in files):
            return "a recording"
    return ""


def misplaced(path: Path, wanted: str) -> tuple[str, str] | None:
    """Return fault and remedy where a path holds something else of the toolkit than what is wanted."""
    kind = kind_of(path)
    return (f"is {kind}, not {wanted}", _USE[kind]) if kind and kind != wanted else None


def own_layout(files: Iterable[Path]) -> str:
    """Return the images, arrays and tables among the files, such as `60 .png, 2 .csv`.

    The result is empty without images or arrays: then it is no recording in a layout of somebody's own.
    """
    counts = Counter(".zarr" if ".zarr/" in file.as_posix() else file.suffix.lower() for file in files)
    held = [f"{counts[suffix]:,} {suffix}" for suffix in (*_ARRAYS, *_TABLES) if counts[suffix]]
    return ", ".join(held) if any(counts[suffix] for suffix in _ARRAYS) else ""


def one_line(fault: object, length: int = 160) -> str:
    """Return the text of an error, or its type if it has none, as one line of at most so many letters."""
    return " ".join(str(fault).split())[:length] or type(fault).__name__


def unreadable(path: Path, fault: str, remedy: str) -> tuple[str, str]:
    """Return fault and remedy of a file or folder that could not be read.

    They are those given, unless the file is empty, is a Git LFS pointer, or may not be read.
    """
    if is_remote(path):
        return fault, remedy
    mode = os.R_OK | os.X_OK if path.is_dir() else os.R_OK
    try:
        path.stat()
        if not os.access(path, mode, effective_ids=os.access in os.supports_effective_ids):
            return "may not be read: permission denied", f"ask its owner, or run chmod u+rX {path}"
        if path.is_file():
            with path.open("rb") as file:
                begin = file.read(len(LFS))
            if begin == LFS:
                return "is a Git LFS pointer instead of the file", "run git lfs pull in its folder"
            if not begin:
                return "is empty", "copy it again from where it was recorded"
    except PermissionError:
        return "may not be read: permission denied", f"ask the owner of {path.parent}"
    except OSError:
        pass
    return fault, remedy
