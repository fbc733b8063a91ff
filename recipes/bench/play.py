"""Measure what viewers of `hma play` get: frames a second, and how soon a command shows (`hma bench play`).

The server is the real one, in a process of its own. Each viewer is a websocket client that drives a session
of its own with a fixed stream of commands, as fast as the server goes or at the robot's rate, and says of
every frame that it has shown it. A new command is sent as soon as a frame shows the one before it. The
latency is the time from sending a command to receiving the first frame made under it.
"""

import asyncio
import json
import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hma_data.errors import HMAError, UsageError
from recipes.bench.harness import Bench
from recipes.bench.speed import check_settings, numbers_of

if TYPE_CHECKING:
    from websockets.asyncio.client import ClientConnection

WARMUP_S = 3.0  # before the measured seconds
MOST_WAIT_S = 60.0  # for a frame


def play(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a result for each number of viewers; raise UsageError for a wrong setting."""
    check_settings("play", {**settings, "viewers": None})
    counts = numbers_of("play", "viewers", settings, [1, 2, 4])
    if min(counts) < 1:
        raise UsageError("bench play", f"viewers={settings['viewers']} is not allowed", "give at least 1")
    command = [sys.executable, "-m", "hma_model.cli", "play", settings["checkpoint"], "--no-browser"]
    with _served([*command, *settings["options"].split()]) as (address, pid):
        return [asyncio.run(measure(address, pid, count, settings)) for count in counts]


async def measure(address: str, pid: int, count: int, settings: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of so many viewers at once."""
    viewers = [_Viewer(number, settings) for number in range(count)]
    begun, spent = time.monotonic(), _cpu_seconds(pid)
    await asyncio.gather(*(viewer.drive(address) for viewer in viewers))
    spent, lasted = _cpu_seconds(pid) - spent, time.monotonic() - begun
    frames = [len(viewer.received) for viewer in viewers]
    waits = np.concatenate([viewer.waits for viewer in viewers]) * 1e3
    rates = [number / settings["seconds"] for number in frames]
    return {
        "viewers": count,
        "robot": settings["robot"],
        "fast": settings["fast"],
        "frames_per_second": round(sum(rates), 1),
        "frames_per_second_of_a_viewer": round(min(rates), 1),
        "latency_p50_ms": round(float(np.percentile(waits, 50)), 1) if len(waits) else None,
        "latency_p95_ms": round(float(np.percentile(waits, 95)), 1) if len(waits) else None,
        "server_cores": round(spent / lasted, 2),
    }


class _Viewer:
    """A client of the page's websocket.

    Attributes:
        received: times at which frames came.
        waits: seconds from sending commands to receiving a frame made under them.
    """

    def __init__(self, number: int, settings: dict[str, Any]) -> None:
        self.number, self.settings = number, settings
        self.received: list[float] = []
        self.waits: list[float] = []

    async def drive(self, address: str) -> None:
        """Drive for the warm-up and the measured seconds."""
        from websockets.asyncio.client import connect

        url = f"ws{address.removeprefix('http')}drive"
        async with connect(url, max_size=None, compression=None) as socket:
            await self._send(socket, "open", robot=self.settings["robot"], scene=self.number)
            about = await self._opened(socket)
            await self._send(socket, "fast", on=self.settings["fast"])
            await self._send(socket, "run", on=True)
            begin = time.monotonic() + WARMUP_S
            end, count, sent = begin + self.settings["seconds"], 0, time.monotonic()
            while time.monotonic() < end:
                header = _header(await asyncio.wait_for(socket.recv(), MOST_WAIT_S))
                now = time.monotonic()
                if header is None:
                    continue
                await self._send(socket, "seen", serial=header["serial"])
                if begin <= now < end:
                    self.received.append(now)
                if header.get("input", count) < count:
                    continue  # made before the newest command came
                if count and begin <= sent and now < end:
                    self.waits.append(now - sent)
                count, sent = count + 1, time.monotonic()
                await self._send(socket, "drive", action=_command(about, count), input=count)

    async def _opened(self, socket: "ClientConnection") -> dict[str, Any]:
        """Return the dimensions of the robot, once its session is open."""
        while True:
            data = await asyncio.wait_for(socket.recv(), MOST_WAIT_S)
            message = {} if isinstance(data, bytes) else json.loads(data)
            if message.get("kind") == "opened":
                return dict(message["robot"])
            if message.get("kind") == "error":
                raise HMAError("bench play", message["text"], "give another robot=ID")

    async def _send(self, socket: "ClientConnection", do: str, **values: Any) -> None:
        await socket.send(json.dumps({"do": do, **values}))


def _command(robot: dict[str, Any], count: int) -> list[float]:
    """Return the command of that number: each value now below, now above the middle of its range."""
    shares = [0.4 if (count + i) % 2 else 0.6 for i in range(len(robot["dimensions"]))]
    ends = [(dim["low"], dim["high"]) for dim in robot["dimensions"]]
    return [low + share * (high - low) for (low, high), share in zip(ends, shares)]


def _header(data: str | bytes) -> dict[str, Any] | None:
    """Return the header of a frame; None for another message."""
    if isinstance(data, str):
        message = json.loads(data)
        if message["kind"] in ("closed", "gone", "error"):
            raise HMAError("bench play", message["text"])
        return None
    (size,) = struct.unpack(">H", data[:2])
    return dict(json.loads(data[2 : 2 + size]))


@contextmanager
def _served(command: list[str]) -> Iterator[tuple[str, int]]:
    """Run a server in the block; give its address and process."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            line = server.stdout.readline()
            if not line.startswith("drive at "):
                raise HMAError("bench play", "the server did not start", "see its message above")
            yield line.split()[2], server.pid
        finally:
            server.send_signal(signal.SIGINT)
            try:
                server.wait(timeout=10)
            except subprocess.TimeoutExpired:
                server.kill()


def _cpu_seconds(pid: int) -> float:
    """Return the processor time of a process so far; nan without Linux's /proc."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    except OSError:
        return float("nan")
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


BENCH = Bench(
    "frames per second and latency of hma play, by number of viewers",
    {
        "checkpoint": "embedded",
        "robot": "rails_03",
        "viewers": None,  # None: 1,2,4
        "seconds": 20.0,  # measured, after a warm-up, for each number of viewers
        "fast": True,  # as fast as possible; false: at the robot's rate
        "options": "",  # of hma play, e.g. --precision bf16
    },
    play,
)
