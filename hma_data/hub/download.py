"""Download files with the hub's own client, and return none whose content differs from the listing.

The client writes each download to a file of its own and renames it, and compares no digests. A damaged file
in its cache is therefore downloaded once more in place: at every moment there is a whole file of that name.
"""

import hashlib
import io
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from hma_data.errors import HubError

LARGE = 1_000_000  # bytes; from here on a bar shows the progress
_SHA1 = re.compile(r"[0-9a-f]{40}")


@dataclass(frozen=True)
class Entry:
    """A file of a repository, as a listing states it.

    Attributes:
        name: path in the repository.
        size: bytes.
        sha256: SHA-256 of a file that the hub keeps by LFS; None for any other file.
        blob_id: git's name of its content, if `sha256` is None; empty if the hub does not state it.
    """

    name: str
    size: int
    sha256: str | None
    blob_id: str

    def states(self, content: Path | bytes) -> bool:
        """Check whether a file or bytes have this entry's content; False if there is no such file."""
        try:
            with io.BytesIO(content) if isinstance(content, bytes) else content.open("rb") as file:
                size = file.seek(0, io.SEEK_END)
                file.seek(0)
                if size != self.size:
                    return False
                if self.sha256:
                    return hashlib.file_digest(file, "sha256").hexdigest() == self.sha256
                if not _SHA1.fullmatch(self.blob_id):
                    return True
                begun = hashlib.sha1(b"blob %d\0" % size, usedforsecurity=False)
                return hashlib.file_digest(file, lambda: begun).hexdigest() == self.blob_id
        except FileNotFoundError:
            return False


def fetch(repo: str, kind: str, commit: str, entry: Entry, folder: Path | None = None) -> Path:
    """Download a file, unless it is already there with the stated content.

    Args:
        repo: organisation/name.
        kind: model or dataset.
        commit: the commit that was listed.
        entry: the file.
        folder: where to put it; None for the client's cache.

    Returns:
        Its path.

    Raises:
        HubError: its content is not the stated one, even after a second download.
    """
    from huggingface_hub import hf_hub_download

    if folder is not None and entry.size == 0:  # some hubs do not send empty files
        path = folder / entry.name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        return path
    for anew in (False, True):
        path = Path(
            hf_hub_download(
                repo,
                entry.name,
                repo_type=kind,
                revision=commit,
                local_dir=folder,
                force_download=anew,
                library_name="hma-toolkit",
                tqdm_class=None if entry.size >= LARGE else _no_bar(),
            )
        )
        if entry.states(path):
            return path
    remedy = f"pull again; if it stays so, delete {path}, or do not use this repository"
    raise HubError(f"{repo}/{entry.name}", "came with other content than the hub stated", remedy)


@cache
def _no_bar() -> Any:
    from huggingface_hub.utils import tqdm

    class NoBar(tqdm):
        def __init__(self, *given: Any, **options: Any) -> None:
            super().__init__(*given, **options | {"disable": True})

    return NoBar
