"""The page of `hma play` in a real browser: keys, mouse, touch, two viewers, a reload."""

import asyncio
import re
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import pytest

from hma_data.conversion.job import convert
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_model.play import server
from hma_model.play.server import Server, run
from hma_model.play.stepper import Stepper
from hma_model.worlds.scenes import RecordedRobot
from tests.conftest import BlockTokenizer
from tests.model.play.test_stepper import METER
from tests.model.true_world import TrueWorld, lab_robots

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytest_plugins = ["tests.browser_fixtures"]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def stepper() -> Iterator[Stepper]:
    robots = lab_robots("mover_04", "mover_02", "arm4_04", "rails_03")
    made = Stepper(dict.fromkeys(robots, TrueWorld()), robots)
    made.start()
    yield made
    made.stop()


@pytest.fixture(scope="module")
def address(stepper: Stepper) -> Iterator[str]:
    with serving(stepper) as port:
        yield f"http://127.0.0.1:{port}/"


class StillWorld(TrueWorld):
    def open(self, embodiment: str, frames: Any, chunks: Any = None, *, seed: int = 0) -> int:
        self._count += 1
        self.rows[self._count] = frames[-1]
        return self._count

    def reset(self, session: int, frames: Any, chunks: Any = None, *, seed: int | None = None) -> None:
        self.rows[session] = frames[-1]

    def step(self, actions: Any) -> Any:
        return {row: self.rows[row] for row in actions}

    def image(self, session: int) -> Any:
        return self.rows[session]


@pytest.fixture
def recorded(
    toy_arm: Embodiment, toy_recording: Path, block_tokenizer: BlockTokenizer, tmp_path: Path
) -> Iterator[Stepper]:
    """A robot of recordings whose YAML names no value of the action."""
    values = toy_arm.to_dict()
    (part,) = values["action"]["components"]
    with h5py.File(toy_recording, "a") as file:
        for episode in file["data"].values():
            episode["cmd/joint target"] = episode[part["key"]][:]
    values["action"]["components"] = [{"key": "cmd/joint target", "dims": part["dims"]}]
    own = Embodiment.from_values(values, "toy_arm")
    convert(own, toy_recording, block_tokenizer, tmp_path / "shards")
    shards = ShardSet(tmp_path / "shards")
    robot = RecordedRobot(shards, lambda: block_tokenizer, shards.manifest.stats, "first")
    made = Stepper({robot.key: StillWorld()}, {robot.key: robot})
    made.start()
    yield made
    made.stop()


@contextmanager
def serving(stepper: Stepper, port: int = 0) -> Iterator[int]:
    listener = socket.create_server(("127.0.0.1", port))
    ready, servers = threading.Event(), []

    def started(server: Any) -> None:
        servers.append(server)
        ready.set()

    app = Server(stepper, "a model").app
    thread = threading.Thread(target=lambda: asyncio.run(run(app, listener, started)), daemon=True)
    thread.start()
    assert ready.wait(20)
    yield listener.getsockname()[1]
    servers[0].should_exit = True
    thread.join(20)


@pytest.fixture
def page(browser: "Browser", address: str) -> Iterator["Page"]:
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    yield opened(context.new_page(), address)
    context.close()


def opened(page: "Page", address: str, robot: str = "mover_04") -> "Page":
    page.on("pageerror", lambda fault: pytest.fail(str(fault)))
    page.goto(address)
    page.wait_for_selector("body[data-frame='0']")
    if page.input_value("#robot") != robot:
        page.select_option("#robot", robot)
        page.wait_for_selector(f"body[data-robot='{robot}']")
    return page


def session_of(stepper: Stepper, page: "Page") -> Any:
    return stepper.sessions[page.evaluate("() => sessionStorage.getItem('session')")]


def frames(page: "Page", least: int) -> None:
    for _ in range(400):
        if int(page.get_attribute("body", "data-frame") or 0) >= least:
            return
        page.wait_for_timeout(25)
    pytest.fail(f"no {least} frames")


def number(text: str | None) -> float:
    return float(re.findall(r"-?[\d.]+", text or "")[0])


def test_a_key_drives_starts_the_clock_and_comes_to_rest(page: "Page", stepper: Stepper) -> None:
    page.keyboard.down("ArrowRight")
    frames(page, 3)
    session = session_of(stepper, page)
    top = session.robot.dimensions[0].high
    assert session.held.tolist() == pytest.approx([top, 0]) and not session.paused
    assert page.input_value("#dim-0") == pytest.approx(str(top)) or number(page.input_value("#dim-0")) > 0
    page.keyboard.up("ArrowRight")
    frames(page, session.count + 3)
    assert session.held.tolist() == [0, 0]
    assert page.text_content("#psnr") == "60.0 dB"  # the world is without error
    assert 5 < number(page.text_content("#fps")) < 15 and number(page.text_content("#latency")) > 0


def test_a_short_press_of_a_key_is_not_lost(page: "Page", stepper: Stepper) -> None:
    page.keyboard.press("p")
    frames(page, 2)
    session = session_of(stepper, page)
    page.keyboard.press("ArrowDown")  # up at once, between two frames
    frames(page, session.count + 4)
    driven = [frame.actions[0, 1] for frame in session.frames]
    assert max(driven) > 0 and driven[-1] == 0


def test_buttons_and_their_keys_pause_step_reset_and_change_the_scene(page: "Page", stepper: Stepper) -> None:
    page.click("#run")
    frames(page, 3)
    page.keyboard.press("p")
    page.wait_for_selector("#run:has-text('Run')")
    session = session_of(stepper, page)
    count = session.count
    page.click("#step")
    frames(page, count + 1)
    page.keyboard.press("n")
    frames(page, count + 2)
    assert session.count == count + 2
    first = session.start.model
    page.keyboard.press("r")
    page.wait_for_selector("body[data-frame='0']")
    assert session.start.model == first and session.number == 0
    page.keyboard.press("c")
    page.wait_for_timeout(300)
    assert session.number == 1 and session.start.model != first


def test_a_clicked_setting_leaves_the_keys_to_the_robot(page: "Page", stepper: Stepper) -> None:
    page.locator("input[value=fast]").check(force=True)
    page.locator("#passes").click(position={"x": 60, "y": 10})
    page.keyboard.down("ArrowRight")
    frames(page, 20)
    session = session_of(stepper, page)
    assert session.fast and session.sampling.unmask_steps > 2 and session.held[0] > 0
    page.keyboard.up("ArrowRight")


def test_the_mouse_steers_by_dragging_on_the_image(page: "Page", stepper: Stepper) -> None:
    box = page.locator("#stage").bounding_box()
    assert box
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - box["width"], y, steps=3)
    frames(page, 3)
    session = session_of(stepper, page)
    assert session.held[0] == pytest.approx(session.robot.dimensions[0].low) and session.held[1] == 0
    page.mouse.up()
    frames(page, session.count + 3)
    assert session.held.tolist() == [0, 0]


def test_touch_sets_the_target_of_a_robot_that_follows_one(browser, address, stepper) -> None:
    context = browser.new_context(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    page = opened(context.new_page(), address, "mover_02")
    page.wait_for_timeout(200)
    box = page.locator("#stage").bounding_box()
    assert box and box["width"] > 300
    assert page.evaluate("() => document.documentElement.scrollWidth") <= 390
    page.touchscreen.tap(box["x"] + box["width"] * 0.75, box["y"] + box["height"] * 0.25)
    frames(page, 2)
    held = session_of(stepper, page).held
    assert held.tolist() == pytest.approx([96, 32], abs=1)  # px of the image of 128
    context.close()


GAMEPAD = """
window.pad = {axes: [0, 0, 0, 0], buttons: [{pressed: false}]};
navigator.getGamepads = () => [window.pad];
"""


def test_a_gamepad_drives_and_its_button_switches(browser: "Browser", address: str, stepper: Stepper) -> None:
    context = browser.new_context()
    page = context.new_page()
    page.add_init_script(GAMEPAD)
    opened(page, address, "arm4_04").wait_for_selector("#dim-4")
    session = session_of(stepper, page)
    before = session.held.copy()
    page.evaluate("() => { pad.axes[0] = 0.5; pad.buttons[0].pressed = true; }")
    frames(page, 4)
    page.evaluate("() => { pad.axes[0] = 0; }")
    page.wait_for_timeout(300)
    assert session.held[0] > before[0] and session.held[4] != before[4]
    context.close()


def test_every_control_is_reached_and_used_by_the_keyboard_alone(page: "Page", stepper: Stepper) -> None:
    page.select_option("#robot", "arm4_04")
    page.wait_for_selector("#dim-4")
    reached = set()
    for _ in range(40):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("() => document.activeElement.id || document.activeElement.dataset.save"))
    wanted = {"robot", "scene", "stage", "run", "step", "reset", "sync", "replay", "passes", "temperature"}
    assert wanted | {"dim-0", "dim-4", "mp4", "gif", "lerobot"} <= reached
    unnamed = page.evaluate(
        "() => [...document.querySelectorAll('button, input, select')].filter((one) => !one.labels?.length"
        " && !one.textContent.trim() && !one.getAttribute('aria-label')).map((one) => one.id)"
    )
    assert unnamed == []
    session = session_of(stepper, page)
    before = session.held.copy()
    page.focus("#dim-1")
    page.keyboard.press("ArrowRight")
    page.focus("#stage")
    page.keyboard.press(" ")  # the gripper
    page.keyboard.down("a")
    frames(page, 4)
    page.keyboard.up("a")
    page.wait_for_timeout(300)
    assert session.held[1] > before[1] and session.held[2] < before[2] and session.held[4] != before[4]
    page.focus("#passes")
    page.keyboard.press("ArrowRight")
    page.wait_for_timeout(200)
    assert session.sampling.unmask_steps == 3


def test_replay_follows_the_recorder_until_a_person_takes_over(page: "Page", stepper: Stepper) -> None:
    page.select_option("#robot", "arm4_04")
    page.wait_for_selector("#dim-4")
    page.click("#replay")
    frames(page, 3)
    session = session_of(stepper, page)
    assert session.replays and page.get_attribute("#replay", "aria-pressed") == "true"
    page.keyboard.press("ArrowRight")
    page.wait_for_selector("#replay[aria-pressed='false']")
    assert not session.replays


def test_a_reload_goes_on_where_it_was(page: "Page", stepper: Stepper) -> None:
    page.keyboard.down("ArrowUp")
    frames(page, 4)
    page.keyboard.up("ArrowUp")
    page.keyboard.press("p")
    page.wait_for_selector("#run:has-text('Run')")
    session = session_of(stepper, page)
    page.reload()
    page.wait_for_selector(f"body[data-frame='{session.count}']")
    assert session_of(stepper, page) is session
    page.keyboard.press("p")
    frames(page, session.count + 2)


def test_a_file_that_is_prepared_says_how_far_it_is_and_the_page_goes_on(page, monkeypatch) -> None:
    go_on = threading.Event()

    def write(kind: str, robot: Any, shown: Any, tell: Any) -> bytes:
        tell("loading lerobot", 0, 40)
        assert go_on.wait(20)
        tell("writing frames", 20, 40)
        return b"a zip"

    monkeypatch.setattr(server, "film", write)
    page.click("#run")
    frames(page, 3)
    with page.expect_download() as download:
        page.click("[data-save=lerobot]")
        page.wait_for_selector("#saving:has-text('LeRobot: loading lerobot, some seconds the first time …')")
        frames(page, int(page.get_attribute("body", "data-frame") or 0) + 3)
        go_on.set()
    assert download.value.suggested_filename == "mover_04-scene-0.zip"
    page.wait_for_selector("#saving", state="hidden")
    page.wait_for_selector("#note:has-text('Saved mover_04-scene-0.zip')")


def test_a_recording_has_readable_names_and_its_end_offers_no_pause(browser, recorded) -> None:
    with serving(recorded) as port:
        context = browser.new_context(viewport={"width": 1280, "height": 800})
        page = opened(context.new_page(), f"http://127.0.0.1:{port}/", "toy_arm:recordings")
        assert page.locator("#dims label").all_text_contents() == [f"joint target {i}" for i in range(3)]
        page.locator("input[value=fast]").check(force=True)
        page.click("#replay")
        page.wait_for_selector("#start:has-text('End of the recording')")
        assert (page.text_content("#run") or "").split()[0] == "Run" and page.is_disabled("#run")
        assert page.text_content("#fps") == "–" and page.text_content("#robot option") == "toy_arm"
        page.locator("input[value=real]").check(force=True)  # else it may end again before it is painted
        page.click("#reset")
        page.wait_for_selector("#run:not([disabled])")
        context.close()


def test_a_closed_session_offers_to_start_again(page: "Page", stepper: Stepper) -> None:
    name = session_of(stepper, page).name
    stepper.call(lambda: stepper.close(name, "Closed after 5 minutes without input.")).result(10)
    page.wait_for_selector("#again:visible")
    assert "without input" in (page.text_content("#veil-text") or "")
    page.click("#again")
    page.wait_for_selector("#veil", state="hidden")
    page.keyboard.press("p")
    frames(page, 2)


def test_the_image_says_how_to_begin_and_that_it_stands_still(page: "Page") -> None:
    assert page.text_content("#start") == "←→↑↓ or drag here to drive"
    assert page.text_content("#driven") == "nothing yet"
    page.keyboard.press("ArrowRight")
    frames(page, 2)
    page.wait_for_selector("#start", state="hidden")
    page.keyboard.press("p")
    page.wait_for_selector("#start:has-text('Paused')")
    assert re.fullmatch(r"\d\.\d s, \d+ frames", page.text_content("#driven") or "")


def test_two_fingers_drive_two_sliders(browser: "Browser", address: str, stepper: Stepper) -> None:
    context = browser.new_context(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    page = opened(context.new_page(), address, "rails_03")
    page.wait_for_selector("#start:has-text('Drag here to drive')")
    box = page.locator("#stage").bounding_box()
    assert box
    left, right = ({"x": box["x"] + box["width"] * share, "y": box["y"] + 180} for share in (0.2, 0.8))
    touch = context.new_cdp_session(page)

    def fingers(kind: str, *points: dict[str, float]) -> None:
        touches = [point | {"id": number} for number, point in enumerate(points)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})

    fingers("touchStart", left)
    fingers("touchStart", left, right)
    fingers("touchMove", left | {"y": left["y"] + 120}, right | {"y": right["y"] - 120})
    frames(page, 2)
    session = session_of(stepper, page)
    first, second = session.robot.dimensions
    assert session.held.tolist() == pytest.approx([first.high, second.low])  # down, and up
    fingers("touchEnd")
    frames(page, session.count + 3)
    assert session.held.tolist() == [0, 0]
    context.close()


def test_the_border_warns_when_the_calibrated_uncertainty_does(page, stepper, monkeypatch) -> None:
    assert page.text_content("#meter") == "no error meter"
    assert page.get_attribute("#meter", "title") == "it is never unsure"
    session, world = session_of(stepper, page), stepper._worlds["mover_04"][0]
    monkeypatch.setattr(world, "meter", lambda robot, **way: (METER, ""))

    def begin() -> None:
        session.sample(session.sampling)
        session.begin(0)
        world.uncertainty[session.row] = 1.5

    stepper.call(begin).result(10)
    page.click("#step")
    page.wait_for_selector("#meter:has-text('error ≈ 4.0 px')")
    assert "warns" not in (page.get_attribute("#stage", "class") or "")
    page.locator("input[value=fast]").check(force=True)
    page.click("#run")
    page.wait_for_selector("#stage.warns")
    page.wait_for_selector("#meter:has-text('unsure: error > 9.0 px')")  # beyond what was calibrated
    assert "misses 10%, false alarms 10%" in (page.get_attribute("#meter", "title") or "")
    page.keyboard.press("p")
    page.wait_for_selector("#run:has-text('Run')")
    page.keyboard.press("y")
    page.wait_for_selector("#stage:not(.warns)")


def test_the_page_says_when_model_and_truth_part_and_not_after_a_sync(page, stepper) -> None:
    session = session_of(stepper, page)
    stepper.call(lambda: session.world.blind.add(session.row)).result(10)  # type: ignore[attr-defined]
    page.locator("input[value=fast]").check(force=True)
    page.click("#run")
    page.wait_for_selector("#parted:has-text('diverged at 0.1 s')")
    assert "Sync restarts the model" in (page.text_content("#note") or "")
    assert page.get_attribute("#sync", "class") == "call"
    page.keyboard.press("p")
    page.wait_for_selector("#run:has-text('Run')")
    page.evaluate("""() => {
        const decode = createImageBitmap;
        window.createImageBitmap = async (...given) => {
            const map = await decode(...given);
            await new Promise((done) => setTimeout(done, 300));
            return map;
        };
        window.seen = [];
        const parted = document.getElementById("parted");
        const note = () => seen.push(parted.textContent);
        new MutationObserver(note).observe(parted, { childList: true });
    }""")
    page.keyboard.press("n")
    page.keyboard.press("y")
    page.wait_for_selector("#sync:not(.call)")
    pixel = "document.getElementById('model-view').getContext('2d').getImageData(5, 5, 1, 1).data"
    bright = f"Math.max(...{pixel}.slice(0, 3)) > 50"
    for _ in range(300):  # until the true image is there, where the model of before was black
        if page.evaluate(bright):
            break
        page.wait_for_timeout(100)
    page.wait_for_timeout(1000)
    shown = page.evaluate("() => seen")
    assert shown[-1] == "" and "diverged at 0.1 s" not in shown[shown.index("") :]
    assert page.evaluate(bright)


def test_a_page_whose_server_stopped_says_so_and_goes_on_when_it_is_back(browser, stepper) -> None:
    page = browser.new_context().new_page()
    with serving(stepper) as port:
        opened(page, f"http://127.0.0.1:{port}/")
        page.keyboard.press("ArrowRight")
        frames(page, 2)
        page.keyboard.press("p")
    page.wait_for_selector("#veil:has-text('hma play was stopped')")
    session = session_of(stepper, page)
    with serving(stepper, port):
        page.wait_for_selector("#veil", state="hidden")
        page.keyboard.press("p")
        frames(page, session.count + 2)
        page.context.close()


def test_the_images_and_the_run_button_fit_on_the_screen_side_by_side(page: "Page") -> None:
    for width, height in ((390, 844), (844, 390), (667, 375), (820, 1180), (1024, 600)):
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(100)
        assert page.evaluate("() => document.documentElement.scrollWidth") <= width
        boxes = [page.locator(one).bounding_box() for one in ("#stage", "#true-view", ".side .card >> nth=0")]
        for one, other in combinations(boxes, 2):
            assert one and other
            apart = one["x"] + one["width"] <= other["x"] or one["y"] + one["height"] <= other["y"]
            assert apart or other["x"] + other["width"] <= one["x"]
        button = page.locator("#run").bounding_box()
        assert button and button["y"] + button["height"] <= height


def test_the_question_mark_explains_the_page_and_the_keys_rest_meanwhile(page, stepper) -> None:
    page.keyboard.press("?")
    page.wait_for_selector("#about:has-text('A neural network predicts every image')")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("p")
    page.wait_for_timeout(100)
    session = session_of(stepper, page)
    assert session.paused and session.held.tolist() == [0, 0]
    page.keyboard.press("Escape")
    page.wait_for_selector("#about", state="hidden")
    page.keyboard.press("p")
    frames(page, 2)
