"""Define the verb `hma play`: a page to drive robots in."""

import os
import secrets
import socket
import sys
import webbrowser
from functools import cache
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote

import typer

from hma_data.errors import UsageError


def play(
    checkpoint: Annotated[
        str, typer.Argument(help="A checkpoint, or a run's folder; by default the one that comes along.")
    ] = "embedded",
    data: Annotated[
        list[Path] | None, typer.Argument(help="Shard sets, whose held-out episodes give more scenes.")
    ] = None,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="0 takes a free one.")] = 0,
    host: Annotated[
        str, typer.Option("--host", help="Address to listen on; any but loopback needs a token.")
    ] = "127.0.0.1",
    token: Annotated[
        str | None, typer.Option("--token", help="What the address must carry; made up with --host.")
    ] = None,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")
    ] = True,
) -> None:
    """Drive robots in a world model, in the browser, beside their true simulators.

    Example: hma play
    """
    import asyncio

    from hma_data.shards.reader import ShardSet
    from hma_model.checkpoint.folder import Checkpoint
    from hma_model.simulate.scenes import drivable

    opened = Checkpoint.open(checkpoint)  # what is wrong with it or the data is said before torch is imported

    @cache
    def tokenizer() -> Any:
        from hma_data.tokenizers.base import get_tokenizer

        return get_tokenizer(opened.config.tokenizer["name"])

    robots = drivable(opened, map(ShardSet, data or ()), tokenizer)
    from hma_model.simulate.server import LOOPBACK, serve

    listener = _listen(host, port)
    if token is None and host not in LOOPBACK:
        token = secrets.token_urlsafe(18)
    shown = socket.gethostname() if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    query = f"?token={quote(token, safe='')}" if token else ""
    address = f"http://{shown}:{listener.getsockname()[1]}/{query}"

    def ready() -> None:
        print(f"drive at {address} (Ctrl-C ends)", flush=True)
        if browser and _display():
            webbrowser.open(address)

    try:
        asyncio.run(serve(opened, robots, tokenizer(), listener, host, token, ready))
    except KeyboardInterrupt:
        print("stopped; what was not saved is lost")


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as fault:
        raise UsageError(
            f"{host}:{port}", f"cannot be listened on: {fault}", "choose another --host or --port"
        ) from fault


def _display() -> bool:
    """Check whether there is a screen to open a browser on."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
