"""Define the verb `hma play`: a page to drive robots in."""

import os
import secrets
import socket
import sys
import webbrowser
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import quote

from typer import Argument, Option

from hma_data.console import say
from hma_data.errors import UsageError
from hma_model.cli.options import Compile, Device, Precision, device_name, embedded_robots, require_checkpoint

if TYPE_CHECKING:
    from hma_data.shards.reader import ShardSet
    from hma_model.checkpoint.folder import Checkpoint


def play(
    checkpoint: Annotated[
        str,
        Argument(
            help="A checkpoint, a run's folder, or a hub repo (org/name[@revision]); default: the bundled "
            "model."
        ),
    ] = "embedded",
    data: Annotated[
        list[Path] | None, Argument(help="Shard sets whose held-out episodes are offered as scenes.")
    ] = None,
    prompt: Annotated[
        list[Path] | None, Option(help="Initial image; repeat it for several frames in order.")
    ] = None,
    embodiment: Annotated[
        str | None,
        Option(
            "-e", "--embodiment", help="Robot that the page selects first.", autocompletion=embedded_robots
        ),
    ] = None,
    port: Annotated[int, Option(min=0, max=65535, help="Port; 0 picks a free one.")] = 0,
    host: Annotated[
        str, Option(help="Address to listen on; all but loopback require a token.")
    ] = "127.0.0.1",
    token: Annotated[str | None, Option(help="Access token; default: generated if required.")] = None,
    device: Device = "auto",
    precision: Precision = "float32",
    compile: Compile = False,
    browser: Annotated[bool, Option("--browser/--no-browser", help="Open the page in the browser.")] = True,
) -> None:
    """Drive robots in a world model in the browser, side by side with their simulators.

    Example: hma play
    """
    import asyncio

    from hma_data.shards.reader import ShardSet
    from hma_data.tokenizers.base import reopened
    from hma_model.checkpoint.folder import BUNDLED, EMBEDDED_NAME, Checkpoint
    from hma_model.hub.publish import located
    from hma_model.worlds.images import read_image
    from hma_model.worlds.scenes import drivable, opening, trained_on

    # what is wrong with it, the data or the images is said before torch is imported
    sets, images = list(map(ShardSet, data or ())), list(map(read_image, prompt or ()))
    require_checkpoint(checkpoint)
    opened, device = located(checkpoint)[0], device_name(device)
    sets = sets or trained_on(opened)
    every = [opened]
    if opened.bundled and checkpoint == EMBEDDED_NAME:
        every = [Checkpoint.open(part) for part in BUNDLED.values()]
    tokenizers = [cache(partial(reopened, part.config.tokenizer, device)) for part in every]
    parted = _by_checkpoint(sets, every)
    driven = [drivable(*part, images) for part in zip(every, parted, tokenizers, strict=True)]
    robots = {key: robot for part in driven for key, robot in part.items()}
    # of networks with the same robot the last one drives it
    driven = [{key: one for key, one in part.items() if robots[key] is one} for part in driven]
    first = opening(robots, embodiment, "images" if images else "recordings" if sets else None)
    if len(opened.embodiments) > 1 and images and embodiment is None:
        say("every robot can start from the image; -e ROBOT selects yours", err=True)
    from hma_model.play.server import LOOPBACK, Part, serve

    listener = _listen(host, port)
    name = "the bundled model" if opened.bundled else checkpoint
    token = token or (None if host in LOOPBACK else secrets.token_urlsafe(18))
    shown = socket.gethostname() if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    query = f"?token={quote(token, safe='')}" if token else ""
    address = f"http://{shown}:{listener.getsockname()[1]}/{query}"

    def ready() -> None:
        say(f"drive at {address} (Ctrl-C ends)", flush=True)
        if browser and has_display():
            webbrowser.open(address)

    settings: dict[str, Any] = {"device": device, "precision": precision, "compile": compile, "first": first}
    try:
        chosen = zip(every, tokenizers, driven, strict=True)
        parts = [Part(one, made(), own) for one, made, own in chosen if own]
        asyncio.run(serve(parts, name, listener, host, token, ready, **settings))
    except KeyboardInterrupt:
        print("stopped; unsaved sessions are lost")


def _by_checkpoint(sets: "list[ShardSet]", every: "list[Checkpoint]") -> "list[list[ShardSet]]":
    """Return for each checkpoint the shard sets of its robots; the first has those of unknown robots too.

    Of several with a robot, the one of the shards' tokenizer has them.
    """
    parts: list[list[ShardSet]] = [[] for _ in every]
    for shards in sets:
        known = [number for number, one in enumerate(every) if shards.embodiment.id in one.embodiments]
        fit = [number for number in known if every[number].config.tokenizer == shards.spec.to_json()]
        parts[(fit or known or [0])[-1]].append(shards)
    return parts


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as fault:
        raise UsageError(
            f"{host}:{port}", f"the server cannot listen there: {fault}", "choose another --host or --port"
        ) from fault


def has_display() -> bool:
    """Check whether there is a screen to open a browser on."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
