"""List, pull and push a repository of the Hugging Face Hub at one commit.

A push is one commit on top of the commit it was prepared for; if somebody else has committed in between, it
is prepared again. What our own commits change is known, so that after them nothing is listed again. The hub's
client compares no digests of what it downloads, so this module does.
"""

import hashlib
import io
import logging
import random
import re
import shutil
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from hma_data.cpu import in_order
from hma_data.errors import HubError
from hma_data.hub.errors import LOG_IN, explained, is_away, is_missing, is_of_xet, status, waiting
from hma_data.storage.files import MAX_JSON_BYTES

ATTEMPTS = 8  # attempts to commit; half as many for any other call
LISTING_S, SILENCE_S = 30.0, 300.0  # seconds; the hub needs minutes for a commit of many files
AT_ONCE = 4  # downloads at a time
LARGE = 1_000_000  # bytes of a file; from here on a bar shows the progress
_CONFLICTS = (409, 412)
_COMMIT = re.compile(r"[0-9a-f]{40}|[0-9a-f]{64}")

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StoredFile:
    """A file of a repository, as a listing states it.

    Attributes:
        size: bytes.
        sha256: SHA-256 of a file that the hub keeps by LFS, or that was committed here; None for others.
        blob_id: git's name of its content, or of its LFS pointer; empty if the hub does not state it.
    """

    size: int
    sha256: str | None
    blob_id: str

    def states(self, content: Path | bytes) -> bool:
        """Check whether a file or bytes have this entry's content; False if there is no such file."""
        if isinstance(content, Path) and not content.is_file():
            return False
        with io.BytesIO(content) if isinstance(content, bytes) else content.open("rb") as file:
            if file.seek(0, io.SEEK_END) != self.size:
                return False
            file.seek(0)
            if self.sha256:
                return hashlib.file_digest(file, "sha256").hexdigest() == self.sha256
            if not _COMMIT.fullmatch(self.blob_id):
                return True
            # git's name of a file: the SHA-1 of this header and the content
            begun = hashlib.sha1(b"blob %d\0" % self.size, usedforsecurity=False)
            return hashlib.file_digest(file, lambda: begun).hexdigest() == self.blob_id


class Repository:
    """A repository of the hub, in which a checkpoint or a shard set is published.

    Args:
        repo: organisation/name.
        revision: branch, tag or commit; None for main.
        write: whether to make the repository if it does not exist.
        kind: model, dataset or space; a new Space is a static one.
        private: whether to make it private.
        name: name for errors, instead of its URI.

    Attributes:
        address: address of its page.
        from_cache: whether the hub was out of reach, so that `files` listed the cache.
    """

    def __init__(
        self,
        repo: str,
        revision: str | None = None,
        write: bool = False,
        kind: str = "model",
        private: bool | None = None,
        name: str | None = None,
    ) -> None:
        from huggingface_hub import HfApi, get_session, get_token

        prefix = "" if kind == "model" else f"{kind}s/"
        self.name, self.repo, self.kind, self._revision = name or f"hf://{prefix}{repo}", repo, kind, revision
        self._place: dict[str, Any] = {"repo_id": repo, "repo_type": kind}
        self._api = HfApi(library_name="hma-toolkit")
        self.address = f"{self._api.endpoint}/{prefix}{repo}"
        self._write, self._private, self._absent = write, private, False
        self._by_xet = True  # False once an upload by Xet has failed, as behind some firewalls
        self._commit: str | None = None
        self._cached: Path | None = None
        self._entries: dict[str, StoredFile] = {}
        if write and get_token() is None:
            raise HubError(self.name, "needs a token to be written", f"{LOG_IN}; for a folder write ./{repo}")
        if get_session().timeout.read is None:  # by default the client waits for an answer without limit
            get_session().timeout = SILENCE_S

    @property
    def from_cache(self) -> bool:
        return self._cached is not None

    # -- what is there

    def files(self) -> dict[str, int]:
        """Return sizes by name at the newest commit, or of the cache if the hub is out of reach.

        A repository that is to be written and does not exist yet has no files.
        """
        head, self._cached, self._absent = None, None, False
        try:
            asked: dict[str, Any] = {"revision": self._revision, "timeout": LISTING_S}
            head = self._ask(lambda: self._api.repo_info(**self._place, **asked).sha)
        except HubError as fault:
            if self._write and is_missing(fault):
                self._absent = True
            elif self._write or not is_away(fault):
                raise
        if head is not None and not _COMMIT.fullmatch(head):
            named = f"names a commit {head[:60]!r}"
            raise HubError(self.name, named, "check HF_ENDPOINT and your proxy")
        if not head:
            self._entries = {} if self._write else self._of_cache()
        elif head != self._commit:
            self._entries = self._ask(lambda: self._listing(head))
        self._commit = head
        return {name: entry.size for name, entry in self._entries.items()}

    def holds(self, name: str) -> bool:
        """Check whether there is such a file at the newest commit."""
        return name in self.files()

    def has(self, name: str, content: Path | bytes, sha256: str | None = None) -> bool:
        """Check whether the commit that `files` listed has this content (of this SHA-256) under this name."""
        entry = self._entries.get(name)
        if entry and entry.sha256 and sha256:
            return entry.sha256 == sha256
        return entry is not None and entry.states(content)

    def _listing(self, commit: str) -> dict[str, StoredFile]:
        from huggingface_hub import RepoFile

        entries = self._api.list_repo_tree(**self._place, revision=commit, recursive=True)
        return {
            item.path: StoredFile(item.size or 0, item.lfs.sha256 if item.lfs else None, str(item.blob_id))
            for item in entries
            if isinstance(item, RepoFile)
        }

    def _of_cache(self) -> dict[str, StoredFile]:
        """Return the files that earlier pulls have left in the client's cache."""
        from huggingface_hub import snapshot_download

        with explained(self.name):
            only: dict[str, Any] = {"local_files_only": True, "allow_patterns": []}
            found = snapshot_download(**self._place, **only, revision=self._revision)
        self._cached = folder = Path(found)
        names = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
        return {name: StoredFile((folder / name).stat().st_size, None, "") for name in names}

    # -- pulling

    def read(self, name: str) -> bytes:
        """Return the content of a file of at most 16 MB at the commit that `files` listed."""
        if self._entries[name].size > MAX_JSON_BYTES:
            fault = f"is larger than {MAX_JSON_BYTES:,} bytes"
            raise HubError(f"{self.name}/{name}", fault, "the toolkit writes no such file")
        return (self.pull([name]) / name).read_bytes()

    def warm(self, names: Iterable[str]) -> None:
        """Download small files to the cache together, for later calls of `read`."""
        there = [name for name in names if name in self._entries]
        if small := [name for name in there if self._entries[name].size <= MAX_JSON_BYTES]:
            self.pull(small)

    def pull(self, names: list[str]) -> Path:
        """Return the folder of files in the client's cache; download those that it lacks."""
        if self._cached is not None:
            if missing := [name for name in names if name not in self._entries]:
                fault = f"is out of reach, and {missing[0]} is not in the cache"
                raise HubError(self.name, fault, "go online and pull again")
            return self._cached
        folder = self._each(self._fetch, names)[0].parents[len(PurePosixPath(names[0]).parts) - 1]
        named, commit = self._revision or "main", str(self._commit)
        ref = folder.parent.parent / "refs" / named
        if not _COMMIT.fullmatch(named) and not (ref.is_file() and ref.read_text() == commit):
            ref.parent.mkdir(parents=True, exist_ok=True)
            ref.write_text(commit)  # as the client does, which finds the revision by it offline
        return folder

    def download(self, names: list[str], out: Path) -> None:
        """Download files to a folder, not to the client's cache; each gets its name when it is complete."""
        if self.from_cache:
            raise HubError(self.name, "is out of reach", "go online and pull again")
        try:
            self._each(lambda name: self._fetch(name, out), [name for name in names if name in self._entries])
        finally:
            shutil.rmtree(out / ".cache" / "huggingface", ignore_errors=True)  # the client's notes
            with suppress(OSError):  # it holds something else
                (out / ".cache").rmdir()

    def _fetch(self, name: str, folder: Path | None = None) -> Path:
        """Download a file to a folder or to the client's cache, unless it is there; return its path."""
        from huggingface_hub import hf_hub_download

        entry = self._entries[name]
        if folder is not None and entry.size == 0:  # some hubs do not send empty files
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).touch()
            return folder / name
        # The cache may hold a damaged copy: what does not match is downloaded once more.
        for anew in (False, True):
            found = hf_hub_download(
                **self._place,
                filename=name,
                revision=self._commit,
                local_dir=folder,
                force_download=anew,
                library_name="hma-toolkit",
                tqdm_class=None if entry.size >= LARGE else _no_bar(),
            )
            if entry.states(Path(found)):
                return Path(found)
        remedy = f"pull again; if the error stays, delete {found}, or do not use this repository"
        raise HubError(f"{self.name}/{name}", "differs from the content that the hub stated", remedy)

    def _each[T](self, act: Callable[[str], T], names: Iterable[str]) -> list[T]:
        """Return the results of an action for each file, a few files at a time; the first error ends it."""

        def ask(name: str) -> T:
            return self._ask(lambda: act(name), f"{self.name}/{name}")

        return [found for _, found in in_order(ask, names, AT_ONCE)]

    # -- pushing

    def prepare(self, name: str) -> None:
        """Make the repository and its branch if they do not exist."""
        from huggingface_hub import CommitOperationAdd

        self._make()
        if branch := self._revision:
            self._ask(lambda: self._api.create_branch(**self._place, branch=branch, exist_ok=True))
        # The hub answers the request before an upload only to those who may write.
        probe = [CommitOperationAdd(name, b"{}")]
        given: dict[str, Any] = {"additions": probe, "revision": self._revision}
        self._ask(lambda: self._api.preupload_lfs_files(**self._place, **given))

    def publish(self, changes: Callable[[], Mapping[str, Path | bytes | None]], message: str) -> str:
        """Commit changes and return the page's address; prepare them again if others commit first.

        Args:
            changes: returns contents by name, None to delete; it calls `files`.
        """
        files = changes()
        if self._absent:
            self._make()
            files = changes()  # somebody else may have written in the meantime
        for attempt in range(ATTEMPTS):
            try:
                with explained(self.name):
                    self._commit_changes(files, message)
                return self.address
            except HubError as fault:
                if self._by_xet and is_of_xet(fault):
                    log.info("%s; uploading by LFS from now on", fault)
                    self._by_xet = False
                else:
                    _pause(fault, attempt)
            files = changes()
        raise HubError(self.name, f"others committed first {ATTEMPTS} times", "push again later")

    def _commit_changes(self, files: Mapping[str, Path | bytes | None], message: str) -> None:
        """Commit what differs from the listed commit, all of it or nothing."""
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete

        added = {name: new for name, new in files.items() if new is not None and not self.has(name, new)}
        deleted = [name for name, new in files.items() if new is None and name in self._entries]
        if not added and not deleted:
            return
        with ExitStack() as opened:

            def source(content: Path | bytes) -> str | bytes | BinaryIO:
                if isinstance(content, bytes):
                    return content
                # The client uploads open files by LFS over HTTP, also where it has Xet.
                return str(content) if self._by_xet else opened.enter_context(content.open("rb"))

            additions = [CommitOperationAdd(name, source(content)) for name, content in added.items()]
            made = self._api.create_commit(
                operations=[*additions, *(CommitOperationDelete(name) for name in deleted)],
                **self._place,
                revision=self._revision,
                commit_message=message,
                parent_commit=self._commit,
            )
        # Where somebody else has just added all of it, the client makes no commit, but names theirs.
        if self._commit and all(getattr(one, "_is_committed", False) for one in additions):
            self._commit = made.oid
            for name in deleted:
                del self._entries[name]
            for one in additions:
                stored = StoredFile(one.upload_info.size, one.upload_info.sha256.hex(), "")
                self._entries[one.path_in_repo] = stored

    def _make(self) -> None:
        asked: dict[str, Any] = {"private": self._private or None, "exist_ok": True}
        if self.kind == "space":
            asked["space_sdk"] = "static"
        self._ask(lambda: self._api.create_repo(**self._place, **asked))

    # -- asking

    def _ask[T](self, call: Callable[[], T], where: str = "", attempt: int = 0) -> T:
        """Return the result of a client's call; repeat it if the hub is busy or the connection was cut."""
        try:
            with explained(where or self.name):
                return call()
        except HubError as fault:
            if status(fault) in _CONFLICTS:
                raise
            _pause(fault, attempt)
        return self._ask(call, where, attempt + 1)


def _pause(fault: HubError, attempt: int) -> None:
    """Wait before a request is made again; raise the fault if that would not help."""
    if status(fault) in _CONFLICTS:
        seconds: float | None = min(0.2 * 2**attempt, 10.0) * (0.5 + random.random())
    else:
        seconds = waiting(fault, attempt) if attempt < ATTEMPTS // 2 else None
    if seconds is None:
        raise fault
    log.info("%s; trying again", fault)
    time.sleep(seconds)


@cache
def _no_bar() -> Any:
    """Return the class of a progress bar that shows nothing."""
    from huggingface_hub.utils import tqdm

    class NoBar(tqdm):
        def __init__(self, *given: Any, **options: Any) -> None:
            super().__init__(*given, **options | {"disable": True})

    return NoBar
