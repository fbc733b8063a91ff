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
from typing import TYPE_CHECKING, Any

from hma_data.errors import HMAError, MissingDependencyError, UsageError
from hma_data.storage.files import read_json
from recipes.bench.harness import Bench

if TYPE_CHECKING:
    from playwright.sync_api import Browser

FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic"]
WARMUP = 30  # frames
PATIENCE_MS = 300_000
COUNT = "window.shown = []; document.addEventListener('frame', () => shown.push(performance.now()));"
FAULT = "#again"  # the button beside a fault


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a result.

    Raises:
        UsageError: the folder is not that of hma export, or has no such robot.
        MissingDependencyError: there is no playwright or no Chromium.
        HMAError: the page says a fault.
    """
    folder, robot = Path(settings["export"]), settings["robot"]
    try:
        from playwright.sync_api import Error, sync_playwright
    except ImportError as fault:
        remedy = "pip install playwright && playwright install chromium"
        raise MissingDependencyError("bench page", "playwright is not installed", remedy) from fault
    _require_robot(folder, robot)
    with served(folder) as server, sync_playwright() as playwright:
        found = shutil.which("chromium") or playwright.chromium.executable_path
        try:
            browser = playwright.chromium.launch(executable_path=found, args=FLAGS)
        except Error as fault:
            said, remedy = str(fault).splitlines()[0], "playwright install chromium"
            raise MissingDependencyError("bench page", f"Chromium does not start: {said}", remedy) from fault
        address = f"http://127.0.0.1:{server.server_port}/?backend=wasm&robot={robot}"
        return [{"robot": robot} | _measured(browser, address, settings["frames"])]


def _require_robot(folder: Path, robot: str) -> None:
    remedy = "hma export CHECKPOINT --out DIR --with-runtime PACKAGE, and give DIR"
    if not (folder / "manifest.json").is_file():
        raise UsageError("bench page", f"export={folder} is no folder of hma export", remedy)
    robots = [one["id"] for one in read_json(folder / "manifest.json").get("robots", [])]
    if robot not in robots:
        fault = f"robot={robot} is not in {folder}"
        raise UsageError("bench page", fault, f"give one of {', '.join(robots)}" if robots else remedy)


def _measured(browser: "Browser", address: str, frames: int) -> dict[str, Any]:
    page = browser.new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.add_init_script(COUNT)
    page.goto(address)
    page.wait_for_selector(f"body[data-backend], {FAULT}:visible")
    if page.is_visible(FAULT):
        raise HMAError("bench page", f"the page says: {page.text_content('#veil-text')}")
    page.check("#fast", force=True)
    page.click("#run")
    page.wait_for_function(f"shown.length > {WARMUP + frames}")
    counter, times = page.text_content("#fps"), page.evaluate("shown")
    rate = 1000 * frames / (times[WARMUP + frames] - times[WARMUP])
    backend = page.text_content("#backend")
    return {"backend": backend, "frames_per_second": round(rate, 1), "shown": counter}


@contextmanager
def served(folder: Path) -> Iterator[http.server.ThreadingHTTPServer]:
    """Serve a folder on loopback."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *arguments: Any) -> None:
            pass

    made = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=folder))
    threading.Thread(target=made.serve_forever, daemon=True).start()
    try:
        yield made
    finally:
        made.shutdown()
        made.server_close()


BENCH = Bench(
    "frames per second of an hma export page in headless Chromium",
    {"export": "build/page", "robot": "rails_03", "frames": 200},
    run,
)
