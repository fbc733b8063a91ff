"""A headless Chromium for tests of pages; a test module takes it by `pytest_plugins`."""

import shutil
from collections.abc import Iterator
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
def browser() -> Iterator["Browser"]:
    yield from launched(FLAGS)


def launched(flags: tuple[str, ...]) -> Iterator["Browser"]:
    """Launch Chromium with these flags."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        found = shutil.which("chromium") or playwright.chromium.executable_path
        if not shutil.which(found):
            pytest.skip("no Chromium: playwright install chromium")
        made = playwright.chromium.launch(executable_path=found, args=list(flags))
        yield made
        made.close()
