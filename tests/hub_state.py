"""What the hub of the tests holds, what goes wrong with it, and what the interface leaves open to it."""

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

REPO = "team/model"
ROBOTS = {"arm": 2, "hand": 3}  # of the checkpoint in it: id -> action dims
TOKEN = "hf_TheSecretOfThisTest"
EVERY = [pytest.param(4, id="some"), pytest.param(1, id="all", marks=pytest.mark.slow)]  # requests to be cut
LFS_BYTES = 10_000_000  # larger files, and those of binary kinds, go by LFS
LFS_KINDS = (".safetensors", ".png", ".parquet", ".bin")


@dataclass
class Habits:
    """The ways in which hubs differ.

    Attributes:
        page: entries of a listing's page.
        lfs: which files go by LFS: "kinds" and large ones, "all" or "none".
        redirects: send files of LFS by another host; otherwise they come directly.
        conflict: status where somebody else has committed.
        tells_oids: say before an upload what is there already.
        ranges: send parts of files.
        codes: say by X-Error-Code what is missing.
        empty: send empty files; otherwise they are answered by 404.
    """

    page: int = 1000
    lfs: str = "kinds"
    redirects: bool = True
    conflict: int = 412
    tells_oids: bool = True
    ranges: bool = True
    codes: bool = True
    empty: bool = True

    def by_lfs(self, path: str, size: int) -> bool:
        if self.lfs != "kinds":
            return self.lfs == "all"
        return size > LFS_BYTES or path.endswith(LFS_KINDS)

    def entry(self, path: str, content: bytes) -> dict[str, Any]:
        entry: dict[str, Any] = {"type": "file", "path": path, "size": len(content), "oid": oid(content)}
        if self.by_lfs(path, len(content)):
            entry["lfs"] = {"oid": sha256(content), "size": len(content), "pointerSize": 134}
        return entry


@dataclass
class Commit:
    id: str
    files: dict[str, bytes]
    message: str


@dataclass
class Repository:
    """Commits, oldest first, and tags and branches besides main."""

    name: str
    private: bool = False
    commits: list[Commit] = field(default_factory=list)
    refs: dict[str, str] = field(default_factory=dict)

    def commit(self, files: dict[str, bytes | None], message: str = "by hand") -> Commit:
        before = self.commits[-1].files if self.commits else {}
        after = {path: content for path, content in {**before, **files}.items() if content is not None}
        name = hashlib.sha1(f"{self.name} {len(self.commits)} {message}".encode()).hexdigest()
        self.commits.append(Commit(name, after, message))
        return self.commits[-1]

    def commit_folder(self, folder: Path, branch: str = "main") -> Commit:
        """Add a commit that has what a folder has and nothing else; below all others where not for main."""
        before = self.commits[-1].files if self.commits and branch == "main" else {}
        there = {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
        made = self.commit({**dict.fromkeys(before), **there}, f"{branch} of {folder.name}")
        if branch != "main":
            made.files = there
            self.commits.insert(0, self.commits.pop())
            self.refs[branch] = made.id
        return made

    def commit_to(self, branch: str, files: dict[str, bytes | None], message: str) -> Commit:
        head = self.at(branch)
        assert head is not None
        newest = self.commits[-1]
        made = self.commit(files, f"{branch}: {message}")
        made.files = {path: data for path, data in {**head.files, **files}.items() if data is not None}
        self.commits = [made, *(one for one in self.commits if one is not made)]
        assert self.commits[-1] is newest
        self.refs[branch] = made.id
        return made

    def at(self, revision: str) -> Commit | None:
        wanted = self.commits[-1].id if revision == "main" else self.refs.get(revision, revision)
        return next((commit for commit in self.commits if commit.id == wanted), None)

    @property
    def files(self) -> dict[str, bytes]:
        return self.commits[-1].files


@dataclass
class Fault:
    """A fault: an answer, or a connection cut after some bytes.

    Attributes:
        request: regular expression over "METHOD path".
        status: answered instead; None cuts the connection.
        after: bytes of the body, coming or going, before the cut.
        times: how often; then all is well.
        stall: seconds without an answer before, or until the hub's `stalled` is set.
        late: answered as usual after `stall`.
        body: of the answer.
    """

    request: str
    status: int | None = None
    headers: dict[str, str] = field(default_factory=dict)
    after: int = 0
    times: int = 1
    stall: float = 0.0
    late: bool = False
    body: bytes = b'{"error": "made up"}'


@dataclass
class Asked:
    method: str
    path: str
    range: str | None
    authorized: bool
    host: str
    sent: int = 0


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def oid(content: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
