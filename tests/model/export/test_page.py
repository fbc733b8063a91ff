"""The exported page in a real browser, from a plain static server in a sub-folder."""

import base64
import http.server
import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from hma_data.errors import UsageError
from hma_data.lab.family.bodies import Body
from hma_data.lab.family.table import BlockTable
from hma_model.evaluation.metrics import psnr
from hma_model.export.folder import write_replays
from hma_model.export.page import VERSION, write_page
from hma_model.export.starts import Start
from recipes.bench.page import run, served
from tests.browser_fixtures import EMULATED_GPU, FLAGS
from tests.model.export.checkpoints import ROBOT, Driver
from tests.model.play.test_stepper import METER

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytest_plugins = ["tests.browser_fixtures"]
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1500)]

PATIENCE = 300_000  # ms: machines of tests are busy
# All draws are equal, so the likeliest tokens are taken in the order of their places.
KEEP_FRAMES = """
Math.random = () => 0.5;
window.kept = [];
document.addEventListener("frame", ({ detail: { chunk, image } }) => {
  kept.push([[...chunk], btoa(String.fromCharCode(...image))]);
});
"""

# Chromium calls its emulated GPU real. Each interval that the page compares is shorter, or longer, than the
# one before. Others, such as animation frames, look at the clock at any time.
REAL_GPU = """
if (self.GPUAdapterInfo) {
  Object.defineProperty(GPUAdapterInfo.prototype, "isFallbackAdapter", { get: () => false });
}
let asked = 0;
const clock = performance.now.bind(performance);
performance.now = () => new Error().stack.includes("World.better") ? told(++asked) : clock();
"""
SHORTER, LONGER = "const told = (asked) => 1e6 - 1e6 / asked;", "const told = (asked) => asked ** 2;"


@pytest.fixture(scope="session")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if stated := os.environ.get("HMA_ORT_WEB"):
        return Path(stated)
    if not shutil.which("npm"):
        pytest.skip("no npm, which brings onnxruntime-web")
    folder = tmp_path_factory.mktemp("npm")
    words = ["npm", "install", "--ignore-scripts", "--prefix", str(folder), f"onnxruntime-web@{VERSION}"]
    if subprocess.run(words, capture_output=True, timeout=300, check=False).returncode:
        pytest.skip("npm has no onnxruntime-web here")
    return folder / "node_modules" / "onnxruntime-web"


@pytest.fixture
def site(tokens: Path, runtime: Path, tmp_path: Path) -> Path:
    return with_runtime(tokens, runtime, tmp_path)


def with_runtime(export: Path, runtime: Path, folder: Path) -> Path:
    page = Path(shutil.copytree(export, folder / "site" / "sub" / "page"))
    manifest = json.loads((page / "manifest.json").read_text())
    manifest["runtime"] = write_page(page, runtime)
    (page / "manifest.json").write_text(json.dumps(manifest))
    return folder / "site"


@pytest.fixture
def server(site: Path) -> Iterator[http.server.ThreadingHTTPServer]:
    with served(site) as made:
        yield made


@pytest.fixture
def page(browser: "Browser") -> Iterator["Page"]:
    context = browser.new_context(viewport={"width": 390, "height": 844}, color_scheme="dark")
    context.set_default_timeout(PATIENCE)
    made = context.new_page()
    made.on("pageerror", lambda fault: pytest.fail(str(fault)))
    made.add_init_script(KEEP_FRAMES)
    yield made
    context.close()


def address(server: http.server.ThreadingHTTPServer) -> str:
    return f"http://127.0.0.1:{server.server_port}/sub/page/?backend=wasm&threads=1"


def frames(page: "Page", more: int, actions: int) -> None:
    """Wait for `more` frames from here on, and until so many different actions were followed.

    A fast page shows any number of frames between two calls.
    """
    least = page.evaluate("kept.length") + more
    different = "new Set(kept.map((one) => one[0].join())).size"
    page.wait_for_function(
        f"([least, actions]) => kept.length >= least && {different} >= actions", arg=[least, actions]
    )


def said(page: "Page") -> str:
    page.wait_for_selector("#again:visible")
    return page.text_content("#veil-text") or ""


def test_200_frames_driven_by_keys_are_those_of_onnxruntime_and_it_works_offline(page, server, site) -> None:
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(address(server))
    page.wait_for_selector("#veil", state="hidden")
    assert page.evaluate("crossOriginIsolated")  # threads are allowed
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.focus("#fast")
    page.keyboard.press("Space")  # by the keyboard alone
    page.focus("#stage")
    page.keyboard.down("ArrowUp")
    frames(page, 100, 1)
    page.keyboard.up("ArrowUp")
    page.keyboard.down("w")
    frames(page, 100, 2)
    page.keyboard.press("p")
    assert float(page.evaluate("document.getElementById('clock').textContent.split(' ')[0]")) > 10
    kept = page.evaluate("kept")  # 200 or more, of the two actions that the keys give, or more
    driver = Driver(site / "sub" / "page", ROBOT)
    half = {one["name"]: np.full(one["shape"], 0.5, np.float32) for one in driver.about["draws"]}
    half["temperature"] = np.array(driver.about["temperature"], np.float32)
    driver.begin(half)
    chunks = [np.float32(chunk) for chunk, _ in kept]
    shown = [np.frombuffer(base64.b64decode(image), np.uint8) for _, image in kept]
    own = [driver.advance(chunk, half).reshape(-1) for chunk in chunks]
    far = [np.abs(one.astype(int) - other.astype(int)).max() for one, other in zip(shown, own)]
    assert max(far) <= 1, f"frame {int(np.argmax(np.array(far) > 1))} is another"
    origin = f"http://127.0.0.1:{server.server_port}/"
    assert all(url.startswith((origin, f"blob:{origin}", "data:")) for url in asked)

    server.shutdown()
    server.server_close()
    page.reload()
    page.wait_for_selector("#veil", state="hidden")
    page.keyboard.press("n")
    page.wait_for_function("Number(document.body.dataset.frame) >= 1")


def test_files_of_an_older_export_are_forgotten_and_those_of_other_pages_are_kept(page, server) -> None:
    folder = address(server).partition("?")[0]
    ends = ("page-step.onnx", "robots/it/stem.onnx", "arms/page-step.onnx", "../page-step.onnx")
    page.goto(f"{folder}manifest.json")
    page.evaluate(
        """async (urls) => {
          const cache = await caches.open("hma-export");
          for (const url of urls) await cache.put(url, new Response("it"));
        }""",
        [f"{folder}{end}?v=older" for end in ends],
    )
    page.goto(address(server))
    page.wait_for_selector("#veil", state="hidden")
    kept = page.evaluate(
        "caches.open('hma-export').then((one) => one.keys()).then((all) => all.map((one) => one.url))"
    )
    older = [url.removesuffix("?v=older") for url in kept if url.endswith("?v=older")]
    assert older == [f"{folder}arms/page-step.onnx", f"{folder.removesuffix('page/')}page-step.onnx"]


def test_the_temperature_begins_as_the_manifest_says_and_the_meter_is_of_it(page, server, site) -> None:
    about = site / "sub" / "page" / "manifest.json"
    manifest = json.loads(about.read_text()) | {"temperature": 0.2}
    manifest["robots"][0]["meter"] = asdict(METER) | {"temperature": 0.2, "verdict": "it warns"}
    about.write_text(json.dumps(manifest))
    page.goto(address(server))
    page.wait_for_selector("#veil", state="hidden")
    assert page.input_value("#temperature") == "0.2" and page.text_content("#temperature-out") == "0.2"
    assert page.get_attribute("#meter", "title") == "it warns"
    page.fill("#temperature", "1")
    page.click("#step")
    page.wait_for_selector(
        "#meter[title='uncertainty is calibrated only for temperature 0.2: set it, and press Reset']"
    )


def test_a_replay_shows_the_true_images_until_a_person_drives(page: "Page", server: Any, site: Path) -> None:
    chunks = without_simulator(site / "sub" / "page")[0]
    page.goto(address(server))
    page.wait_for_selector("#replay:visible")
    assert page.is_hidden("#true-figure")
    page.focus("#fast")
    page.keyboard.press("Space")
    page.keyboard.press("v")
    page.wait_for_function(f"document.body.dataset.frame === '{len(chunks)}'")
    assert np.allclose(np.float32([chunk for chunk, _ in page.evaluate("kept")]), chunks)
    assert page.is_visible("#true-figure") and page.is_hidden("#unknown")
    shown = page.evaluate("(({ height, width }) => [height, width])(document.querySelector('#true-view'))")
    assert shown[0] == 2 * shown[1] > 0
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.keyboard.press("p")
    page.wait_for_selector("#unknown:visible")
    page.keyboard.press("r")
    page.wait_for_selector("#true-figure", state="hidden")


def without_simulator(folder: Path) -> Any:
    """Replace the simulator of an export's page by true images; return the recorded chunks of each start."""
    manifest = json.loads((folder / "manifest.json").read_text())
    (robot,) = manifest["robots"]
    recorded = np.load(folder / robot["replays"]["chunks"])
    height, width, _ = manifest["image"]
    images = np.zeros((recorded.shape[1] + 1, height, width // 2, 3), np.uint8)  # need not be squares
    starts = [Start(*[np.zeros(1)] * 4, replay, images) for replay in recorded]
    robot["replays"] = write_replays(folder / "robots" / ROBOT, starts)
    robot["simulator"] = None
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return recorded


def test_the_simulator_in_the_page_follows_a_person_and_a_replay(page, server, site) -> None:
    page.goto(address(server))
    page.wait_for_selector("#replay:visible")
    assert page.is_visible("#true-figure")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.focus("#fast")
    page.keyboard.press("Space")
    page.focus("#stage")
    page.keyboard.down("ArrowUp")
    frames(page, 10, 1)
    page.keyboard.press("p")
    folder = site / "sub" / "page"
    (robot,) = json.loads((folder / "manifest.json").read_text())["robots"]
    shown = true_image(page)  # and no frame is still to come
    driven = [chunk for chunk, _ in page.evaluate("kept")]
    table = simulated(robot, driven)
    assert np.abs(table.pose - robot["simulator"]["tables"][0]["pose"]).max() > 5
    assert psnr(shown, table.picture()) > 30

    page.keyboard.press("v")
    page.wait_for_function(f"kept.length >= {len(driven) + 10}")
    page.keyboard.press("p")
    shown, count = true_image(page), page.evaluate("kept.length") - len(driven)
    recorded = np.load(folder / robot["replays"]["chunks"])[0]
    assert psnr(shown, simulated(robot, recorded[:count]).picture()) > 30


def simulated(robot: dict[str, Any], chunks: Any) -> BlockTable:
    begun = robot["simulator"]["tables"][0]
    table = BlockTable(Body.of(robot["id"]), np.array(begun["pose"]), np.array(begun["blocks"]))
    for action in np.float32(chunks).reshape(-1, len(robot["dimensions"])):
        table.advance(action)
    return table


def true_image(page: "Page") -> Any:
    taken = [""]
    while len(taken) < 2 or taken[-1] != taken[-2]:
        page.wait_for_timeout(1000)
        taken.append(page.evaluate("document.getElementById('true-view').toDataURL('image/png')"))
    content = np.frombuffer(base64.b64decode(taken[-1].split(",")[1]), np.uint8)
    return cv2.imdecode(content, cv2.IMREAD_COLOR_RGB)


def test_keys_are_looked_at_before_each_frame(page: "Page", server: Any) -> None:
    page.add_init_script("window.requestAnimationFrame = () => 0;")  # as a loop without a pause starves it
    page.goto(address(server))
    page.wait_for_selector("#veil", state="hidden")
    page.keyboard.down("w")
    # Playwright, too, would look by animation frames.
    page.wait_for_function("kept.length && kept[kept.length - 1][0].some((value) => value)", polling=50)


SLOW_GRAPHS = """
const post = Worker.prototype.postMessage;
Worker.prototype.postMessage = function (...given) { setTimeout(() => post.apply(this, given), 50); };
"""


def test_a_reset_that_is_driven_at_once_and_pressed_twice_begins_anew(page: "Page", server: Any) -> None:
    page.add_init_script(SLOW_GRAPHS)
    page.goto(address(server))
    page.wait_for_selector("#veil", state="hidden")
    made = []
    for ids in (["run"], ["reset", "run"], ["reset", "reset", "run"]):
        page.evaluate("(ids) => ids.forEach((id) => document.getElementById(id).click())", ids)
        frames(page, 5, 1)
        page.click("#run")  # pauses
        page.wait_for_timeout(1000)
        made.append(page.evaluate("kept.splice(0).slice(0, 5)"))
    assert made[0] == made[1] == made[2]


def test_a_browser_whose_storage_is_full_drives(page: "Page", server: Any) -> None:
    full = {"origin": f"http://127.0.0.1:{server.server_port}", "quotaSize": 1000}
    page.context.new_cdp_session(page).send("Storage.overrideQuotaForOrigin", full)
    page.goto(address(server))
    page.wait_for_selector("#veil", state="hidden")
    assert page.evaluate("crossOriginIsolated")
    page.click("#run")
    frames(page, 1, 1)


def test_a_truncated_graph_and_a_missing_manifest_are_one_clear_line(page, server, site) -> None:
    folder = site / "sub" / "page"
    graph = folder / "page-step.onnx"
    whole = graph.read_bytes()
    graph.write_bytes(whole[:-1000])
    page.goto(address(server))
    expected = (
        f"{graph.name} has {len(whole) - 1000} bytes instead of {len(whole)}: copy the exported folder again"
    )
    assert said(page) == expected
    graph.write_bytes(whole)
    page.click("#again")
    page.wait_for_selector("#veil", state="hidden")
    (folder / "manifest.json").unlink()
    page.evaluate("caches.delete('hma-export')")
    page.reload()
    assert said(page) == "manifest.json is missing here: copy the page into a folder that hma export made"


@pytest.mark.parametrize(
    ("name", "place", "words"),
    [
        ("session.js", "#veil-text", "session.js cannot be loaded"),
        ("family.js", "#veil-text", "A script of the page is missing"),
        (f"robots/{ROBOT}/table.png", "#note", "table.png cannot be loaded"),
    ],
)
def test_a_missing_file_of_the_page_is_said(page, server, site, name, place, words) -> None:
    (site / "sub" / "page" / name).unlink()
    page.goto(address(server))
    page.wait_for_function(f"document.querySelector('{place}').textContent.includes('{words}')")


# what is asked for, how the clock goes, and what the page takes; an emulated GPU is asked for by name alone
BY_NAME = [("wasm", "", "WASM"), ("webgpu", "", "WebGPU")]
BY_TIME = [("", "", "WASM"), ("", REAL_GPU + LONGER, "WASM"), ("", REAL_GPU + SHORTER, "WebGPU")]


@pytest.mark.parametrize(("trunk", "asked"), [("tokens", BY_NAME), ("pixels", [*BY_NAME, *BY_TIME])])
def test_webgpu_makes_the_frames_of_wasm_and_is_taken_if_it_is_faster(
    trunk, asked, request, tmp_path, runtime, chromium
) -> None:
    browser = chromium((*(flag for flag in FLAGS if flag != "--disable-gpu"), *EMULATED_GPU))
    with served(with_runtime(request.getfixturevalue(trunk), runtime, tmp_path)) as server, closing(browser):
        found = [drawn(browser, server, backend, script) for backend, script, _ in asked]
    for (_, _, label), (said, image) in zip(asked, found, strict=True):
        assert said.startswith(label)
        assert np.abs(image.astype(int) - found[0][1]).max() <= 1


def drawn(browser: "Browser", server: Any, backend: str, script: str = "") -> tuple[str, Any]:
    """Return the backend that the page names, and the first image of equal draws."""
    context = browser.new_context()
    context.set_default_timeout(PATIENCE)
    page = context.new_page()
    page.on("pageerror", lambda fault: pytest.fail(str(fault)))
    page.add_init_script(script)
    draw = "(window.drawn = (window.drawn ?? 1) * 16807 % 2147483647) / 2147483647"
    page.add_init_script(KEEP_FRAMES.replace("0.5", draw))
    page.goto(address(server).replace("backend=wasm", f"backend={backend}"))
    page.wait_for_selector("body[data-backend]")
    page.focus("#stage")
    page.keyboard.press("n")
    page.wait_for_function("kept.length")
    if (script or backend == "webgpu") and not page.evaluate("navigator.gpu?.requestAdapter().then(Boolean)"):
        pytest.skip("this platform's Chromium emulates no GPU")
    said, image = page.text_content("#backend") or "", page.evaluate("kept[0][1]")
    context.close()
    return said, np.frombuffer(base64.b64decode(image), np.uint8)


def test_a_browser_without_simd_is_one_clear_line(page: "Page", server: Any) -> None:
    page.add_init_script("WebAssembly.validate = () => false;")
    page.goto(address(server))
    assert said(page).startswith("This browser has no WebAssembly with SIMD")


def test_the_bench_counts_frames(site: Path, browser: "Browser") -> None:
    given = {"export": str(site / "sub" / "page"), "robot": ROBOT, "frames": 5}
    with ThreadPoolExecutor(1) as pool:  # a thread has one Playwright, and this one has the fixture's
        (row,) = pool.submit(run, given).result()
    assert row["frames_per_second"] > 0 and "WASM" in row["backend"] and float(row["shown"]) > 0
    with pytest.raises(UsageError, match="no folder of hma export"):
        run(given | {"export": str(site)})
    with pytest.raises(UsageError, match=f"robot=none is not in .* — give one of {ROBOT}"):
        run(given | {"robot": "none"})
