"""A headless Chromium for tests of pages; a test module takes it by `pytest_plugins`."""

import shutil
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser

FLAGS = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
)  # fmt: skip


EMULATED_GPU = (
    "--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--use-vulkan=swiftshader",
    "--enable-features=Vulkan", "--ignore-gpu-blocklist",
)  # fmt: skip


@pytest.fixture(scope="module")
def chromium() -> Iterator[Callable[[tuple[str, ...]], "Browser"]]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        found = shutil.which("chromium") or playwright.chromium.executable_path
        if not shutil.which(found):
            pytest.skip("no Chromium: playwright install chromium")
        yield lambda flags: playwright.chromium.launch(executable_path=found, args=list(flags))


@pytest.fixture(scope="module")
def browser(chromium: Callable[[tuple[str, ...]], "Browser"]) -> Iterator["Browser"]:
    made = chromium(FLAGS)
    yield made
    made.close()
