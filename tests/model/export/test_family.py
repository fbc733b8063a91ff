"""The page's simulator of the laboratory's family does what the laboratory does."""

import base64
from collections.abc import Iterator
from importlib.resources import files
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from hma_data.lab import family
from hma_data.lab.family.bodies import Body
from hma_data.lab.family.table import start
from hma_model.evaluation.metrics import psnr
from hma_model.export.truth import body_values, table_values

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytest_plugins = ["tests.browser_fixtures"]
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

STEPS = 150
RUN = """async ({ script, body, state, background, actions }) => {
  const { Table, paint } = await import(script);
  const image = new Image();
  image.src = background;
  await image.decode();
  const canvas = document.createElement("canvas"), table = new Table(body, state), states = [];
  canvas.width = canvas.height = 128;
  for (const action of actions) {
    table.advance(action);
    states.push([...table.pose, ...table.blocks.flat(), table.held]);
  }
  paint(canvas, image, table.shapes());
  return { states, image: canvas.toDataURL("image/png") };
}"""


@pytest.fixture(scope="module")
def page(browser: "Browser") -> Iterator["Page"]:
    context = browser.new_context()
    yield context.new_page()
    context.close()


@pytest.mark.parametrize("robot", [*family.TRUNK, *family.HELD_OUT])
def test_states_and_images_are_those_of_the_laboratory(robot: str, page: "Page") -> None:
    body = Body.of(robot)
    table, rng = start(body, 5, 0)
    drive = family.driver(table, rng)
    given = {
        "script": _address("text/javascript", (files("hma_model.export") / "page/family.js").read_bytes()),
        "body": body_values(body),
        "state": table_values(table),
        "background": _address("image/png", cv2.imencode(".png", body.canvas[..., ::-1])[1].tobytes()),
        "actions": (actions := []),
    }
    states = []
    for _ in range(STEPS):
        action = drive()
        actions.append(action.tolist())
        table.advance(action)
        states.append(table.state)
    made = page.evaluate(RUN, given)
    assert np.abs(np.array(made["states"]) - states).max() < 1e-6
    assert np.ptp(np.array(states)[:, : len(body.axes)], axis=0).max() > 0  # something was driven
    shown = cv2.imdecode(np.frombuffer(base64.b64decode(made["image"].split(",")[1]), np.uint8), 1)
    assert psnr(shown[..., ::-1], table.picture()) > 33


def _address(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
