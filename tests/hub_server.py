"""A hub on loopback that speaks the public HTTP interface of the Hugging Face Hub, for its real client.

Repositories are kept in memory as lists of commits. Answers follow the hub's: error codes in X-Error-Code,
LFS uploads by signed address, downloads of LFS files by redirect to another host (here `localhost` beside
`127.0.0.1`), listings in pages. `fail` makes requests go wrong; `log` says what was asked and sent.
"""

import base64
import json
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from tests.hub_state import Asked, Commit, Fault, Habits, Repository, oid, sha256

_PLACE = re.compile(r"^.*?/resolve/[^/]+/|^/cdn/[0-9a-f]+/")


class Hub(ThreadingHTTPServer):
    """The server.

    Attributes:
        tokens: token -> "read" or "write".
        repositories: "models/org/name" or "datasets/org/name" -> Repository.
        before_commit: functions called, one each, before a commit is looked at.
        habits: what it does where the interface leaves it open.
        waits: seconds that clients slept; see `connect`.
        gone_after: how many requests it answers before it answers none; None for all.
    """

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.tokens: dict[str, str] = {}
        self.repositories: dict[str, Repository] = {}
        self.objects: dict[str, bytes] = {}
        self.faults: list[Fault] = []
        self.log: list[Asked] = []
        self.before_commit: list[Any] = []
        self.habits = Habits()
        self.waits: list[float] = []
        self.gone_after: int | None = None
        self.stalled = threading.Event()
        self.lock = threading.RLock()
        self.changed = threading.Condition(self.lock)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    def create(self, name: str, kind: str = "models", private: bool = False) -> Repository:
        made = Repository(name, private)
        made.commit({".gitattributes": b"*.safetensors filter=lfs\n"}, "initial commit")
        self.repositories[f"{kind}/{name}"] = made
        return made

    def add_folder(self, name: str, branch: str, folder: Path) -> str:
        kept = self.repositories.setdefault(f"datasets/{name}", Repository(name))
        return kept.commit_folder(folder, branch).id

    def served(self) -> list[str]:
        sent = [asked.path for asked in self.log if asked.method == "GET" and asked.sent]
        return [re.sub(_PLACE, "", path) for path in sent]

    def model(self, name: str) -> Repository:
        return self.repositories[f"models/{name}"]

    def fail(self, request: str, status: int | None = None, **facts: Any) -> None:
        """Let the next requests of a kind go wrong; see `Fault`."""
        self.faults.append(Fault(request, status, **facts))

    def sent(self, pattern: str = "") -> dict[str, int]:
        totals: dict[str, int] = {}
        for asked in self.log:
            if asked.method == "GET" and asked.sent and re.search(pattern, asked.path):
                path = re.sub(_PLACE, "", asked.path)
                totals[path] = totals.get(path, 0) + asked.sent
        return totals

    def count(self, request: str) -> int:
        return sum(re.search(request, f"{asked.method} {asked.path}") is not None for asked in self.log)

    def await_count(self, request: str, times: int) -> None:
        with self.changed:
            assert self.changed.wait_for(lambda: self.count(request) >= times, 60)

    def handle_error(self, request: Any, client_address: Any) -> None:
        pass  # connections are cut on purpose


class _Handler(BaseHTTPRequestHandler):
    server: Hub
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def log_message(self, *arguments: object) -> None:
        pass

    def do_HEAD(self) -> None:
        self._handle()

    do_GET = do_POST = do_PUT = do_HEAD

    def _handle(self) -> None:
        split = urlsplit(self.path)
        self.route, self.query = unquote(split.path), parse_qs(split.query)
        host, authorized = self.headers.get("Host", ""), "authorization" in self.headers
        self.asked = Asked(self.command, self.route, self.headers.get("Range"), authorized, host)
        with self.server.lock:
            self.fault = self._fault()
            self.server.log.append(self.asked)  # before the answer, after which it is looked at
            self.server.changed.notify_all()
        if self.fault and self.fault.stall:
            self.server.stalled.wait(self.fault.stall)
            self.fault = None if self.fault.late else self.fault
        if self.fault and self.fault.status:
            self._body()
            self._answer(self.fault.status, self.fault.body, self.fault.headers)
        elif self.fault and self.command in ("POST", "PUT"):
            self.rfile.read(min(self.fault.after, int(self.headers.get("Content-Length", 0))))
            self._cut()
        else:
            self.content = self._body()
            self._route()

    def _fault(self) -> Fault | None:
        if self.server.gone_after is not None and len(self.server.log) >= self.server.gone_after:
            return Fault("")
        for fault in self.server.faults:
            if fault.times > 0 and re.search(fault.request, f"{self.command} {self.route}"):
                fault.times -= 1
                return fault
        return None

    def _body(self) -> bytes:
        return self.rfile.read(int(self.headers.get("Content-Length", 0)))

    def _cut(self) -> None:
        self.close_connection = True
        self.connection.shutdown(2)

    # -- which answer

    def _route(self) -> None:
        if self.route.startswith("/lfs/"):  # signed addresses, which need no token
            return self._lfs_object()
        if self.route.startswith("/cdn/"):
            return self._send_file(self.server.objects[self.route.split("/")[2]], {})
        token = (self.headers.get("Authorization") or "").removeprefix("Bearer ")
        self.right = self.server.tokens.get(token)
        if token and not self.right:
            message = "Invalid credentials in Authorization header"
            return self._answer(401, {"error": message}, {"X-Error-Message": message})
        if self.route == "/api/whoami-v2":
            return self._whoami()
        if self.route == "/api/repos/create":
            return self._create()
        if self.route == "/api/validate-yaml":
            return self._validate()
        return self._repository()

    def _whoami(self) -> None:
        if not self.right:
            return self._answer(401, {"error": "Invalid username or password."})
        return self._answer(200, {"type": "user", "name": "someone", "orgs": []})

    def _create(self) -> None:
        wanted = json.loads(self.content)
        name = f"{wanted.get('organization') or 'someone'}/{wanted['name']}"
        kind = f"{wanted.get('type', 'model')}s"
        if not self.right:
            return self._answer(401, {"error": "Invalid username or password."})
        if f"{kind}/{name}" in self.server.repositories:
            return self._answer(
                409, {"error": "You already created this", "url": f"{self.server.url}/{name}"}
            )
        if self.right != "write":
            return self._answer(403, {"error": "You don't have the rights to create this"})
        made = self.server.create(name, kind, wanted.get("visibility") == "private")
        if kind == "spaces":
            header = f"---\nsdk: {wanted['sdk']}\n---\n".encode()
            made.commit({"README.md": header, "index.html": b"new", "style.css": b"new"}, "new Space")
        prefix = "" if kind == "models" else f"{kind}/"
        return self._answer(200, {"url": f"{self.server.url}/{prefix}{name}", "name": name})

    def _validate(self) -> None:
        import yaml

        page = json.loads(self.content)["content"]
        try:
            front = yaml.safe_load(page.split("---\n")[1]) if page.startswith("---\n") else {}
        except yaml.YAMLError as fault:
            return self._answer(400, {"errors": [{"message": str(fault)}], "warnings": []})
        licence = front.get("license")
        known = licence is None or licence in ("apache-2.0", "mit", "cc-by-4.0", "other")
        if not known:
            message = '"license" must be one of [apache-2.0, mit, ...]'
            return self._answer(400, {"errors": [{"message": message}], "warnings": []})
        return self._answer(200, {"errors": [], "warnings": []})

    def _repository(self) -> None:
        found = re.fullmatch(
            r"(?:/api)?(?:/(models|datasets|spaces))?/([^/]+/[^/]+?)(?:\.git)?(/.*)?", self.route
        )
        if not found:
            return self._answer(404, {"error": "no such page"})
        kind, name, rest = found[1] or "models", found[2], (found[3] or "").lstrip("/")
        repository = self.server.repositories.get(f"{kind}/{name}")
        if repository is None or (repository.private and not self.right):
            status = 404 if self.right else 401
            coded = {"X-Error-Code": "RepoNotFound"} if self.server.habits.codes else {}
            return self._answer(status, {"error": "Repository not found"}, coded)
        verb, _, place = rest.partition("/")
        if verb in ("preupload", "commit", "branch") or rest.endswith("objects/batch"):
            if self.right != "write":
                return self._answer(403 if self.right else 401, {"error": "Forbidden: write rights needed"})
            if verb not in ("preupload", "commit", "branch"):
                return self._batch(repository)
            actions = {"preupload": self._preupload, "commit": self._commit, "branch": self._branch}
            return actions[verb](repository, place)
        if verb not in ("resolve", "tree", "paths-info", "revision", ""):
            return self._answer(404, {"error": "Not Found"})
        revision, _, path = place.partition("/")
        commit = repository.at(revision or "main")
        if commit is None:
            return self._answer(404, {"error": "Invalid rev id"}, {"X-Error-Code": "RevisionNotFound"})
        if verb == "resolve":
            return self._resolve(commit, path)
        if verb == "tree":
            return self._tree(commit, path)
        if verb == "paths-info":
            return self._paths(commit)
        siblings = [{"rfilename": path} for path in commit.files]
        facts = {"id": name, "sha": commit.id, "private": repository.private, "siblings": siblings}
        return self._answer(200, {**facts, "tags": [], "downloads": 0, "likes": 0})

    # -- reading

    def _paths(self, commit: Commit) -> None:
        entries = []
        for path in parse_qs(self.content.decode()).get("paths", []):
            if path in commit.files:
                entries.append(self.server.habits.entry(path, commit.files[path]))
            elif any(name.startswith(f"{path}/") for name in commit.files):
                entries.append({"type": "directory", "path": path, "oid": oid(path.encode())})
        self._answer(200, entries)

    def _tree(self, commit: Commit, below: str) -> None:
        begin = f"{below}/" if below else ""
        files = sorted(commit.files.items())
        entries = [
            self.server.habits.entry(path, content) for path, content in files if path.startswith(begin)
        ]
        start = int(self.query.get("cursor", ["0"])[0])
        headers = {}
        if start + self.server.habits.page < len(entries):
            following = (
                f"{self.server.url}{self.route}?recursive=true&cursor={start + self.server.habits.page}"
            )
            headers["Link"] = f'<{following}>; rel="next"'
        self._answer(200, entries[start : start + self.server.habits.page], headers)

    def _resolve(self, commit: Commit, path: str) -> None:
        headers = {"X-Repo-Commit": commit.id}
        content = commit.files.get(path)
        if content is None or not (content or self.server.habits.empty):
            return self._answer(404, {"error": "no such entry"}, {**headers, "X-Error-Code": "EntryNotFound"})
        if not self.server.habits.by_lfs(path, len(content)):
            return self._send_file(content, {**headers, "ETag": f'"{oid(content)}"'})
        name = sha256(content)
        self.server.objects.setdefault(name, content)
        if not self.server.habits.redirects:
            return self._send_file(self.server.objects[name], {**headers, "ETag": f'"{name}"'})
        place = f"http://localhost:{self.server.server_address[1]}/cdn/{name}/{path}?signature=x"
        headers |= {"X-Linked-ETag": f'"{name}"', "X-Linked-Size": str(len(content)), "Location": place}
        return self._answer(302, None, headers)

    def _send_file(self, content: bytes, headers: dict[str, str]) -> None:
        status, part = 200, content
        asked = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range") or "")
        if asked and self.server.habits.ranges:
            first, last = int(asked[1]), int(asked[2] or len(content) - 1)
            if first >= len(content):
                return self._answer(416, None, {"Content-Range": f"bytes */{len(content)}"})
            status, part = 206, content[first : last + 1]
            headers = {**headers, "Content-Range": f"bytes {first}-{last}/{len(content)}"}
        self.send_response(status)
        for name, value in {**headers, "Accept-Ranges": "bytes", "Content-Length": str(len(part))}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command == "GET":
            cut = self.fault is not None
            part = part[: self.fault.after] if self.fault else part
            self.asked.sent = len(part)
            self.wfile.write(part)
            self.wfile.flush()
            if cut:
                self._cut()
        return None

    # -- writing

    def _branch(self, repository: Repository, name: str) -> None:
        if name == "main" or name in repository.refs:
            return self._answer(409, {"error": "Reference already exists"})
        repository.refs[name] = repository.commits[-1].id
        return self._answer(201, {})

    def _preupload(self, repository: Repository, revision: str) -> None:
        commit = repository.at(revision)
        if commit is None:
            return self._answer(404, {"error": "Invalid rev id"}, {"X-Error-Code": "RevisionNotFound"})
        answers = []
        for file in json.loads(self.content)["files"]:
            path, there = file["path"], commit.files.get(file["path"])
            lfs = self.server.habits.by_lfs(path, file["size"])
            answer = {"path": path, "uploadMode": "lfs" if lfs else "regular", "shouldIgnore": False}
            if there is not None and self.server.habits.tells_oids:
                answer["oid"] = sha256(there) if lfs else oid(there)
            answers.append(answer)
        return self._answer(200, {"files": answers})

    def _batch(self, repository: Repository) -> None:
        objects = []
        for item in json.loads(self.content)["objects"]:
            if item["oid"] not in self.server.objects:
                item["actions"] = {
                    "upload": {"href": f"{self.server.url}/lfs/upload/{item['oid']}"},
                    "verify": {"href": f"{self.server.url}/lfs/verify/{item['oid']}"},
                }
            objects.append(item)
        self._answer(200, {"transfer": "basic", "objects": objects})

    def _lfs_object(self) -> None:
        _, _, verb, name = self.route.split("/")
        if verb == "upload":
            if sha256(self.content) != name:
                return self._answer(400, {"error": "sha256 mismatch"})
            self.server.objects[name] = self.content
            return self._answer(200, None)
        there = self.server.objects.get(name)
        whole = there is not None and len(there) == json.loads(self.content)["size"]
        return self._answer(200 if whole else 404, {})

    def _commit(self, repository: Repository, branch: str) -> None:
        for act in self.server.before_commit[:1]:
            self.server.before_commit.pop(0)
            act()
        with self.server.lock:
            self._commit_now(repository, branch)

    def _commit_now(self, repository: Repository, branch: str) -> None:
        lines = [json.loads(line) for line in self.content.splitlines()]
        header = lines[0]["value"]
        head = repository.at(branch)
        if head is None:
            return self._answer(404, {"error": "Invalid rev id"}, {"X-Error-Code": "RevisionNotFound"})
        if header.get("parentCommit") not in (None, head.id):
            conflict = self.server.habits.conflict
            return self._answer(
                conflict, {"error": "A commit has happened since. Please refresh and try again."}
            )
        files: dict[str, bytes | None] = {}
        for line in lines[1:]:
            value = line["value"]
            if line["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                if value["oid"] not in self.server.objects:
                    return self._answer(400, {"error": "LFS pointer to an object that does not exist"})
                files[value["path"]] = self.server.objects[value["oid"]]
            else:
                files[value["path"]] = None
        if branch == "main":
            made = repository.commit(files, header["summary"])
        else:
            made = repository.commit_to(branch, files, header["summary"])
        address = f"{self.server.url}/{repository.name}/commit/{made.id}"
        return self._answer(200, {"success": True, "commitOid": made.id, "commitUrl": address})

    def _answer(self, status: int, value: Any, headers: dict[str, str] | None = None) -> None:
        packed = value if isinstance(value, bytes) else json.dumps(value).encode()
        body = b"" if value is None or self.command == "HEAD" else packed
        self.send_response(status)
        for name, text in {"Content-Type": "application/json", **(headers or {})}.items():
            self.send_header(name, text)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.fault and not self.fault.status:
            self.wfile.write(body[: self.fault.after])
            self.wfile.flush()
            return self._cut()
        self.wfile.write(body)
        return None


@contextmanager
def serve() -> Iterator[Hub]:
    hub = Hub()
    thread = threading.Thread(target=hub.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        hub.shutdown()
        hub.server_close()
        thread.join(10)


def connect(monkeypatch: Any, hub: Hub, cache: Any, token: str | None) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "ENDPOINT", hub.url)
    template = hub.url + "/{repo_id}/resolve/{revision}/{filename}"
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(cache))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
    monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(cache) + "-no-token")
    monkeypatch.setenv("HF_HUB_DISABLE_PROGRESS_BARS", "1")
    if token:
        monkeypatch.setenv("HF_TOKEN", token)
    else:
        monkeypatch.delenv("HF_TOKEN", raising=False)
    sleep = time.sleep
    monkeypatch.setattr(time, "sleep", lambda seconds: (hub.waits.append(seconds), sleep(0.001)))
