"""A Hub on loopback for tests: datasets of a folder, by the few requests that downloading makes."""

import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit


class HubServer(ThreadingHTTPServer):
    """Datasets by name, each with its revisions.

    Attributes:
        datasets: name -> revision (branch, tag or commit) -> commit.
        folders: commit -> where its files are.
        served: paths of files whose bytes were sent, in order.
    """

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.datasets: dict[str, dict[str, str]] = {}
        self.folders: dict[str, Path] = {}
        self.served: list[str] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    def add(self, name: str, revision: str, folder: Path) -> str:
        """The commit under which a revision of a dataset is now found."""
        commit = hashlib.sha1(f"{name} {revision} {folder}".encode()).hexdigest()
        self.datasets.setdefault(name, {}).update({revision: commit, commit: commit})
        self.folders[commit] = folder
        return commit


class _Handler(BaseHTTPRequestHandler):
    server: HubServer

    def log_message(self, *arguments: object) -> None:
        pass

    def do_HEAD(self) -> None:
        self._answer(send=False)

    def do_GET(self) -> None:
        self._answer(send=True)

    def _answer(self, send: bool) -> None:
        parts = unquote(urlsplit(self.path).path).strip("/").split("/")
        api = parts[:1] == ["api"]
        parts = parts[1:] if api else parts
        name, verb, revision = "/".join(parts[1:3]), *(parts[3:5] if len(parts) > 4 else ("", "main"))
        known = self.server.datasets.get(name)
        if parts[0] != "datasets" or known is None:
            self._refuse("RepoNotFound")
        elif revision not in known:
            self._refuse("RevisionNotFound")
        elif api and verb == "revision":
            self._json({"id": name, "sha": known[revision], "siblings": self._files(known[revision])})
        elif api and verb == "tree":
            files = [{"type": "file", "path": item["rfilename"], "size": 1, "oid": "0" * 40}
                     for item in self._files(known[revision])]  # fmt: skip
            self._json(files)
        else:
            self._file(known[revision], "/".join(parts[5:]), send)

    def _files(self, commit: str) -> list[dict[str, str]]:
        folder = self.server.folders[commit]
        found = sorted(path for path in folder.rglob("*") if path.is_file())
        return [{"rfilename": path.relative_to(folder).as_posix()} for path in found]

    def _file(self, commit: str, relative: str, send: bool) -> None:
        path = self.server.folders[commit] / relative
        if not path.is_file():
            self._refuse("EntryNotFound", {"X-Repo-Commit": commit})
            return
        content = path.read_bytes()
        etag = hashlib.sha1(content).hexdigest()
        self._reply(
            200, {"X-Repo-Commit": commit, "ETag": f'"{etag}"'}, content if send else b"", len(content)
        )
        if send:
            self.server.served.append(relative)

    def _json(self, value: object) -> None:
        self._reply(200, {"Content-Type": "application/json"}, json.dumps(value).encode())

    def _refuse(self, code: str, headers: dict[str, str] | None = None) -> None:
        self._reply(404, {"X-Error-Code": code, "X-Error-Message": code, **(headers or {})}, b"")

    def _reply(self, status: int, headers: dict[str, str], body: bytes, length: int | None = None) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body) if length is None else length))
        self.end_headers()
        self.wfile.write(body)


@contextmanager
def hub_server() -> Iterator[HubServer]:
    """A server that runs until the block ends."""
    server = HubServer()
    thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
