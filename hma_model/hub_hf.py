"""A hub that is a repository of the Hugging Face Hub.

A push is one commit on top of the commit it was prepared for; when somebody else has committed in between, it
is prepared again. What is downloaded goes through the client's own cache, which works offline.
"""

import random
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from hma_data.errors import HubError
from hma_model.files import MAX_JSON_BYTES
from hma_model.hub_errors import LOG_IN, bounded, cuts, explain, explained, raised, waiting
from hma_model.hub_fetch import LARGE, fetch, fetch_to

ATTEMPTS = 8
TIMEOUT = 30.0  # seconds for a listing
_CONFLICTS = (409, 412)


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
        self._commit: str | None = None
        self._sizes: dict[str, int] | None = None
        self._digests: dict[str, str] = {}
        if write:
            if get_token() is None:
                remedy = f"{LOG_IN}; for a folder write ./{repo}"
                raise HubError(self.name, "needs a token to be written", remedy)
            self._patiently(
                lambda: self._api.create_repo(repo, repo_type=kind, exist_ok=True, private=private or None)
            )

    def files(self) -> dict[str, int]:
        """Sizes by name at the revision's newest commit; out of the hub's reach, of what the cache has."""

        def ask() -> Any:
            try:
                return self._api.repo_info(
                    self.repo,
                    repo_type=self._kind,
                    revision=self._revision,
                    files_metadata=True,
                    timeout=TIMEOUT,
                )
            except _unreachable():
                return None

        info = self._patiently(ask)
        if info is None:
            with explained(self.name):
                return self._cached_files()
        self._commit = info.sha
        lfs = {item.rfilename: item.lfs for item in info.siblings or [] if item.lfs}
        self._digests = {name: str(facts["sha256"]) for name, facts in lfs.items()}
        self._sizes = {item.rfilename: int(item.size or 0) for item in info.siblings or []}
        return dict(self._sizes)

    def read(self, name: str) -> bytes:
        """A file of at most 16 MB at the commit that `files` saw."""
        from huggingface_hub import hf_hub_download

        sizes = self.files() if self._sizes is None else self._sizes
        where, revision = f"{self.name}/{name}", self._commit or self._revision
        if sizes.get(name, 0) <= MAX_JSON_BYTES:
            path = self._patiently(
                lambda: Path(hf_hub_download(self.repo, name, repo_type=self._kind, revision=revision)), where
            )
            if path.stat().st_size <= MAX_JSON_BYTES:
                content: bytes = path.read_bytes()
                return content
        raise HubError(where, f"is larger than {MAX_JSON_BYTES:,} bytes", "this is not a file of ours")

    def warm(self, names: list[str]) -> None:
        """Bring small files to the cache together, for `read`."""
        from huggingface_hub import snapshot_download

        commit = self._commit
        small = [name for name in names if 0 < (self._sizes or {}).get(name, 0) <= MAX_JSON_BYTES]
        if commit and small:
            self._patiently(
                lambda: snapshot_download(
                    self.repo, repo_type=self._kind, revision=commit, allow_patterns=small
                )
            )

    def publish(self, changes: Callable[[], Mapping[str, Path | bytes | None]], message: str) -> str:
        """One commit, prepared again while others commit first."""
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete

        for attempt in range(ATTEMPTS):
            operations: list[CommitOperationAdd | CommitOperationDelete] = [
                CommitOperationAdd(name, str(content) if isinstance(content, Path) else content)
                if content is not None
                else CommitOperationDelete(name)
                for name, content in changes().items()
            ]
            try:
                with bounded():
                    self._api.create_commit(
                        self.repo,
                        operations,
                        repo_type=self._kind,
                        commit_message=message,
                        parent_commit=self._commit,
                    )
                return self.address
            except raised() as fault:
                response = getattr(fault, "response", None)
                conflict = response is not None and response.status_code in _CONFLICTS
                seconds = min(0.2 * 2**attempt, 10.0) if conflict else waiting(fault, attempt)
                if seconds is None or (not conflict and attempt >= ATTEMPTS // 2):
                    raise explain(self.name, fault) from fault
            time.sleep(seconds * (0.5 + random.random()) if conflict else seconds)
        raise HubError(self.name, f"others committed first {ATTEMPTS} times", "push again later")

    def digests(self) -> dict[str, str]:
        """SHA-256 by name of the large files, at the commit that `files` saw."""
        self.files()
        return dict(self._digests)

    def download(self, names: list[str], out: Path) -> None:
        """Files to a folder, past the client's cache; a killed download goes on where it stopped."""
        sizes = self.files() if self._sizes is None else self._sizes
        if self._commit is None:
            raise HubError(self.name, "is out of reach", "go online and pull again")
        commit = self._commit
        for name in names:
            if name in sizes:
                self._patiently(lambda: fetch_to(self.repo, self._kind, name, commit, out / name))  # noqa: B023

    def pull(self, names: list[str], out: Path | None) -> Path:
        """The client's cache, or a folder with copies of its own."""
        folder = self._patiently(lambda: self._fetched(names))
        if out is None:
            return folder
        from hma_model.hub_folder import FolderStore

        return FolderStore(folder).pull(names, out)

    def _fetched(self, names: list[str]) -> Path:
        from huggingface_hub import snapshot_download

        for name in names:
            if self._commit and (self._sizes or {}).get(name, 0) >= LARGE:
                fetch(self.repo, self._kind, name, self._commit)
        folder = snapshot_download(
            self.repo,
            repo_type=self._kind,
            revision=self._revision,  # by its name, so that it is found under it offline
            allow_patterns=names,
            local_files_only=self._commit is None,
            max_workers=4,
        )
        return Path(folder)

    def _cached_files(self) -> dict[str, int]:
        from huggingface_hub import snapshot_download
        from huggingface_hub.errors import IncompleteSnapshotError

        self._commit = None
        try:
            folder = Path(
                snapshot_download(
                    self.repo, repo_type=self._kind, revision=self._revision, local_files_only=True
                )
            )
        except IncompleteSnapshotError as fault:  # only some embodiments were pulled
            folder = Path(fault.snapshot_path)
        paths = (path for path in folder.rglob("*") if path.is_file())
        self._sizes = {path.relative_to(folder).as_posix(): path.stat().st_size for path in paths}
        self._revision = folder.name
        return dict(self._sizes)

    def _patiently(self, call: Callable[[], Any], where: str = "") -> Any:
        """What a call returns; it is made again where the hub is busy or the connection was cut."""
        from huggingface_hub.errors import HfHubHTTPError

        for attempt in range(ATTEMPTS // 2):
            try:
                with explained(where or self.name), bounded():
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
