"""Measure the frames a second of an exported page, driven in headless Chromium (`hma bench page`).

The page is served from this machine, and makes frames as fast as it can on WebAssembly. `shown` is what the
page's own counter says at the end, over its last four seconds.
"""

import functools
import http.server
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hma_data.errors import MissingDependencyError, UsageError
from recipes.bench.harness import Bench

FLAGS = ("--no-sandbox", "--disable-gpu", "--disable-quic")
WARMUP = 30  # frames
COUNT = "window.shown = []; document.addEventListener('frame', () => shown.push(performance.now()));"


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a result; raise UsageError for a folder that hma export did not write."""
    folder, frames = Path(settings["export"]), settings["frames"]
    if not (folder / "manifest.json").is_file():
        fault = f"export={settings['export']} is no folder of hma export"
        raise UsageError(
            "bench page", fault, "hma export CHECKPOINT --out DIR --with-runtime PACKAGE, and give DIR"
        )
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as fault:
        remedy = "pip install playwright && playwright install chromium"
        raise MissingDependencyError("bench page", "playwright is not installed", remedy) from fault
    with _served(folder) as address, sync_playwright() as playwright:
        found = shutil.which("chromium") or playwright.chromium.executable_path
        browser = playwright.chromium.launch(executable_path=found, args=list(FLAGS))
        page = browser.new_page()
        page.set_default_timeout(300_000)
        page.add_init_script(COUNT)
        page.goto(f"{address}?backend=wasm&robot={settings['robot']}")
        page.wait_for_selector("body[data-backend]")
        backend = page.text_content("#backend")
        page.check("#fast", force=True)
        page.click("#run")
        page.wait_for_function(f"shown.length > {WARMUP + frames}")
        counter = page.text_content("#fps")
        times = page.evaluate("shown")[WARMUP:][: frames + 1]
        browser.close()
    rate = 1000 * frames / (times[-1] - times[0])
    return [
        {
            "robot": settings["robot"],
            "backend": backend,
            "frames_per_second": round(rate, 1),
            "shown": counter,
        }
    ]


@contextmanager
def _served(folder: Path) -> Iterator[str]:
    """Serve a folder on loopback."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *arguments: Any) -> None:
            pass

    made = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=folder))
    threading.Thread(target=made.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{made.server_port}/"
    finally:
        made.shutdown()
        made.server_close()


BENCH = Bench(
    "frames a second of a page of hma export, in headless Chromium",
    {"export": "build/page", "robot": "rails_03", "frames": 200},
    run,
)
