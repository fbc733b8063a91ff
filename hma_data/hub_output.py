"""Conversions that end in a dataset repository of the Hugging Face Hub: `hf://datasets/org/name[@branch]/path`.

A repository takes commits, few of them, not files one by one. So the shard set is made in a staging
folder of this machine ($HMA_CACHE/staging), where it is resumed as any other, and then uploaded: shards
in commits of at most `FILES` files or `BYTES`, the manifest in the last. What is there already with the
same content is left out, so the same command also goes on with an upload that was cut off.
"""

import hashlib
import random
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from hma_data.errors import HMAError, HubError, OutputError, StorageAwayError, StorageError
from hma_data.extend import hashes
from hma_data.files import cache_folder, file_sha256
from hma_data.hub_bounds import bounded
from hma_data.hub_chunks import leave_after, leave_if_unknown, refuse_ignored
from hma_data.hub_errors import AGAIN, LOG_IN, raised, waiting, without_token
from hma_data.plan import differences
from hma_data.shards.manifest import EMBODIMENT, EPISODES, MANIFEST, QUARANTINE, SHARD_NAME, Manifest
from hma_data.store import RemotePath, attempt

FILES, BYTES = 50, 5 * 10**9  # of a commit
TURNS = 3  # to ask a hub that says when to ask again
BUSY = 429
MOST_MOVES = 20  # of the branch, by others, while this uploads
_CONFLICTS = (409, 412)
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
        self._asked(self._require_right)

    def _require_right(self) -> None:
        """Ask how a manifest would be uploaded, which only those are told who may."""
        from huggingface_hub import get_session
        from huggingface_hub.utils import build_hf_headers, hf_raise_for_status

        branch = quote(self.branch or "main", safe="")
        asked = {"files": [{"path": self._name(MANIFEST), "size": 1, "sample": "ew=="}]}
        answer = get_session().post(
            f"{_api().endpoint}/api/datasets/{self.repo}/preupload/{branch}",
            json=asked,
            headers=build_hf_headers(library_name="hma-toolkit"),
        )
        hf_raise_for_status(answer)

    def refuse_other(self, facts: dict[str, Any]) -> None:
        """Before anything is made.

        Raises:
            OutputError: the set that is there is of another plan than `facts`, and of none it extends.
        """
        if self._name(MANIFEST) not in self._there():
            return
        theirs = Manifest.load(RemotePath(self.uri)).plan
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
            OutputError: another job writes something else there meanwhile.
            StorageError: the hub refuses it; StorageAwayError: it does not answer.
        """
        manifest, made, conflicts = Manifest.load(self.staging), 0, 0
        head, there = self._state()
        begun, planned = there, self._pending(manifest, there)
        while planned:
            names, gone = planned[0]
            said = f"Shard set of {manifest.embodiment.id}"
            if len(planned) > 1:
                said = f"Shards of {manifest.embodiment.id}, {made + 1} of {made + len(planned)}"
            try:
                head = self._commit(names, gone, said, head)
            except _MovedError as fault:  # by somebody else, or by a commit of ours whose answer was lost
                conflicts += 1
                if conflicts > MOST_MOVES:
                    raise StorageAwayError(self.uri, "others keep committing there", AGAIN) from fault
                time.sleep(random.random() * min(10.0, 0.2 * 2**conflicts))
                head, there = self._state()
                self._refuse_foreign(manifest, there, begun)
                planned = self._pending(manifest, there)
                continue
            made += 1
            planned = planned[1:]
        return made

    def _pending(self, manifest: Manifest, there: dict[str, str]) -> list[tuple[list[str], list[str]]]:
        """What each commit adds and deletes; the manifest is in the last."""
        missing = [s.path for s in manifest.shards if not self._same(s.path, there, s.sha256)]
        others = [
            name for name in (EPISODES, QUARANTINE, EMBODIMENT, MANIFEST) if not self._same(name, there)
        ]
        kept = {self._name(shard.path) for shard in manifest.shards}
        stale = [name for name in there if self._is_shard(name) and name not in kept]
        *first, last = _batches(self.staging, missing)
        commits: list[tuple[list[str], list[str]]] = [(batch, []) for batch in first]
        if first and MANIFEST in others and self._name(MANIFEST) in there:
            commits[0][1].append(self._name(MANIFEST))  # it would name other shards
        last += others
        return [*commits, (last, stale)] if last or stale else commits

    def _refuse_foreign(self, manifest: Manifest, there: dict[str, str], begun: dict[str, str]) -> None:
        """Raise where what is there is neither ours nor what was there when we began."""
        ours: dict[str, str | None] = {shard.path: shard.sha256 for shard in manifest.shards}
        for name, sha256 in (ours | {MANIFEST: None}).items():
            mark = there.get(self._name(name))
            if mark not in (None, begun.get(self._name(name))) and not self._same(name, there, sha256):
                remedy = "choose another --out for one of the two"
                raise OutputError(self.uri, "another conversion is writing there", remedy)

    def _commit(
        self, names: Sequence[str], gone: Sequence[str], message: str, head: str | None
    ) -> str | None:
        """One commit on top of `head`; the new head.

        Raises:
            _MovedError: the branch has another head.
        """
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete

        added = [CommitOperationAdd(self._name(name), str(self.staging / name)) for name in names]
        deleted = [CommitOperationDelete(name) for name in gone]

        def send() -> str | None:
            api = _api()
            leave_if_unknown(api, self.repo, "dataset")
            api.preupload_lfs_files(
                self.repo,
                added,
                repo_type="dataset",
                revision=self.branch,
                free_memory=False,
                gitignore_content="",
            )
            refuse_ignored(added, self.uri)
            made = api.create_commit(
                self.repo,
                [*added, *deleted],
                repo_type="dataset",
                revision=self.branch,
                commit_message=message,
                parent_commit=head,
            )
            return str(made.oid)

        def by_any_way() -> str | None:
            try:
                return send()
            except Exception as fault:
                if getattr(getattr(fault, "response", None), "status_code", None) in _CONFLICTS:
                    raise _MovedError(self.uri, "has another commit") from fault
                if not leave_after(fault):
                    raise
                return send()

        return self._asked(by_any_way)

    def _state(self) -> tuple[str | None, dict[str, str]]:
        """The branch's newest commit, and what is in it."""
        api = _api()
        info = self._asked(lambda: api.repo_info(self.repo, repo_type="dataset", revision=self.branch))
        return info.sha, self._there(info.sha) if info.sha else {}

    def _there(self, revision: str | None = None) -> dict[str, str]:
        """Name in the repository -> its content's hash: of LFS files their sha256, of others git's."""

        def ask() -> dict[str, str]:
            entries = _api().list_repo_tree(
                self.repo, repo_type="dataset", revision=revision or self.branch, recursive=True
            )
            files = [entry for entry in entries if hasattr(entry, "blob_id")]
            return {
                file.path: f"sha256:{file.lfs.sha256}" if file.lfs else f"git:{file.blob_id}"
                for file in files
            }

        found: dict[str, str] = self._asked(ask)
        return found

    def _same(self, name: str, there: dict[str, str], sha256: str | None = None) -> bool:
        """Whether a file of the staging folder, of this digest where it is known, is there."""
        path, mark = self.staging / name, there.get(self._name(name), "")
        if mark.startswith("sha256:"):
            return mark == f"sha256:{sha256 or file_sha256(path)}"
        if not mark:
            return False
        content = path.read_bytes()
        blob = hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False)
        return mark == f"git:{blob.hexdigest()}"

    def _name(self, name: str) -> str:
        return f"{self.folder}/{name}" if self.folder else name

    def _is_shard(self, name: str) -> bool:
        begin = f"{self.folder}/" if self.folder else ""
        return name.startswith(begin) and SHARD_NAME.fullmatch(name[len(begin) :]) is not None

    def _asked[T](self, action: Callable[[], T]) -> T:
        """What the hub answers, asked again where that may help, and after the time that it names."""

        def patiently() -> T:
            for turn in range(TURNS):
                try:
                    with bounded():
                        return action()
                except raised() as fault:
                    cause = _cause(without_token(fault))
                    busy = getattr(getattr(cause, "response", None), "status_code", None) == BUSY
                    if not busy or turn == TURNS - 1 or (seconds := waiting(cause, turn)) is None:
                        raise cause from None
                time.sleep(seconds)
            raise AssertionError("the last turn returns or raises")

        try:
            return attempt(self.uri, "uploaded", patiently)
        except StorageError as fault:
            if any(word in fault.fault for word in ("401", "403")):
                raise StorageError(self.uri, fault.fault, f"{LOG_IN}, with a token that may write") from fault
            raise
        except FileNotFoundError as fault:
            raise StorageError(self.uri, "is not there", "check the name of repository and branch") from fault


class _MovedError(HMAError):
    """A branch has another newest commit than a commit was made for."""


def _cause(fault: BaseException) -> BaseException:
    """What happened, where the client only says which file it was uploading."""
    from httpx import HTTPError

    cause = fault.__cause__
    return cause if isinstance(fault, RuntimeError) and isinstance(cause, HTTPError) else fault


def _api() -> Any:
    from huggingface_hub import HfApi

    return HfApi(library_name="hma-toolkit")


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
