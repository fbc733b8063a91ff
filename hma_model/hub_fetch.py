"""Downloads of large files that go on where a killed one stopped.

The hub's client begins a file again in every process. Here it is put together beside its place in the
client's cache and takes its name there once its SHA-256 is the one the hub states; the client then finds it.
"""

import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from hma_data.errors import HubError
from hma_data.files import PART, file_sha256
from hma_model.hub_errors import waiting

ATTEMPTS = 5  # without a new byte
LARGE = 100_000  # bytes; below it the client starts again


def fetch(repo: str, kind: str, name: str, commit: str) -> None:
    """Bring a large file into the client's cache, if it is one with a SHA-256; else leave it to the client.

    Args:
        repo: organisation/name.
        kind: model or dataset.
        name: path in the repository.
        commit: forty hex digits.

    Raises:
        HubError: other content than the hub stated.
    """
    from huggingface_hub import constants, get_hf_file_metadata, hf_hub_url
    from huggingface_hub.file_download import repo_folder_name

    address = hf_hub_url(repo, name, repo_type=kind, revision=commit)
    facts = get_hf_file_metadata(address, retry_on_errors=True)
    by_chunks = facts.xet_file_data is not None and not constants.HF_HUB_DISABLE_XET
    if by_chunks or facts.size is None or not re.fullmatch(r"[0-9a-f]{64}", facts.etag or ""):
        return
    folder = Path(constants.HF_HUB_CACHE) / repo_folder_name(repo_id=repo, repo_type=kind) / "blobs"
    blob = folder / str(facts.etag)
    if blob.exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    partial = folder / f"{blob.name}.hma-incomplete"
    if _complete(partial, facts.location, facts.size, urlsplit(address).hostname):
        if file_sha256(partial) != blob.name:
            partial.unlink()
            raise HubError(f"{repo}/{name}", "came with other content than the hub stated", "pull again")
        partial.replace(blob)


def fetch_to(repo: str, kind: str, name: str, commit: str, target: Path) -> None:
    """Bring a file to a path of its own; the arguments are those of `fetch`.

    Raises:
        HubError: other content than the hub stated, or another process is writing it.
    """
    from huggingface_hub import get_hf_file_metadata, hf_hub_url

    address = hf_hub_url(repo, name, repo_type=kind, revision=commit)
    facts = get_hf_file_metadata(address, retry_on_errors=True)
    where, etag = f"{repo}/{name}", facts.etag or ""
    if facts.size is None:
        raise HubError(where, "came without its size", "check HF_ENDPOINT and your proxy")
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".{target.name}.{etag[:16]}{PART}")
    if not _complete(partial, facts.location, facts.size, urlsplit(address).hostname):
        raise HubError(target, "is being written by another process", "wait for it, then run this again")
    if re.fullmatch(r"[0-9a-f]{64}", etag) and file_sha256(partial) != etag:
        partial.unlink()
        raise HubError(where, "came with other content than the hub stated", "pull again")
    partial.replace(target)


def _complete(partial: Path, location: str, size: int, home: str | None) -> bool:
    """Fill up what is there; False where another process is doing it."""
    import fcntl

    from huggingface_hub.utils import build_hf_headers, tqdm

    headers = {**build_hf_headers(library_name="hma-toolkit"), "Accept-Encoding": "identity"}
    if urlsplit(location).hostname != home:
        headers.pop("authorization", None)  # a signed address of another host, which must not see the token
    with partial.open("ab", buffering=0) as file, tqdm(total=size, unit="B", unit_scale=True) as bar:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        failures = 0
        while (start := file.tell()) != size:
            bar.update(start - bar.n)
            try:
                _append(file, location, headers, size, bar.update)
            except _faults() as fault:
                failures = 0 if file.tell() > start else failures + 1
                seconds = waiting(fault, failures)
                if seconds is None or failures > ATTEMPTS:
                    raise
                time.sleep(seconds)
    return True


def _append(
    file: Any, location: str, headers: dict[str, str], size: int, update: Callable[[int], Any]
) -> None:
    """One request for what is missing; every byte that comes is kept."""
    from huggingface_hub import constants, get_session
    from huggingface_hub.utils import hf_raise_for_status

    if file.tell() > size:
        file.truncate(0)
        file.seek(0)
    asked = {**headers, "Range": f"bytes={file.tell()}-"} if file.tell() else headers
    timeout = constants.HF_HUB_DOWNLOAD_TIMEOUT
    with get_session().stream("GET", location, headers=asked, timeout=timeout) as response:
        hf_raise_for_status(response)
        if response.status_code != 206:
            file.truncate(0)
            file.seek(0)
        for block in response.iter_raw():
            left = memoryview(block)
            while left:
                left = left[file.write(left) :]
            update(len(block))
            if file.tell() > size:
                raise OSError(f"more than the {size:,} bytes that were stated")
    if file.tell() != size:
        raise OSError(f"{file.tell():,} bytes of {size:,}")


def _faults() -> tuple[type[BaseException], ...]:
    import httpx

    return (OSError, httpx.HTTPError)
