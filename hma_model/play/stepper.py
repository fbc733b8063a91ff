"""Step all sessions that are due together, in one thread that alone touches the model and the simulators.

    stepper = Stepper(dict.fromkeys(robots, world), robots)
    stepper.start()
    session = stepper.call(lambda: stepper.open("mover_04", 0)).result()
    stepper.call(lambda: stepper.attach(session.name, viewer))

Every session has its own clock. Sessions of one model that are due at the same time, with the same sampling,
share one pass.
"""

import logging
import queue
import secrets
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from typing import Any

from hma_data.arrays import Float32s
from hma_data.errors import HMAError, UsageError
from hma_data.storage.kinds import one_line
from hma_model.generation.unmask import Decoding
from hma_model.play.session import Session, Viewer
from hma_model.worlds.scenes import Drivable
from hma_model.worlds.world import World

MAX_SESSIONS, IDLE_S = 8, 300.0
SLEEP_S = 1.0  # longest sleep between looks at idle sessions
_log = logging.getLogger(__name__)


class Stepper:
    """The thread and its sessions.

    Args:
        worlds: of the models, by the keys of robots; nobody else may use them.
        robots: those that can be driven, by key.
        orders: those in which the model can decode a frame.
        most: sessions at a time.
        idle_s: seconds after which a session in which nobody does anything is paused, or closed if nobody
            watches it.
    """

    def __init__(
        self,
        worlds: Mapping[str, World],
        robots: Mapping[str, Drivable],
        *,
        orders: Sequence[str] = ("random", "confidence"),
        most: int = MAX_SESSIONS,
        idle_s: float = IDLE_S,
    ) -> None:
        self.robots = robots
        self.orders = orders
        self.most = most
        self.idle_s = idle_s
        self._worlds = {key: (world, world.decoding) for key, world in worlds.items()}
        self.sessions: dict[str, Session] = {}
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="stepper", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread after the step that it is in."""
        self._jobs.put(None)
        self._thread.join()

    def call[T](self, function: Callable[[], T]) -> Future[T]:
        """Run a function in the thread, between two steps."""
        future: Future[T] = Future()

        def job() -> None:
            if not future.set_running_or_notify_cancel():
                return  # its page has left
            try:
                future.set_result(function())
            except Exception as fault:
                if not isinstance(fault, HMAError):
                    _log.exception("a call failed")
                future.set_exception(fault)

        self._jobs.put(job)
        return future

    # -- in the thread

    def open(self, key: str, number: int, viewer: Viewer | None = None) -> Session:
        """Open a session of a robot in a scene; it is paused.

        Args:
            viewer: watches it, in the place of the session that it watched, which ends.

        Raises:
            UsageError: there is no such robot, or there are too many sessions.
        """
        robot = self.robots.get(key)
        if robot is None:
            raise UsageError("robot", f"there is no {key[:40]!r}", f"known: {', '.join(self.robots)}")
        before = self.watched(viewer)
        if len(self.sessions) - (before is not None) >= self.most:
            now = time.monotonic()
            left = [one for one in self.sessions.values() if one.viewer is None or self._idle(one, now)]
            if not left:
                fault = f"all {self.most} sessions are in use"
                raise UsageError("sessions", fault, "close another page, or try again in a few minutes")
            said = "Closed after a while without input: another page needed the session."
            self.close(min(left, key=lambda one: (one.viewer is not None, one.touched)).name, said)
        scene = robot.scene(number)  # if there is none, the session before stays
        if before:
            self.close(before.name)
        session = Session(secrets.token_urlsafe(18), robot, number, scene, *self._worlds[key])
        session.viewer = viewer
        self.sessions[session.name] = session
        return session

    def attach(self, name: str, viewer: Viewer) -> Session:
        """Let a viewer watch a session, in the place of any other.

        Raises:
            UsageError: there is no such session, or no longer.
        """
        session = self.sessions.get(name)
        if session is None:
            raise UsageError("session", "has ended", "open a new one")
        if session.viewer is not None and session.viewer is not viewer:
            session.viewer.tell({"kind": "closed", "text": "This robot is now driven from another page."})
        self.detach(viewer)
        session.viewer = viewer
        session.touched = time.monotonic()
        return session

    def watched(self, viewer: Viewer | None) -> Session | None:
        """Return the session that a viewer watches."""
        return next((one for one in self.sessions.values() if viewer and one.viewer is viewer), None)

    def detach(self, viewer: Viewer) -> None:
        """Let the session stand still that a viewer watched."""
        if session := self.watched(viewer):
            session.viewer = None

    def close(self, name: str, reason: str = "") -> None:
        """Close a session, and tell its viewer why."""
        session = self.sessions.pop(name)
        session.world.close(session.row)
        if session.viewer and reason:
            session.viewer.tell({"kind": "closed", "text": reason})

    def _idle(self, session: Session, now: float) -> bool:
        return now - session.touched > self.idle_s

    def _run(self) -> None:
        while True:
            wait = self.step()
            try:
                job = self._jobs.get(timeout=wait)
                while job is not None:
                    job()
                    job = self._jobs.get_nowait()
                return
            except queue.Empty:
                continue

    def step(self) -> float:
        """Step the sessions that are due, and return the seconds until the next one is."""
        now = time.monotonic()
        for session in list(self.sessions.values()):
            if not self._idle(session, now):
                continue
            if session.viewer is None:
                self.close(session.name)
            elif not session.paused:
                session.paused = True
                session.viewer.tell(session.status())
                text = f"Paused after {self.idle_s / 60:.0f} minutes without input."
                session.viewer.tell({"kind": "error", "text": text})
        due = [session for session in self.sessions.values() if session.ready(now)]
        together: dict[tuple[int, Decoding], list[Session]] = {}
        for session in due:
            together.setdefault((id(session.world), session.sampling), []).append(session)
        for group in together.values():
            self._step_together(group)
        if due:
            return 0.0  # look at what came in meanwhile
        waiting = [s.due - now for s in self.sessions.values() if s.viewer and (s.steps or not s.paused)]
        return min([SLEEP_S, *(wait for wait in waiting if wait > 0)])

    def _step_together(self, sessions: list[Session]) -> None:
        world, sampling = sessions[0].world, sessions[0].sampling
        world.decoding = replace(sampling, measure=any(session.meter is not None for session in sessions))
        begun = time.monotonic()
        chunks: dict[int, Float32s] = {}
        rows: dict[int, Session] = {}
        for session in sessions:
            chunk = self._guarded(session, session.next_chunk)
            if chunk is not None:
                chunks[session.row] = chunk
                rows[session.row] = session
            elif session.name in self.sessions and session.viewer:
                session.viewer.tell(session.status())  # its recording has ended
        if not chunks:
            return
        try:
            images = world.step(chunks)
        except Exception as fault:
            _log.exception("a step of the model failed")
            for session in rows.values():
                self.close(session.name, f"The model failed: {_line(fault)}")
            return
        now = time.monotonic()
        for row, session in rows.items():
            self._guarded(session, partial(session.take, images[row], now, now - begun))

    def _guarded(self, session: Session, function: Callable[[], Any]) -> Any:
        """Call a function of a session; if it fails, close that session and no other."""
        try:
            return function()
        except Exception as fault:
            _log.exception("session of %s failed", session.robot.key)
            self.close(session.name, f"The simulator failed: {_line(fault)}")
            return None


def _line(fault: Exception) -> str:
    return one_line(fault if isinstance(fault, HMAError) else f"{type(fault).__name__}: {fault}", 300)
