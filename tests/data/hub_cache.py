"""Recordings as the Hugging Face Hub's cache keeps what it fetched: links of a snapshot into blobs."""

import os
import shutil
from pathlib import Path


def as_snapshot(recordings: Path, cache: Path) -> Path:
    """A copy of a folder of recordings in a cache; the folder of its snapshot."""
    snapshot, blobs = cache / "datasets--me--arm/snapshots/0123abc", cache / "datasets--me--arm/blobs"
    shutil.copytree(recordings, snapshot)
    blobs.mkdir()
    for number, path in enumerate(sorted(item for item in snapshot.rglob("*") if item.is_file())):
        path.rename(blobs / str(number))
        path.symlink_to(os.path.relpath(blobs / str(number), path.parent))
    return snapshot
