"""Convert into a dataset repository of the Hugging Face Hub: `hf://datasets/org/name[@branch]/path`.

A repository takes few commits, not files one by one. The shard set is therefore made in a staging folder of
this machine ($HMA_CACHE/staging), where it can be resumed like any other, and then published. Files that the
repository has already with the same content are not uploaded again, so the same command also continues an
interrupted upload.
"""

import hashlib
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from hma_data.conversion.extend import hashes
from hma_data.conversion.plan import differences
from hma_data.errors import OutputError
from hma_data.hub.repository import Repository
from hma_data.shards.manifest import MANIFEST, Manifest
from hma_data.shards.publish import publish
from hma_data.storage.files import cache_folder
from hma_data.storage.remote import RemotePath

_URI = re.compile(r"hf://datasets/([^/@]+/[^/@]+)(?:@([^/]+))?(?:/(.+))?")


@dataclass(frozen=True)
class HubOutput:
    """The place of a shard set in a repository.

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
        """Return the output of an `hf://` path; None for any other path.

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
        """Return the folder of this machine from which the set is uploaded."""
        mark = hashlib.sha256(self.uri.encode()).hexdigest()[:8]
        return cache_folder() / "staging" / f"{self.repo.replace('/', '--')}-{mark}"

    def prepare(self) -> None:
        """Create the repository and the branch where they are missing; a lack of rights shows at once.

        Raises:
            HubError: there is no token, or it may not write there, or the hub cannot be reached.
        """
        self._repository.prepare(self._name(MANIFEST))

    def refuse_other(self, facts: dict[str, Any]) -> None:
        """Raise OutputError where the repository holds a set of another plan.

        The plan `facts` and the plans that it extends are accepted.
        """
        if self._name(MANIFEST) not in self._repository.files():
            return
        theirs = Manifest.load(RemotePath(self.uri)).plan
        if theirs["hash"] not in hashes(facts):
            words = differences(facts, theirs)
            raise OutputError(
                self.uri,
                f"belongs to another conversion; different: {words}",
                "choose another --out, or --overwrite to start anew",
            )

    def upload(self) -> None:
        """Upload the staging folder's shard set.

        Raises:
            OutputError: another job writes something else there meanwhile.
            HubError: the hub refuses it, or does not answer.
        """
        manifest, repository = Manifest.load(self.staging), self._repository
        ours = {shard.path: shard.sha256 for shard in manifest.shards} | {MANIFEST: None}
        repository.files()
        before = {name: repository.stated(self._name(name)) for name in ours}

        def refuse_foreign() -> dict[str, int]:
            """Return the files that are there; raise where one is foreign and was not there at the start."""
            files = repository.files()
            for name, sha256 in ours.items():
                now = repository.stated(self._name(name))
                if now in (None, before[name]):
                    continue
                if not repository.has(self._name(name), self.staging / name, sha256):
                    remedy = "choose another --out for one of the two"
                    raise OutputError(self.uri, "another conversion is writing there", remedy)
            return files

        publish(repository, self.staging, refuse_foreign, self.folder)

    @cached_property
    def _repository(self) -> Repository:
        return Repository(self.repo, self.branch, write=True, kind="dataset", name=self.uri)

    def _name(self, name: str) -> str:
        return f"{self.folder}/{name}" if self.folder else name
