"""Serve the page to drive robots in: one page, a websocket for each viewer, and downloads.

The server listens on loopback. Requests with another Host, and websockets of another Origin, are refused, so
that no foreign page can reach it (DNS rebinding). On any other address a token is needed.
"""

import asyncio
import contextlib
import ipaddress
import json
import secrets
import socket
import time
from collections import deque
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.resources import files
from typing import Any, NamedTuple
from urllib.parse import parse_qs, quote, urlsplit

import anyio
import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from hma_data.errors import HMAError, UsageError
from hma_data.tokenizers.base import Tokenizer
from hma_model.checkpoint import io as checkpoints
from hma_model.checkpoint.folder import Checkpoint
from hma_model.play import messages
from hma_model.play.holding import UNKNOWN, Holding, holdings
from hma_model.play.pads import describe, labels
from hma_model.play.save import FILE_KINDS, film, told_by
from hma_model.play.session import Frame, Session
from hma_model.play.stepper import Stepper
from hma_model.worlds.scenes import Drivable
from hma_model.worlds.world import World

LOOPBACK = ("127.0.0.1", "localhost", "::1")
FIRST_ROBOT = "pusht_fast"  # the robot that a page opens with: its T stays whole, and it is easy to drive
PARTS = {"page.css": "text/css", "controls.js": "text/javascript"}  # that the page shares with exported pages
HEADERS = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}
MAX_VIEWERS = 32
MESSAGES_PER_S, MESSAGE_BURST = 200.0, 400.0  # messages of a viewer a second, and at once
SCENE_COST = 20.0  # messages that one counts as which begins a scene: all other sessions wait for it
FRAMES_AHEAD = 2  # frames that are sent before a page says that it has shown one
STALLED_S, SEND_S = 10.0, 20.0  # without a sign of reading: the session stands still; the viewer is dropped
_GONE = (WebSocketDisconnect, TimeoutError, OSError)  # of a viewer that has left, or reads nothing


class Guard:
    """Refuse requests with a foreign Host or Origin, or without the token."""

    def __init__(self, app: ASGIApp, host: str, token: str | None) -> None:
        self.app = app
        self.host = host
        self.token = token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] in ("http", "websocket") and (fault := self._fault(scope)):
            if scope["type"] == "websocket":
                await WebSocket(scope, receive, send).close(1008, fault)
            else:
                await PlainTextResponse(fault + "\n", 403)(scope, receive, send)
            return
        await self.app(scope, receive, send)

    def _fault(self, scope: Scope) -> str:
        headers = {name.decode().lower(): value.decode("latin-1") for name, value in scope["headers"]}
        host = headers.get("host", "")
        origin = headers.get("origin")
        try:
            name = urlsplit(f"//{host}").hostname or ""
            own = origin is None or urlsplit(origin).netloc == host
        except ValueError:
            return "refused: the host or the origin cannot be read"
        # An address cannot be rebound; of names, only this server's own are let in.
        own_name = name in (*LOOPBACK, self.host.lower())  # `name` is in lower case
        if not own_name and self.host not in LOOPBACK:
            own_name = name == socket.gethostname().lower()
            with contextlib.suppress(ValueError):
                own_name = bool(ipaddress.ip_address(name))
        if not own_name:
            return f"refused: the host {host[:80]!r} is not this server's"
        if not own:
            return f"refused: a page of {origin!r:.80} may not connect here"
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        if self.token and not secrets.compare_digest(given.encode(), self.token.encode()):
            return "refused: the token is missing or wrong; use the address that hma play printed"
        return ""


class Server:
    """The application of a stepper.

    Args:
        model: a name for the model, shown on the page.
        host: the address that it listens on.
        token: what every request must carry, or None.
        first: the key of the robot that a page opens with; None for the best known one.
        holdings: how long robots stay with the truth, by key.
    """

    def __init__(
        self,
        stepper: Stepper,
        model: str,
        host: str = LOOPBACK[0],
        token: str | None = None,
        first: str | None = None,
        holdings: Mapping[str, Holding] | None = None,
    ) -> None:
        self.stepper = stepper
        self.model = model
        self.first = first or FIRST_ROBOT
        self.holdings = holdings or {}
        self.viewers = 0
        self._page = files("hma_model.play").joinpath("page.html").read_text("utf-8")
        self._query = f"?token={quote(token, safe='')}" if token else ""
        self._saving = asyncio.Semaphore(1)
        routes = [
            Route("/", self.page),
            Route("/save", self.save),
            Route("/{name:str}", self.part),
            WebSocketRoute("/drive", self.drive),
        ]
        self.app = Guard(Starlette(routes=routes), host, token)

    async def page(self, request: Request) -> Response:
        """Return the page."""
        nonce = secrets.token_urlsafe(16)
        policy = (
            f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; connect-src 'self'; "
            "img-src data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        headers = HEADERS | {"Content-Security-Policy": policy, "Referrer-Policy": "no-referrer"}
        page = self._page.replace("NONCE", nonce).replace("QUERY", self._query)
        return HTMLResponse(page, headers=headers)

    async def part(self, request: Request) -> Response:
        """Return the style or the controls of the page."""
        name = request.path_params["name"]
        if name not in PARTS:
            return PlainTextResponse("there is no such file\n", 404)
        content = files("hma_model.play").joinpath(name).read_text("utf-8")
        return Response(content, media_type=PARTS[name], headers=HEADERS)

    async def save(self, request: Request) -> Response:
        """Return what was driven in a session as a file."""
        kind = request.query_params.get("kind", "")
        session = self.stepper.sessions.get(request.query_params.get("session", ""))
        if session is None or kind not in FILE_KINDS:
            return PlainTextResponse("there is no such session, or no such kind of file\n", 404)
        frames = await asyncio.wrap_future(self.stepper.call(session.film))
        if len(frames) < 2:
            return PlainTextResponse("nothing was driven yet\n", 409)
        tell = told_by(session, kind)
        if self._saving.locked():
            tell("waiting for another file", 0, len(frames))
        async with self._saving:
            try:
                data = await asyncio.to_thread(film, kind, session.robot, frames, tell)
            except HMAError as fault:
                return PlainTextResponse(f"{fault}\n", 500)
        media, suffix = FILE_KINDS[kind]
        file = f"{session.robot.embodiment.id}-scene-{session.number}{suffix}"
        headers = HEADERS | {"Content-Disposition": f'attachment; filename="{file}"'}
        return Response(data, media_type=media, headers=headers)

    async def drive(self, websocket: WebSocket) -> None:
        """Serve one viewer."""
        await websocket.accept()
        if self.viewers >= MAX_VIEWERS:
            await websocket.close(1013, "too many pages are open; close one")
            return
        self.viewers += 1
        connection = Connection(self, websocket)
        try:
            async with anyio.create_task_group() as tasks:

                async def run(work: Callable[[], Awaitable[None]]) -> None:
                    with contextlib.suppress(*_GONE):
                        await work()
                    tasks.cancel_scope.cancel()  # one has ended, so the other does

                tasks.start_soon(run, connection.send)
                tasks.start_soon(run, connection.receive)
        finally:
            self.viewers -= 1
            connection.leave()
        if reason := connection.fault.encode()[:120].decode(errors="ignore"):
            with contextlib.suppress(*_GONE), anyio.fail_after(SEND_S):
                await websocket.close(1008, reason)


class Connection:
    """One websocket, and the session that it drives: what the page asks for, and what is sent to it.

    `show` and `tell` are called in the stepper's thread. Of frames only the latest waits, so that a page that
    reads slowly sees fewer.

    Attributes:
        fault: why the page is no longer listened to; "" if it has left.
    """

    def __init__(self, server: Server, websocket: WebSocket) -> None:
        self.stepper = server.stepper
        self.websocket = websocket
        self.session: Session | None = None
        self.fault = ""
        self._credit = MESSAGE_BURST
        self._filled = time.monotonic()
        self._loop = asyncio.get_running_loop()
        self._wake = asyncio.Event()
        self._messages: deque[dict[str, Any]] = deque(maxlen=100)
        self._latest: tuple[Frame, dict[str, Any]] | None = None
        self._sent = self._shown = 0  # serial numbers of frames
        self._heard = time.monotonic()
        held = {key: server.holdings.get(key, UNKNOWN) for key in self.stepper.robots}
        robots = [
            describe(self.stepper.robots[key]) | {"holds": known.words, "follows": known.follows is not False}
            for key, known in sorted(held.items(), key=lambda pair: pair[1].rank)
        ]
        hello = {"model": server.model, "robots": robots, "first": server.first}
        self.tell({"kind": "hello", "orders": list(self.stepper.orders), **hello})

    # -- to the page

    @property
    def behind(self) -> int:
        return self._sent - self._shown + (self._latest is not None)

    @property
    def stalled(self) -> bool:
        return self.behind > 0 and time.monotonic() - self._heard > STALLED_S

    def show(self, frame: Frame, facts: dict[str, Any]) -> None:
        self._latest = (frame, facts)
        self._notify()

    def tell(self, message: dict[str, Any]) -> None:
        self._messages.append(message)
        self._notify()

    def _notify(self) -> None:
        with contextlib.suppress(RuntimeError):  # the server has stopped
            self._loop.call_soon_threadsafe(self._wake.set)

    async def send(self) -> None:
        """Send what waits, until the viewer has gone or reads nothing any more."""
        while True:
            await self._wake.wait()
            self._wake.clear()
            while self._messages:
                with anyio.fail_after(SEND_S):
                    await self.websocket.send_text(json.dumps(self._messages.popleft()))
            # The socket buffers megabytes; the page's word on what it has shown keeps frames from piling up.
            if self._latest and self._sent - self._shown < FRAMES_AHEAD:
                (frame, facts) = self._latest
                self._latest = None
                if not self._sent - self._shown:
                    self._heard = time.monotonic()  # it had nothing to read before
                self._sent += 1
                with anyio.fail_after(SEND_S):
                    await self.websocket.send_bytes(messages.frame_bytes(frame, facts, self._sent))

    # -- from the page

    async def receive(self) -> None:
        """Take messages until the page leaves, or sends one that is not allowed."""
        while True:
            received = await self.websocket.receive()
            if received["type"] == "websocket.disconnect":
                return
            try:
                if received.get("text") is None:
                    raise UsageError("message", "is bytes, not JSON")
                message = messages.parse(received["text"])
                self._charge(message)
                await self._do(message)
            except UsageError as problem:
                self.fault = str(problem)
                return

    def _charge(self, message: messages.Message) -> None:
        """Take a message off the credit, which time restores; raise UsageError if none is left."""
        begins = message.do in ("open", "scene", "sync")
        now = time.monotonic()
        restored = self._credit + MESSAGES_PER_S * (now - self._filled)
        self._credit = min(MESSAGE_BURST, restored) - (SCENE_COST if begins else 1)
        self._filled = now
        if self._credit < 0:
            raise UsageError("messages", "are sent too fast")

    def leave(self) -> None:
        """Let the session stand still, also one that is opened just now."""
        self.stepper.call(lambda: self.stepper.detach(self))

    async def _do(self, message: messages.Message) -> None:
        if isinstance(message, messages.SeenMessage):
            self._shown = max(self._shown, min(message.serial, self._sent))
            self._heard = time.monotonic()
            self._wake.set()
            self.stepper.call(lambda: None)  # it looks for sessions that are due
        elif isinstance(message, messages.OpenMessage | messages.ResumeMessage):
            await self._enter(message)
        elif self.session is None:
            raise UsageError("message", "open a session first")
        else:
            self.stepper.call(partial(self._change, self.session, message))

    async def _enter(self, message: messages.OpenMessage | messages.ResumeMessage) -> None:
        def enter() -> Session:
            if isinstance(message, messages.ResumeMessage):
                session = self.stepper.attach(message.session, self)
            else:
                session = self.stepper.open(message.robot, message.scene, self)
            self._show_all(session)
            return session

        try:
            self.session = await asyncio.wrap_future(self.stepper.call(enter))
        except HMAError as fault:
            kind = "gone" if isinstance(message, messages.ResumeMessage) else "error"
            self.tell({"kind": kind, "text": str(fault)})
        except Exception as fault:  # a bug of ours; the stepper has logged it
            text = f"stopped with {type(fault).__name__}: {fault}; the terminal has more"
            self.tell({"kind": "error", "text": text})

    def _show_all(self, session: Session) -> None:
        self.tell(session.opened())
        self.show(session.last, {})

    def _change(self, session: Session, message: messages.Message) -> None:
        """Do what a message says, in the stepper's thread."""
        if self.stepper.watched(self) is not session:
            return
        session.touched = time.monotonic()
        try:
            match message:
                case messages.DriveMessage():
                    self._hold(session, message)
                    return
                case messages.SceneMessage():
                    session.begin(message.number)
                    self._show_all(session)
                    return
                case messages.StepMessage(do="step"):
                    session.paused = True
                    session.steps = 1
                    session.due = session.touched
                case messages.StepMessage(do="sync"):
                    session.sync()
                    self.show(session.last, {})  # in the place of an older one that still waits
                case messages.SwitchMessage(do="run"):
                    session.paused = not message.on
                    session.due = session.touched
                    session.steps = 0
                case messages.SwitchMessage(do="fast"):
                    session.fast = message.on
                    session.due = session.touched
                case messages.SwitchMessage(do="replay"):
                    session.replays = message.on
                    session.ended = False
                case messages.SampleMessage(order=order):
                    if order not in (known := self.stepper.orders):
                        raise UsageError(
                            "order", f"this model has no {order!r}", f"known: {', '.join(known)}"
                        )
                    session.sample(replace(session.sampling, **message.model_dump(exclude={"do"})))
            self.tell(session.status())
        except HMAError as fault:
            self.tell({"kind": "error", "text": str(fault)})

    def _hold(self, session: Session, message: messages.DriveMessage) -> None:
        """Hold an action; the first one far outside the range that the model knows is told."""
        if len(message.action) != len(session.held):
            fault = f"has {len(message.action)} values, this robot takes {len(session.held)}"
            self.tell({"kind": "error", "text": f"action: {fault}"})
            return
        session.held = np.array(message.action, np.float32)
        session.input = message.input
        if session.warned:
            return
        beyond = []
        for dim, name, value in zip(
            session.robot.dimensions, labels(session.robot), message.action, strict=True
        ):
            middle = (dim.high + dim.low) / 2
            half = (dim.high - dim.low) / 2
            if abs(value - middle) > 1.05 * half:  # sliders and pads may end a little beyond
                beyond.append(f"{name} {dim.low:g} to {dim.high:g}")
        if beyond:
            session.warned = True
            known = f"the model knows only {', '.join(beyond)}; predictions beyond that are unreliable"
            self.tell({"kind": "error", "text": f"action: {known}. Shown only once"})


class Part(NamedTuple):
    """A checkpoint, its tokenizer, and those of its robots that can be driven, by key."""

    checkpoint: Checkpoint
    tokenizer: Tokenizer
    robots: Mapping[str, Drivable]


async def serve(
    parts: Sequence[Part],
    name: str,
    listener: socket.socket,
    host: str,
    token: str | None,
    ready: Callable[[], None],
    device: str = "cpu",
    first: str | None = None,
    **settings: Any,
) -> None:
    """Serve checkpoints until the process is interrupted.

    Args:
        parts: one per checkpoint; no robot is in two.
        name: for the model, shown on the page.
        listener: a socket that listens.
        ready: called when the page can be opened.
        device: of the network.
        first: as of `Server`.
        settings: of `World`.

    Raises:
        CheckpointError: a checkpoint is damaged.
    """
    worlds: dict[str, World] = {}
    robots: dict[str, Drivable] = {}
    held: dict[str, Holding] = {}
    for part in parts:
        names = sorted({robot.embodiment.id for robot in part.robots.values()})
        world = World(checkpoints.load(part.checkpoint, names, device), part.tokenizer, **settings)
        worlds |= dict.fromkeys(part.robots, world)
        robots |= part.robots
        known = holdings(part.checkpoint)
        held |= {key: known[robot.embodiment.id] for key, robot in part.robots.items()}
    confidence = ("confidence",) if all(part.checkpoint.config.discrete for part in parts) else ()
    stepper = Stepper(worlds, robots, orders=("random", *confidence))
    stepper.start()
    try:
        await run(Server(stepper, name, host, token, first, held).app, listener, lambda server: ready())
    finally:
        stepper.stop()


async def run(app: ASGIApp, listener: socket.socket, ready: Callable[[uvicorn.Server], None]) -> None:
    """Serve an application at a socket that listens, until a signal or until `should_exit` is set."""
    settings = uvicorn.Config(
        app,
        log_level="warning",
        access_log=False,
        lifespan="off",
        ws="websockets-sansio",
        ws_max_size=messages.MAX_MESSAGE_BYTES,
        ws_per_message_deflate=False,
        timeout_graceful_shutdown=2,
    )
    server = uvicorn.Server(settings)
    serving = asyncio.create_task(server.serve(sockets=[listener]))
    while not server.started and not serving.done():
        await asyncio.sleep(0.02)
    ready(server)
    await serving
