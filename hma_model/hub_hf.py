"""A hub that is a model repository of the Hugging Face Hub.

A push is one commit on top of the commit it was prepared for; when somebody else has committed in between, it
is prepared again. What is downloaded goes through the client's own cache, which resumes and works offline.
"""

import random
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hma_data.errors import HubError
from hma_model.files import MAX_JSON_BYTES

ATTEMPTS = 8
_CONFLICTS = (409, 412)


class HuggingFaceStore:
    """See `hma_model.hub.Store`.

    Args:
        repo: organisation/name.
        revision: branch, tag or commit; None for main.
        write: make the repository where it is not there.

    Raises:
        HubError: not there, no access, or not reachable.
    """

    def __init__(self, repo: str, revision: str | None = None, write: bool = False) -> None:
        from huggingface_hub import HfApi, get_token

        self.name, self.repo, self._revision = f"hf://{repo}", repo, revision
        self._api = HfApi(library_name="hma-toolkit")
        self._commit: str | None = None
        self._sizes: dict[str, int] | None = None
        if write:
            if get_token() is None:
                raise HubError(
                    self.name,
                    "needs a token to be written",
                    f"log in with hf auth login, or set HF_TOKEN; for a folder write ./{repo}",
                )
            with _explained(self.name):
                self._api.create_repo(repo, repo_type="model", exist_ok=True)

    def files(self) -> dict[str, int]:
        """Sizes by name at the revision's newest commit; out of the hub's reach, of what the cache has."""
        with _explained(self.name):
            try:
                info = self._api.model_info(self.repo, revision=self._revision, files_metadata=True)
            except _unreachable():
                return self._cached_files()
        self._commit = info.sha
        self._sizes = {item.rfilename: int(item.size or 0) for item in info.siblings or []}
        return dict(self._sizes)

    def read(self, name: str) -> bytes:
        """A file of at most 16 MB at the commit that `files` saw."""
        from huggingface_hub import hf_hub_download

        sizes = self.files() if self._sizes is None else self._sizes
        if sizes.get(name, 0) > MAX_JSON_BYTES:
            raise HubError(f"{self.name}/{name}", f"is larger than {MAX_JSON_BYTES:,} bytes")
        with _explained(f"{self.name}/{name}"):
            path = hf_hub_download(self.repo, name, revision=self._commit or self._revision)
            return Path(path).read_bytes()

    def publish(self, changes: Callable[[], Mapping[str, Path | bytes]], message: str) -> str:
        """One commit, prepared again while others commit first."""
        from huggingface_hub import CommitOperationAdd
        from huggingface_hub.errors import HfHubHTTPError

        for attempt in range(ATTEMPTS):
            operations = [
                CommitOperationAdd(name, str(content) if isinstance(content, Path) else content)
                for name, content in changes().items()
            ]
            with _explained(self.name):
                try:
                    self._api.create_commit(
                        self.repo, operations, commit_message=message, parent_commit=self._commit
                    )
                    return f"{self._api.endpoint}/{self.repo}"
                except HfHubHTTPError as fault:
                    if fault.response is None or fault.response.status_code not in _CONFLICTS:
                        raise
            time.sleep(min(0.2 * 2**attempt, 10.0) * (0.5 + random.random()))
        raise HubError(self.name, f"others committed first {ATTEMPTS} times", "push again later")

    def pull(self, names: list[str], out: Path | None) -> Path:
        """The client's cache, or a folder with copies of its own."""
        from huggingface_hub import snapshot_download

        offline = self._commit is None
        with _explained(self.name):
            folder = Path(
                snapshot_download(
                    self.repo,
                    revision=self._revision if offline else self._commit,
                    allow_patterns=names,
                    local_files_only=offline,
                )
            )
        if out is None:
            return folder
        from hma_model.hub_folder import FolderStore

        return FolderStore(folder).pull(names, out)

    def _cached_files(self) -> dict[str, int]:
        from huggingface_hub import snapshot_download
        from huggingface_hub.errors import IncompleteSnapshotError

        self._commit = None
        try:
            folder = Path(snapshot_download(self.repo, revision=self._revision, local_files_only=True))
        except IncompleteSnapshotError as fault:  # only some embodiments were pulled
            folder = Path(fault.snapshot_path)
        paths = (path for path in folder.rglob("*") if path.is_file())
        self._sizes = {path.relative_to(folder).as_posix(): path.stat().st_size for path in paths}
        self._revision = folder.name
        return dict(self._sizes)


def _unreachable() -> tuple[type[BaseException], ...]:
    import httpx
    from huggingface_hub.errors import OfflineModeIsEnabled

    return (OfflineModeIsEnabled, httpx.ConnectError, httpx.TimeoutException)


@contextmanager
def _explained(where: str) -> Iterator[None]:
    """The client's errors as HubErrors; none of them shows a token."""
    import httpx
    from huggingface_hub import errors

    try:
        yield
    except errors.GatedRepoError as fault:
        raise HubError(
            where, "is gated", "ask for access on its page, then log in with hf auth login"
        ) from fault
    except errors.RevisionNotFoundError as fault:
        raise HubError(where, "has no such revision", "name a branch, tag or commit of it") from fault
    except errors.RepositoryNotFoundError as fault:
        raise HubError(
            where, "no such repository, or no access to it", "check the name; log in with hf auth login"
        ) from fault
    except errors.LocalEntryNotFoundError as fault:
        raise HubError(where, "is out of reach, and not in the cache", "go online and pull again") from fault
    except errors.HFValidationError as fault:
        raise HubError(where, "is not a repository's name", "write ORGANISATION/NAME") from fault
    except errors.HfHubHTTPError as fault:
        raise _answered(where, fault) from fault
    except (errors.OfflineModeIsEnabled, httpx.HTTPError) as fault:
        raise HubError(
            where, f"is out of reach: {type(fault).__name__}", "check the network, try again"
        ) from fault
    except OSError as fault:
        raise HubError(
            where, f"could not be stored: {fault.strerror or fault}", "free space, try again"
        ) from fault


def _answered(where: str, fault: Any) -> HubError:
    status = fault.response.status_code if fault.response is not None else None
    remedies = {
        401: "the token is not valid: log in with hf auth login",
        403: "the token may not write here: use one with write access",
        429: "too many requests: wait and try again",
    }
    remedy = remedies.get(status or 0, "try again later; what was there is as it was")
    return HubError(where, f"the hub answered {status}", remedy)
