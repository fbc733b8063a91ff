"""Keep the finished parts of a job in a folder, so that the same call continues after a stop."""

import json
import shutil
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.errors import OutputError
from hma_data.storage.files import atomic_path, write_atomic

SETTINGS = "settings.json"


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
        folder.mkdir(exist_ok=True)
        path, text = folder / SETTINGS, json.dumps(settings, indent=1)
        if any(folder.glob("*.npz")) and path.exists() and path.read_text(encoding="utf-8") != text:
            fault = "was begun with other settings"
            raise OutputError(folder.parent, fault, "give the same ones, or another folder")
        write_atomic(path, text)

    def path(self, key: str) -> Path:
        """Return the file of a part."""
        return self.folder / f"{key}.npz"

    def part(self, key: str, make: Callable[[], Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
        """Return the arrays of a part: those kept, else those that `make` returns, which are then kept."""
        found = kept_arrays(self.path(key))
        if found is None:
            arrays: Any = dict(make())
            with atomic_path(self.path(key)) as part, part.open("wb") as file:
                np.savez(file, **arrays)
            found = arrays
        return found

    def remove(self) -> None:
        """Delete all parts: the job's result is written."""
        shutil.rmtree(self.folder, ignore_errors=True)


def kept_arrays(path: Path) -> dict[str, NDArray[Any]] | None:
    """Return the arrays of an .npz file that an interrupted job kept; None if it is absent or damaged."""
    try:
        with np.load(path) as arrays:
            return dict(arrays)
    except (OSError, ValueError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error):
        return None
