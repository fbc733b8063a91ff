"""An S3 server on loopback, and a proxy before it that loses, cuts or refuses requests."""

import http.client
import socket
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

KEYS = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_DEFAULT_REGION": "us-east-1"}


class Proxy(ThreadingHTTPServer):
    """Hands requests on to the server, and lets some go wrong.

    Attributes:
        trouble: called with (method, path, number); a status, "cut" (half an answer), "drop" (not handed on),
            "lost" (handed on, not answered) or None.
        log: (method, path, range) of every request.
    """

    daemon_threads = True

    def __init__(self, port: int) -> None:
        super().__init__(("127.0.0.1", 0), _Hand)
        self.port, self.lock = port, threading.Lock()
        self.trouble = lambda method, path, number: None
        self.log: list[tuple[str, str, str | None]] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    def handle_error(self, request, client_address) -> None:
        pass  # connections are cut on purpose


class _Hand(BaseHTTPRequestHandler):
    server: Proxy
    protocol_version = "HTTP/1.1"

    def setup(self) -> None:
        super().setup()
        self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def _any(self) -> None:
        with self.server.lock:
            self.server.log.append((self.command, self.path, self.headers.get("Range")))
            what = self.server.trouble(self.command, self.path, len(self.server.log))
        if what == "drop":
            self.close_connection = True
            return
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if isinstance(what, int):
            said = b"<Error><Code>SlowDown</Code><Message>busy</Message></Error>" if what == 503 else b""
            self._answer(what, [], said)
            return
        asked = http.client.HTTPConnection("127.0.0.1", self.server.port)
        asked.request(self.command, self.path, body, dict(self.headers))
        answer = asked.getresponse()
        data = answer.read()
        asked.close()
        if what == "lost":
            self.close_connection = True
            return
        self._answer(answer.status, answer.getheaders(), data, cut=what == "cut")

    def _answer(self, status: int, headers: list[tuple[str, str]], data: bytes, cut: bool = False) -> None:
        self.send_response_only(status)
        stated = {name.lower() for name, _ in headers}
        for name, value in headers:
            if name.lower() not in ("connection", "transfer-encoding"):
                self.send_header(name, value)
        if "content-length" not in stated:
            self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data[: len(data) // 2] if cut else data)
        if cut:
            self.close_connection = True

    do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = _any

    def log_message(self, *args: object) -> None:
        pass
