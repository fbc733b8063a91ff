"""Downloads that go on where a killed one stopped, and keep nothing that is not what the hub stated.

The hub's client begins a file again in every process, writes as much as it is sent, and does not compare
digests. Here a file is put together beside its place in the client's cache, never grows beyond the stated
size, and takes its name there once its digest is right; the client and its offline mode then find it.
"""

import errno
import hashlib
import os
import re
import shutil
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import urljoin, urlsplit

from hma_data.errors import HubError
from hma_data.files import PART, file_sha256
from hma_data.hub_errors import CutShortError, waiting

ATTEMPTS = 5  # without a new byte
LARGE = 100_000  # bytes; from here on a bar shows the progress
REDIRECTS = 10
STILL = 120.0  # seconds another process may hold a download without a new byte
_SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Wanted:
    """A file of a repository at a commit.

    Attributes:
        repo: organisation/name.
        kind: model or dataset.
        name: path in the repository.
        commit: as the hub named it.
        size: bytes, as the listing has it; None where it does not say.
        sha256: as the listing has it; None where it does not say.
    """

    repo: str
    kind: str
    name: str
    commit: str
    size: int | None = None
    sha256: str | None = None

    @property
    def where(self) -> str:
        """For errors."""
        return f"{self.repo}/{self.name}"


@dataclass(frozen=True)
class Facts:
    """What the hub says of a file before it is sent; `mark` can be a file's name, `home` is the hub."""

    home: str
    location: str
    mark: str
    size: int
    sha256: str | None


def cached(wanted: Wanted) -> Path:
    """The place of a file in the client's cache, in the commit's snapshot.

    Raises:
        HubError: its name would lead out of it.
    """
    parts = PurePosixPath(wanted.name).parts
    plain = re.fullmatch(r"[\w.-]{1,64}", wanted.commit) and not set(wanted.commit) <= {"."}
    if not plain or not parts or {"..", "/"} & set(parts) or re.search(r"[\\:\0]", wanted.name):
        raise HubError(wanted.where, "is not a name that can be stored", "do not use this repository")
    return cache_of(wanted.repo, wanted.kind) / "snapshots" / wanted.commit / wanted.name


def cache_of(repo: str, kind: str) -> Path:
    """A repository's folder in the client's cache."""
    from huggingface_hub import constants
    from huggingface_hub.file_download import repo_folder_name

    return Path(constants.HF_HUB_CACHE) / repo_folder_name(repo_id=repo, repo_type=kind)


def fetch(wanted: Wanted) -> Path:
    """Bring a file into the client's cache, unless it is there; its path in the commit's snapshot.

    Raises:
        HubError: other content than the hub stated.
    """
    pointer = cached(wanted)
    if pointer.is_file() and wanted.size in (None, pointer.stat().st_size):
        return pointer
    facts = _facts(wanted)
    blob = cache_of(wanted.repo, wanted.kind) / "blobs" / facts.mark
    if not (blob.is_file() and blob.stat().st_size == facts.size):
        blob.parent.mkdir(parents=True, exist_ok=True)
        partial = blob.with_name(f"{blob.name}.hma-incomplete")
        with _held(partial, lambda: blob.is_file() and blob.stat().st_size == facts.size) as file:
            if file is not None:
                _complete(file, wanted, facts)
                _require_content(wanted, facts, partial)
                partial.replace(blob)
    _link(blob, pointer)
    return pointer


def fetch_to(wanted: Wanted, target: Path) -> None:
    """Bring a file to a path of its own.

    Raises:
        HubError: other content than the hub stated, or another process is writing it.
    """
    facts = _facts(wanted)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".{target.name}.{facts.mark[:16]}{PART}")
    begun = time.time_ns()
    with _held(partial, lambda: target.is_file() and target.stat().st_mtime_ns > begun) as file:
        if file is not None:
            _complete(file, wanted, facts)
            _require_content(wanted, facts, partial)
            partial.replace(target)


def forget_damaged(repo: str, kind: str, paths: list[Path]) -> None:
    """Delete files of the cache whose content is no longer the SHA-256 in their name: they come anew."""
    blobs = (cache_of(repo, kind) / "blobs").resolve()
    for path in paths:
        blob = path.resolve()
        ours = blob.parent == blobs and _SHA256.fullmatch(blob.name) and blob.is_file()
        if ours and file_sha256(blob) != blob.name:
            blob.unlink()


# -- what the hub says


def _facts(wanted: Wanted) -> Facts:
    """Ask for a file's size, digest and address; redirects are followed as long as they stay on the hub."""
    from huggingface_hub import constants, get_session, hf_hub_url
    from huggingface_hub.utils import hf_raise_for_status

    home = hf_hub_url(wanted.repo, wanted.name, repo_type=wanted.kind, revision=wanted.commit)
    address = home
    for _ in range(REDIRECTS):
        timeout = constants.HF_HUB_ETAG_TIMEOUT
        headers = _headers(home, address)
        response = get_session().head(address, headers=headers, timeout=timeout, follow_redirects=False)
        hf_raise_for_status(response)
        following = urljoin(address, response.headers.get("Location", address))
        if not response.has_redirect_location:
            return _stated(wanted, home, address, response.headers, response.headers.get("Content-Length"))
        if not _of_hub(home, following):
            return _stated(wanted, home, following, response.headers, None)
        address = following
    raise HubError(wanted.where, "is redirected in circles", "check HF_ENDPOINT and your proxy")


def _stated(wanted: Wanted, home: str, location: str, headers: Any, length: str | None) -> Facts:
    tag = (headers.get("X-Linked-ETag") or headers.get("ETag") or "").removeprefix("W/").strip('"')
    digest = wanted.sha256 or (tag if _SHA256.fullmatch(tag) else None)
    length = headers.get("X-Linked-Size") or length
    size = int(length) if length and length.isdecimal() else wanted.size
    if size is None:
        raise HubError(wanted.where, "came without its size", "check HF_ENDPOINT and your proxy")
    stated = {"size": size, "sha256": tag if _SHA256.fullmatch(tag) else None}
    for key, value in stated.items():
        listed = getattr(wanted, key)
        if None not in (listed, value) and listed != value:
            fault = f"is listed with {key} {listed}, and answered with {value}"
            raise HubError(wanted.where, fault, "do not use this repository")
    # a hub's tag must not lead out of the folder, nor be taken for a name of ours
    mark = digest or (tag if re.fullmatch(r"[0-9a-zA-Z_-]{8,128}", tag) else "")
    unmarked = f"{wanted.commit} {wanted.name} {tag}".encode()
    return Facts(home, location, mark or hashlib.sha256(unmarked).hexdigest()[:40], size, digest)


def _headers(home: str, address: str) -> dict[str, str]:
    """Of a request; another host, which may be anybody's, must not see the token."""
    from huggingface_hub.utils import build_hf_headers

    headers = {**build_hf_headers(library_name="hma-toolkit"), "Accept-Encoding": "identity"}
    if not _of_hub(home, address):
        headers.pop("authorization", None)
    return headers


def _of_hub(home: str, address: str) -> bool:
    from huggingface_hub import constants

    ours, theirs = urlsplit(home), urlsplit(address)
    same = (ours.scheme, ours.netloc) == (theirs.scheme, theirs.netloc)
    return same or (theirs.scheme == "https" and theirs.hostname in constants.HF_URL_HOSTS)


# -- the bytes


@contextmanager
def _held(partial: Path, done: Callable[[], bool]) -> Iterator[Any]:
    """The unfinished file, which nobody else writes meanwhile; None once somebody else has finished it."""
    size, since = -1, time.monotonic()
    while True:
        with partial.open("ab", buffering=0) as file:
            if _locked(file) and _is(file, partial):
                if not done():
                    file.seek(0, os.SEEK_END)  # whoever held it before may have added to it
                    yield file
                    return
                partial.unlink()
        if done():
            yield None
            return
        now = partial.stat().st_size if partial.exists() else -1
        if now != size:
            size, since = now, time.monotonic()
        elif time.monotonic() - since > STILL:
            raise HubError(
                partial, "is held by another process that does not go on", "end it, run this again"
            )
        time.sleep(0.1)


def _locked(file: Any) -> bool:
    """Whether the file is ours alone; so is any where the file system knows no locks."""
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as fault:
        if fault.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS):
            raise
    return True


def _is(file: Any, path: Path) -> bool:
    """Whether an open file is still the one of that name."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def _complete(file: Any, wanted: Wanted, facts: Facts) -> None:
    """Fill up what is there."""
    from huggingface_hub.utils import tqdm

    name = "hma_model.hub_fetch"
    disable = True if facts.size < LARGE else None
    with tqdm(total=facts.size, unit="B", unit_scale=True, disable=disable, name=name) as bar:
        failures, renewed = 0, False
        while (start := file.tell()) != facts.size:
            bar.update(start - bar.n)
            try:
                _append(file, facts, bar.update)
            except _faults() as fault:
                more = file.tell() > start
                failures, renewed = (0, False) if more else (failures + 1, renewed)
                if _expired(fault, facts) and not renewed:
                    facts, renewed = _facts(wanted), True
                    continue
                seconds = float(2**failures) if isinstance(fault, _passing()) else waiting(fault, failures)
                if seconds is None or failures > ATTEMPTS:
                    raise
                time.sleep(seconds)


def _append(file: Any, facts: Facts, update: Callable[[int], Any]) -> None:
    """One request for what is missing; every byte that comes is kept, up to the stated size."""
    from huggingface_hub import constants, get_session
    from huggingface_hub.utils import hf_raise_for_status

    start = file.tell()
    if start > facts.size:
        start = _emptied(file)
    asked = _headers(facts.home, facts.location) | ({"Range": f"bytes={start}-"} if start else {})
    timeout = constants.HF_HUB_DOWNLOAD_TIMEOUT
    with get_session().stream("GET", facts.location, headers=asked, timeout=timeout) as response:
        hf_raise_for_status(response)
        sent = response.headers.get("Content-Range", "")
        if response.status_code != 206:
            _emptied(file)
        elif sent and not sent.startswith(f"bytes {start}-"):
            _emptied(file)
            raise OSError("other bytes than those asked for")
        packed = response.headers.get("Content-Encoding", "identity") != "identity"
        for block in response.iter_bytes() if packed else response.iter_raw():
            if file.tell() + len(block) > facts.size:
                _emptied(file)
                raise OSError(f"more than the {facts.size:,} bytes that were stated")
            left = memoryview(block)
            while left:
                left = left[file.write(left) :]
            update(len(block))
    if file.tell() != facts.size:
        raise CutShortError(f"{file.tell():,} bytes of {facts.size:,}")


def _emptied(file: Any) -> int:
    file.truncate(0)
    return int(file.seek(0))


def _expired(fault: BaseException, facts: Facts) -> bool:
    """Whether a signed address of the files' host is no longer good."""
    status = getattr(getattr(fault, "response", None), "status_code", None)
    return status in (400, 401, 403, 404, 410) and facts.location != facts.home


def _require_content(wanted: Wanted, facts: Facts, partial: Path) -> None:
    if facts.sha256 and file_sha256(partial) != facts.sha256:
        partial.unlink()
        raise HubError(wanted.where, "came with other content than the hub stated", "pull again")


def _link(blob: Path, pointer: Path) -> None:
    """Give a blob its name in a snapshot; a copy where the file system has no links."""
    pointer.parent.mkdir(parents=True, exist_ok=True)
    beside = pointer.with_name(f".{pointer.name}.{uuid.uuid4().hex[:8]}{PART}")
    try:
        try:
            beside.symlink_to(os.path.relpath(blob, pointer.parent))
        except OSError:
            shutil.copyfile(blob, beside)
        beside.replace(pointer)
    finally:
        beside.unlink(missing_ok=True)


def _passing() -> tuple[type[BaseException], ...]:
    import httpx

    return (httpx.TimeoutException, httpx.NetworkError, CutShortError)


def _faults() -> tuple[type[BaseException], ...]:
    import httpx

    return (OSError, httpx.HTTPError)
