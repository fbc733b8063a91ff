"""Keep the finished parts of a job in a folder, so that the same call continues after a stop."""

import json
import shutil
from collections.abc import Callable, Mapping
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.arrays import Array
from hma_data.errors import OutputError
from hma_data.storage.files import remove_dead_parts, write_atomic

SETTINGS = "settings.json"
DIGEST_BYTES = 32  # of the SHA-256 behind the arrays of a part


class KeptParts:
    """Finished parts of a job, each one a file of arrays.

    Args:
        folder: of the parts; it is made.
        settings: of the job, plain values.

    Raises:
        OutputError: the folder holds parts that were made with other settings.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        self.folder = folder
        path, text = folder / SETTINGS, json.dumps(settings, indent=1)
        begun = path.read_bytes() if path.exists() else None
        if any(folder.glob("*.npz")) and begun != text.encode():
            fault = "was started with other settings"
            raise OutputError(
                folder.parent, fault, f"give the same settings or another folder, or delete {folder}"
            )
        write_atomic(path, text)
        remove_dead_parts(folder.parent)  # of a job that was killed

    def path(self, key: str) -> Path:
        """Return the file of a part."""
        return self.folder / f"{key}.npz"

    def part(self, key: str, make: Callable[[], Mapping[str, Array]]) -> dict[str, Array]:
        """Return the arrays of a part: those kept, else those that `make` returns, which are then kept."""
        found = kept_arrays(self.path(key))
        if found is None:
            found = dict(make())
            keep_arrays(self.path(key), found)
        return found


def remove_kept(folder: Path) -> None:
    """Delete the parts in a folder, then their settings: after a kill in between, no part is without them."""
    for part in folder.glob("*.npz"):
        part.unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)


def keep_arrays(path: Path, arrays: Mapping[str, Array]) -> None:
    """Write an .npz file with its SHA-256 behind it, which np.load passes over."""
    file, named = BytesIO(), dict[str, Any](arrays)
    np.savez_compressed(file, **named)
    write_atomic(path, file.getvalue() + sha256(file.getvalue()).digest())


def kept_arrays(path: Path) -> dict[str, Array] | None:
    """Return the arrays that `keep_arrays` wrote; None if the file is absent, damaged or not of this form."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    data, digest = content[:-DIGEST_BYTES], content[-DIGEST_BYTES:]
    if sha256(data).digest() != digest:
        return None
    with np.load(BytesIO(data)) as arrays:
        return dict(arrays)
