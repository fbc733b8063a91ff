"""Conversions that end in a dataset repository of the Hugging Face Hub: `hf://datasets/org/name[@branch]/path`.

A repository takes commits, few of them, not files one by one. So the shard set is made in a staging
folder of this machine ($HMA_CACHE/staging), where it is resumed as any other, and then uploaded: shards
in commits of at most `FILES` files or `BYTES`, the manifest in the last. What is there already with the
same content is left out, so the same command also goes on with an upload that was cut off.
"""

import hashlib
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hma_data.errors import HubError, OutputError, StorageError
from hma_data.extend import hashes
from hma_data.files import cache_folder, file_sha256
from hma_data.hub_chunks import leave_after, leave_if_unknown
from hma_data.plan import differences
from hma_data.shards.manifest import EMBODIMENT, EPISODES, MANIFEST, QUARANTINE, SHARD_NAME, Manifest
from hma_data.store import RemotePath, attempt

FILES, BYTES = 50, 5 * 10**9  # of a commit
SILENCE_S = 300.0  # without an answer; a commit of many files takes the hub minutes
LOG_IN = "log in with hf auth login, or set HF_TOKEN"
_URI = re.compile(r"hf://datasets/([^/@]+/[^/@]+)(?:@([^/]+))?(?:/(.+))?")


@dataclass(frozen=True)
class HubOutput:
    """Where in a repository a shard set goes.

    Attributes:
        uri: as the user gave it.
        repo: organisation/name of the dataset.
        branch: None for the main one.
        folder: in the repository; empty for its root.
    """

    uri: str
    repo: str
    branch: str | None
    folder: str

    @classmethod
    def of(cls, out: Path) -> "HubOutput | None":
        """Of an `hf://` path; None for any other.

        Raises:
            OutputError: it names no dataset repository.
        """
        if not isinstance(out, RemotePath) or out.scheme != "hf":
            return None
        found = _URI.fullmatch(str(out))
        if not found:
            raise OutputError(out, "names no dataset of the hub", "write hf://datasets/ORGANISATION/NAME")
        return cls(str(out), found[1], found[2], found[3] or "")

    @property
    def staging(self) -> Path:
        """The folder of this machine that is uploaded from."""
        mark = hashlib.sha256(self.uri.encode()).hexdigest()[:8]
        return cache_folder() / "staging" / f"{self.repo.replace('/', '--')}-{mark}"

    def prepare(self) -> None:
        """Make the repository and branch where they are not there, so that a lack of rights is known at once.

        Raises:
            HubError: there is no token. StorageError: the hub refuses it; StorageAwayError: no answer.
        """
        from huggingface_hub import get_token

        if get_token() is None:
            raise HubError(self.uri, "needs a token to be written", LOG_IN)
        api = _api()
        self._asked(lambda: api.create_repo(self.repo, repo_type="dataset", exist_ok=True))
        if self.branch:
            branch = self.branch
            self._asked(
                lambda: api.create_branch(self.repo, repo_type="dataset", branch=branch, exist_ok=True)
            )

    def refuse_other(self, facts: dict[str, Any]) -> None:
        """Before anything is made.

        Raises:
            OutputError: the set that is there is of another plan than `facts`, and of none it extends.
        """
        if self._name(MANIFEST) not in self._there():
            return
        theirs = self._manifest().plan
        if theirs["hash"] not in hashes(facts):
            words = differences(facts, theirs)
            raise OutputError(
                self.uri,
                f"belongs to another conversion; different: {words}",
                "choose another --out, or --overwrite to start anew",
            )

    def upload(self) -> int:
        """Upload the staging folder's shard set; how many commits it took.

        Raises:
            StorageError: the hub refuses it; StorageAwayError: it does not answer.
        """
        from huggingface_hub import CommitOperationDelete

        folder, there = self.staging, self._there()
        manifest = Manifest.load(folder)
        missing = [s.path for s in manifest.shards if there.get(self._name(s.path)) != f"sha256:{s.sha256}"]
        others = [
            name for name in (EPISODES, QUARANTINE, EMBODIMENT, MANIFEST) if not self._same(name, there)
        ]
        kept = {self._name(shard.path) for shard in manifest.shards}
        stale = [name for name in there if self._is_shard(name) and name not in kept]
        *first, last = _batches(folder, missing)
        unfinished = [MANIFEST] if MANIFEST in others and self._name(MANIFEST) in there and first else []
        for number, batch in enumerate(first, 1):
            gone = [CommitOperationDelete(self._name(name)) for name in unfinished if number == 1]
            said = f"Shards of {manifest.embodiment.id}, {number} of {len(first) + 1}"
            self._commit([*self._added(batch), *gone], said)
        operations = [*self._added([*last, *others]), *(CommitOperationDelete(name) for name in stale)]
        if operations:
            self._commit(operations, f"Shard set of {manifest.embodiment.id}")
        return len(first) + bool(operations)

    def _added(self, names: Sequence[str]) -> list[Any]:
        from huggingface_hub import CommitOperationAdd

        return [CommitOperationAdd(self._name(name), str(self.staging / name)) for name in names]

    def _commit(self, operations: list[Any], message: str) -> None:
        def send() -> None:
            api = _api()
            with _bounded():
                leave_if_unknown(api, self.repo, "dataset")
                api.preupload_lfs_files(
                    self.repo,
                    added,
                    repo_type="dataset",
                    revision=self.branch,
                    free_memory=False,
                    gitignore_content="",  # one in the repository would silently leave files out
                )
                api.create_commit(
                    self.repo, operations, repo_type="dataset", revision=self.branch, commit_message=message
                )

        def by_any_way() -> None:
            try:
                send()
            except Exception as fault:
                if not leave_after(fault):
                    raise
                send()

        from huggingface_hub import CommitOperationAdd

        added = [item for item in operations if isinstance(item, CommitOperationAdd)]

        self._asked(by_any_way)

    def _there(self) -> dict[str, str]:
        """Name in the repository -> its content's hash: of LFS files their sha256, of others git's."""

        def ask() -> dict[str, str]:
            entries = _api().list_repo_tree(
                self.repo, repo_type="dataset", revision=self.branch, recursive=True
            )
            files = [entry for entry in entries if hasattr(entry, "blob_id")]
            return {
                file.path: f"sha256:{file.lfs.sha256}" if file.lfs else f"git:{file.blob_id}"
                for file in files
            }

        found: dict[str, str] = self._asked(ask)
        return found

    def _same(self, name: str, there: dict[str, str]) -> bool:
        path, mark = self.staging / name, there.get(self._name(name), "")
        if mark.startswith("sha256:"):
            return mark == f"sha256:{file_sha256(path)}"
        content = path.read_bytes()
        blob = hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False)
        return mark == f"git:{blob.hexdigest()}"

    def _manifest(self) -> Manifest:
        from huggingface_hub import hf_hub_download

        path = self._asked(
            lambda: hf_hub_download(
                self.repo, self._name(MANIFEST), repo_type="dataset", revision=self.branch
            )
        )
        return Manifest.load(Path(path).parent)

    def _name(self, name: str) -> str:
        return f"{self.folder}/{name}" if self.folder else name

    def _is_shard(self, name: str) -> bool:
        begin = f"{self.folder}/" if self.folder else ""
        return name.startswith(begin) and SHARD_NAME.fullmatch(name[len(begin) :]) is not None

    def _asked(self, action: Any) -> Any:
        try:
            return attempt(self.uri, "uploaded", action)
        except StorageError as fault:
            if any(word in fault.fault for word in ("401", "403")):
                raise StorageError(self.uri, fault.fault, f"{LOG_IN}, with a token that may write") from fault
            raise
        except FileNotFoundError as fault:
            raise StorageError(self.uri, "is not there", "check the name of repository and branch") from fault


def _api() -> Any:
    from huggingface_hub import HfApi

    return HfApi(library_name="hma-toolkit")


@contextmanager
def _bounded() -> Iterator[None]:
    """Let no request in this block wait for ever, which is the client's default."""
    from huggingface_hub import get_session

    client = get_session()
    before, client.timeout = client.timeout, SILENCE_S
    try:
        yield
    finally:
        client.timeout = before


def _batches(folder: Path, names: Sequence[str]) -> list[list[str]]:
    """Names in groups of a commit; at least one group, which may be empty."""
    groups: list[list[str]] = [[]]
    size = 0
    for name in names:
        own = (folder / name).stat().st_size
        if groups[-1] and (len(groups[-1]) >= FILES or size + own > BYTES):
            groups.append([])
            size = 0
        groups[-1].append(name)
        size += own
    return groups
