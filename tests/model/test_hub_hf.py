"""Repositories of the hub: commits, conflicts, errors and the cache, on a repository kept in memory."""

import hashlib
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest
from huggingface_hub import HfApi, errors

from hma_data.errors import HubError
from hma_model import checkpoint, hub
from hma_model.hub_hf import HuggingFaceStore
from hma_model.model import HMA
from tests.model.robots import save

ROBOTS = {"arm": 2, "hand": 3}
REPO = "team/model"
TOKEN = "hf_secret_of_this_test"


class Repository:
    """The calls of the client that a store makes, on snapshots in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.commits: list[dict[str, bytes]] = []
        self.before_commit: list = []
        self.failing: type[Exception] | Exception | None = None
        self.downloads: list[str] = []

    @property
    def head(self) -> str:
        return hashlib.sha1(str(len(self.commits)).encode()).hexdigest()

    def create_repo(self, repo, repo_type=None, exist_ok=False):
        self.commits = self.commits or [{".gitattributes": b""}]

    def model_info(self, repo, revision=None, files_metadata=False):
        self._fail()
        if not self.commits:
            raise answer(errors.RepositoryNotFoundError, 404)
        if revision not in (None, self.head, "main"):
            raise answer(errors.RevisionNotFoundError, 404)
        siblings = [SimpleNamespace(rfilename=n, size=len(c)) for n, c in self.commits[-1].items()]
        return SimpleNamespace(sha=self.head, siblings=siblings)

    def create_commit(self, repo, operations, commit_message, parent_commit=None):
        for act in self.before_commit[:1]:
            self.before_commit.pop(0)
            act()
        self._fail()
        if parent_commit != self.head:
            raise answer(errors.HfHubHTTPError, 412)
        added = {}
        for operation in operations:
            with operation.as_file() as file:
                added[operation.path_in_repo] = file.read()
        self.commits.append({**self.commits[-1], **added})

    def download(self, repo, name, revision=None):
        self.downloads.append(name)
        path = self.folder / self.head / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(self.commits[-1][name])
        return str(path)

    def snapshot(self, repo, revision=None, allow_patterns=None, local_files_only=False):
        if local_files_only:
            if not (self.folder / self.head).is_dir():
                raise errors.LocalEntryNotFoundError("not cached")
            if allow_patterns is None:
                raise errors.IncompleteSnapshotError("some", str(self.folder / self.head))
        else:
            for name in allow_patterns:
                self.download(repo, name)
        return str(self.folder / self.head)

    def _fail(self):
        if self.failing is not None:
            raise self.failing


def answer(kind: type[errors.HfHubHTTPError], status: int) -> errors.HfHubHTTPError:
    request = httpx.Request("POST", "https://hub.invalid/api", headers={"authorization": f"Bearer {TOKEN}"})
    return kind(f"{status} error", response=httpx.Response(status, request=request))


@pytest.fixture
def repository(tmp_path, monkeypatch) -> Repository:
    made = Repository(tmp_path / "cache/snapshots")
    for name in ("create_repo", "model_info", "create_commit"):
        monkeypatch.setattr(HfApi, name, lambda self, *a, _name=name, **k: getattr(made, _name)(*a, **k))
    monkeypatch.setattr("huggingface_hub.get_token", lambda: TOKEN)
    monkeypatch.setattr("huggingface_hub.hf_hub_download", made.download)
    monkeypatch.setattr("huggingface_hub.snapshot_download", made.snapshot)
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    return made


@pytest.fixture
def source(tmp_path: Path) -> Path:
    save(tmp_path / "model", ROBOTS)
    return tmp_path / "model"


def test_one_embodiment_is_one_commit_that_touches_nothing_else(repository, source):
    hub.push(source, REPO, ["arm"])
    hub.push(source, REPO, ["hand"])
    first, second = repository.commits[1:]
    changed = {name for name in second if second[name] != first.get(name)}
    assert {name for name in changed if not name.startswith("embodiments/hand/")} == {"README.md"}
    assert len(repository.commits) == 3 and b"| `arm` |" in second["README.md"]
    assert b'HMA.from_pretrained("team/model"' in second["README.md"]


def test_a_push_between_is_taken_in(repository, source):
    hub.push(source, REPO, [])
    repository.before_commit = [lambda: hub.push(source, REPO, ["hand"])]
    hub.push(source, REPO, ["arm"])
    page = repository.commits[-1]["README.md"]
    assert b"| `arm` |" in page and b"| `hand` |" in page
    assert [row["embodiment"] for row in hub.list_embodiments(REPO)] == ["arm", "hand"]


def test_two_first_pushes_of_different_trunks_leave_one(repository, source, tmp_path):
    save(tmp_path / "other", ROBOTS, seed=1)
    repository.before_commit = [lambda: hub.push(tmp_path / "other", REPO)]
    with pytest.raises(HubError, match="has another trunk"):
        hub.push(source, REPO)
    assert repository.commits[-1]["trunk.safetensors"] == (tmp_path / "other/trunk.safetensors").read_bytes()


def test_endless_conflicts_end(repository, source):
    def between():
        repository.commits.append(repository.commits[-1])
        repository.before_commit.append(between)

    repository.before_commit = [between]
    with pytest.raises(HubError, match="others committed first 8 times"):
        hub.push(source, REPO)


def test_one_embodiment_is_pulled_without_the_other(repository, source):
    hub.push(source, f"hf://{REPO}")
    repository.downloads.clear()
    model = HMA.from_pretrained(REPO, embodiments=["arm"])
    assert list(model.embodiments) == ["arm"]
    assert not [
        name for name in repository.downloads if "hand" in name or name.endswith((".md", ".gitattributes"))
    ]


def test_pulling_into_a_folder_gives_files_of_its_own(repository, source, tmp_path):
    hub.push(source, REPO)
    out = hub.pull(REPO, out=tmp_path / "out", revision="main")
    assert set(checkpoint.load(out).embodiments) == set(ROBOTS)


def test_what_was_pulled_is_there_offline(repository, source):
    hub.push(source, REPO)
    hub.pull(REPO, ["arm"])
    repository.failing = errors.OfflineModeIsEnabled("offline")
    assert list(HMA.from_pretrained(REPO, embodiments=["arm"]).embodiments) == ["arm"]


def test_what_was_never_pulled_is_not_there_offline(repository, source):
    repository.failing = httpx.ConnectError("no route")
    with pytest.raises(HubError, match="out of reach, and not in the cache"):
        hub.pull(REPO)


def test_a_repository_and_a_revision_that_are_not_there_say_so(repository, source):
    with pytest.raises(HubError, match="no such repository, or no access"):
        hub.pull(REPO)
    hub.push(source, REPO)
    with pytest.raises(HubError, match="no such revision"):
        hub.pull(REPO, revision="v9")


def test_a_repository_of_another_library_says_so(repository, source):
    repository.create_repo(REPO)
    with pytest.raises(HubError, match=r"has no config\.json"):
        hub.pull(REPO)
    repository.commits[-1]["config.json"] = b'{"model_type": "bert"}'
    with pytest.raises(HubError, match="is not of hma-toolkit"):
        hub.push(source, REPO)


@pytest.mark.parametrize(
    ("status", "remedy"), [(401, "not valid"), (403, "may not write"), (429, "too many"), (500, "try again")]
)
def test_a_refusal_names_the_remedy_and_never_the_token(repository, source, status, remedy):
    repository.create_repo(REPO)
    repository.failing = answer(errors.HfHubHTTPError, status)
    with pytest.raises(HubError, match=f"answered {status}.*{remedy}") as caught:
        hub.push(source, REPO)
    assert TOKEN not in str(caught.value)


def test_a_huge_card_is_not_read(repository, source, monkeypatch):
    hub.push(source, REPO)
    store = HuggingFaceStore(REPO)
    name = "embodiments/arm/card.json"
    store.files()
    store._sizes[name] = 10**12
    with pytest.raises(HubError, match="is larger than"):
        store.read(name)
