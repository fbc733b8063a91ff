"""A hub that is a repository of the Hugging Face Hub.

A push is one commit on top of the commit it was prepared for; when somebody else has committed in between, it
is prepared again. What is downloaded lies in the client's own cache, which works offline.
"""

import hashlib
import random
import re
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

from hma_data.errors import HubError
from hma_data.files import file_sha256
from hma_data.hub_bounds import bounded, downloading
from hma_data.hub_chunks import leave_after, leave_if_unknown, refuse_ignored
from hma_data.hub_errors import LOG_IN, cuts, explain, explained, raised, waiting, without_token
from hma_model.checkpoint import README
from hma_model.files import MAX_JSON_BYTES
from hma_model.hub_fetch import Wanted, cache_of, cached, fetch, fetch_to, forget_damaged
from hma_model.hub_partial import beside

ATTEMPTS = 8
TIMEOUT = 30.0  # seconds for a listing
AT_ONCE = 4  # downloads
MOST_FILES = 300_000  # of a listing
MOST_WARM = 256_000_000  # bytes of cards brought together
_ABSENT = object()
_CONFLICTS = (409, 412)
_COMMIT = re.compile(r"[0-9a-f]{40}|[0-9a-f]{64}")


class HuggingFaceStore:
    """See `hma_model.hub.Store`.

    Args:
        repo: organisation/name.
        revision: branch, tag or commit; None for main.
        write: make the repository where it is not there.
        kind: model or dataset.
        private: make it a private one.

    Raises:
        HubError: not there, no access, or not reachable.
    """

    def __init__(
        self,
        repo: str,
        revision: str | None = None,
        write: bool = False,
        kind: str = "model",
        private: bool | None = None,
    ) -> None:
        from huggingface_hub import HfApi, get_token

        prefix = "datasets/" if kind == "dataset" else ""
        self.name, self.repo, self._revision, self._kind = f"hf://{prefix}{repo}", repo, revision, kind
        self._api = HfApi(library_name="hma-toolkit")
        self.address = f"{self._api.endpoint}/{prefix}{repo}"
        self._write, self._private, self._absent = write, private, False
        self._commit: str | None = None
        self._offline: Path | None = None
        self._sizes: dict[str, int] | None = None
        self._digests: dict[str, str] = {}
        self._blobs: dict[str, str] = {}
        if write and get_token() is None:
            remedy = f"{LOG_IN}; for a folder write ./{repo}"
            raise HubError(self.name, "needs a token to be written", remedy)

    def files(self) -> dict[str, int]:
        """Sizes by name at the revision's newest commit; out of the hub's reach, of what the cache has.

        Of a repository that is to be written, and is not there yet, none.
        """
        from huggingface_hub.errors import GatedRepoError, RepositoryNotFoundError

        def ask() -> Any:
            try:
                return self._api.repo_info(
                    self.repo, repo_type=self._kind, revision=self._revision, timeout=TIMEOUT
                )
            except RepositoryNotFoundError as fault:
                if not self._write or isinstance(fault, GatedRepoError):
                    raise
                return _ABSENT
            except _unreachable():
                if self._write:
                    raise
                return None

        info = self._patiently(ask)
        if info is None:
            with explained(self.name):
                return self._cached_files()
        self._absent = info is _ABSENT
        self._commit, self._offline = None if self._absent else self._named(info.sha), None
        entries = self._patiently(self._listing) if self._commit else []
        self._digests = {item.path: item.lfs.sha256 for item in entries if item.lfs}
        self._blobs = {item.path: str(item.blob_id) for item in entries if not item.lfs}
        self._sizes = {item.path: int(item.size or 0) for item in entries}
        return dict(self._sizes)

    def _named(self, commit: str | None) -> str | None:
        """A commit's name, which becomes a folder's; None in a repository without any."""
        if commit is not None and not _COMMIT.fullmatch(commit):
            raise HubError(self.name, f"names a commit {commit[:60]!r}", "check HF_ENDPOINT and your proxy")
        return commit

    def _listing(self) -> list[Any]:
        """The files of the commit; pages that lead in a circle, or never end, are left."""
        found: dict[str, Any] = {}
        for item in self._api.list_repo_tree(
            self.repo, repo_type=self._kind, revision=self._commit, recursive=True
        ):
            if item.path in found or len(found) >= MOST_FILES:
                fault = f"lists {item.path[:60]!r} twice" if item.path in found else "has too many files"
                raise HubError(self.name, fault, "do not use this repository, or check HF_ENDPOINT")
            found[item.path] = item
        return [item for item in found.values() if hasattr(item, "blob_id")]

    def read(self, name: str) -> bytes:
        """A file of at most 16 MB at the commit that `files` saw."""
        sizes = self.files() if self._sizes is None else self._sizes
        if sizes.get(name, 0) > MAX_JSON_BYTES:
            fault = f"is larger than {MAX_JSON_BYTES:,} bytes"
            raise HubError(f"{self.name}/{name}", fault, "this is not a file of ours")
        content: bytes = self._brought([name])[0].read_bytes()
        return content

    def warm(self, names: list[str]) -> None:
        """Bring small files to the cache together, for `read`."""
        sizes, total, small = self._sizes or {}, 0, []
        for name in names:
            total += sizes.get(name, 0)
            if sizes.get(name, MAX_JSON_BYTES + 1) <= MAX_JSON_BYTES and total <= MOST_WARM:
                small.append(name)
        if self._commit:
            self._brought(small)

    def publish(self, changes: Callable[[], Mapping[str, Path | bytes | None]], message: str) -> str:
        """One commit, prepared again while others commit first."""
        for attempt in range(ATTEMPTS):
            files = changes() if attempt else self._begun(changes)
            try:
                with bounded():
                    self._send(files, message, again=attempt > 0)
                return self.address
            except HubError:
                raise
            except raised() as fault:
                response = getattr(without_token(fault), "response", None)
                if leave_after(fault):
                    continue
                conflict = response is not None and response.status_code in _CONFLICTS
                seconds = min(0.2 * 2**attempt, 10.0) if conflict else waiting(fault, attempt)
                if seconds is None or (not conflict and attempt >= ATTEMPTS // 2):
                    raise explain(self.name, fault) from fault
            time.sleep(seconds * (0.5 + random.random()) if conflict else seconds)
        raise HubError(self.name, f"others committed first {ATTEMPTS} times", "push again later")

    def _begun(self, changes: Callable[[], Mapping[str, Path | bytes | None]]) -> Mapping[str, Any]:
        """The changes, whose card the hub takes; a repository that is not there is made only then."""
        files = changes()
        if isinstance(page := files.get(README), bytes):
            self.check_card(page)
        if not self._absent:
            return files
        make = partial(self._api.create_repo, repo_type=self._kind, exist_ok=True)
        self._patiently(lambda: make(self.repo, private=self._private or None))
        return changes()  # somebody else may have been there meanwhile

    def check_card(self, page: bytes) -> None:
        """Raise HubError where the hub would not take a card."""
        self._patiently(lambda: self._api._validate_yaml(page.decode(), repo_type=self._kind))

    def _send(self, files: Mapping[str, Path | bytes | None], message: str, again: bool) -> None:
        """Upload what is large, then commit all of it, or nothing."""
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete

        if not again:
            leave_if_unknown(self._api, self.repo, self._kind)
        added = [
            CommitOperationAdd(name, str(content) if isinstance(content, Path) else content)
            for name, content in files.items()
            if content is not None and not (again and self._has(name, content))
        ]
        deleted = [CommitOperationDelete(name) for name, content in files.items() if content is None]
        if not added and not deleted:
            return
        self._api.preupload_lfs_files(
            self.repo, added, repo_type=self._kind, free_memory=False, gitignore_content=""
        )
        refuse_ignored(added, self.name)
        self._api.create_commit(
            self.repo,
            [*added, *deleted],
            repo_type=self._kind,
            commit_message=message,
            parent_commit=self._commit,
        )

    def _has(self, name: str, content: Path | bytes) -> bool:
        """Whether the commit has the same under this name; a commit whose answer was lost is found so."""
        if name in self._digests:
            digest = (
                file_sha256(content) if isinstance(content, Path) else hashlib.sha256(content).hexdigest()
            )
            return self._digests[name] == digest
        size = content.stat().st_size if isinstance(content, Path) else len(content)
        if name not in self._blobs or size > MAX_JSON_BYTES or (self._sizes or {}).get(name) != size:
            return False
        whole = content.read_bytes() if isinstance(content, Path) else content
        git = hashlib.sha1(b"blob %d\0" % size + whole, usedforsecurity=False)
        return self._blobs[name] == git.hexdigest()

    def digests(self) -> dict[str, str]:
        """SHA-256 by name of the large files, at the commit that `files` saw."""
        self.files()
        return dict(self._digests)

    def download(self, names: list[str], out: Path) -> None:
        """Files to a folder, past the client's cache; a killed download goes on where it stopped."""
        sizes = self.files() if self._sizes is None else self._sizes
        if self._commit is None:
            raise HubError(self.name, "is out of reach", "go online and pull again")
        self._each(lambda name: fetch_to(self._wanted(name), out / name), [n for n in names if n in sizes])

    def pull(self, names: list[str], out: Path | None) -> Path:
        """The client's cache, or a folder with copies of its own."""
        if self._commit:
            forget_damaged(self.repo, self._kind, [cached(self._wanted(name)) for name in names])
        self._brought(names)
        folder = self._offline or self._snapshot()
        self._remember()
        if out is None:
            return folder
        from hma_model.hub_folder import FolderStore

        return FolderStore(folder).pull(names, out)

    def _brought(self, names: list[str]) -> list[Path]:
        """Paths of files in the cache."""
        if self._offline is None:
            return self._each(lambda name: fetch(self._wanted(name)), names)
        paths = [self._offline / name for name in names]
        if missing := [path.name for path in paths if not path.is_file()]:
            fault = f"is out of reach, and not in the cache: {missing[0]}"
            raise HubError(self.name, fault, "go online and pull again")
        return paths

    def _each[T](self, act: Callable[[str], T], names: Iterable[str]) -> list[T]:
        """An action for each file, a few at once; the first error ends it."""

        def one(name: str) -> T:
            return self._patiently(lambda: act(name), f"{self.name}/{name}", downloading)

        pool = ThreadPoolExecutor(AT_ONCE, "hub")
        try:
            return list(pool.map(one, names))
        finally:
            pool.shutdown(cancel_futures=True)

    def _wanted(self, name: str) -> Wanted:
        size = (self._sizes or {}).get(name)
        commit = self._commit or ""
        return Wanted(self.repo, self._kind, name, commit, size, self._digests.get(name))

    def _snapshot(self) -> Path:
        return cache_of(self.repo, self._kind) / "snapshots" / (self._commit or "")

    def _remember(self) -> None:
        """Which commit a branch or tag stood for, so that it is found under its name offline."""
        name = self._revision or "main"
        if self._commit and not _COMMIT.fullmatch(name) and ".." not in name:
            with explained(self.name):
                ref = cache_of(self.repo, self._kind) / "refs" / name
                ref.parent.mkdir(parents=True, exist_ok=True)
                new = beside(ref)
                new.write_text(self._commit)
                new.replace(ref)

    def _cached_files(self) -> dict[str, int]:
        """What the cache has of the revision."""
        self._commit, name = None, self._revision or "main"
        ref = cache_of(self.repo, self._kind) / "refs" / name
        commit = ref.read_text().strip() if ".." not in name and ref.is_file() else name
        folder = cache_of(self.repo, self._kind) / "snapshots" / commit
        if not _COMMIT.fullmatch(commit) or not folder.is_dir():
            raise HubError(self.name, "is out of reach, and not in the cache", "go online and pull again")
        self._offline = folder
        paths = (path for path in folder.rglob("*") if path.is_file())
        self._sizes = {path.relative_to(folder).as_posix(): path.stat().st_size for path in paths}
        return dict(self._sizes)

    def _patiently(
        self, call: Callable[[], Any], where: str = "", within: Callable[[], Any] = nullcontext
    ) -> Any:
        """What a call returns; it is made again where the hub is busy or the connection was cut."""
        from huggingface_hub.errors import HfHubHTTPError

        for attempt in range(ATTEMPTS // 2):
            try:
                with explained(where or self.name), bounded(), within():
                    return call()
            except HubError as fault:
                cause = fault.__cause__
                again = isinstance(cause, (HfHubHTTPError, *cuts()))
                seconds = waiting(cause, attempt) if again and cause is not None else None
                if seconds is None or attempt == ATTEMPTS // 2 - 1:
                    raise
                time.sleep(seconds)
        raise AssertionError("the last attempt returns or raises")


def _unreachable() -> tuple[type[BaseException], ...]:
    import httpx
    from huggingface_hub.errors import OfflineModeIsEnabled

    return (OfflineModeIsEnabled, httpx.ConnectError, httpx.TimeoutException)
