"""Put pages of the bundled models into the site as `try/`, linked under "Try it": the hook of mkdocs.yml.

The pages take their runtime from a CDN, or from the npm package that HMA_ORT_WEB names.
"""

import atexit
import os
import shutil
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

from mkdocs.structure.nav import Link, Navigation, Section

PAGES = {  # few robots, so that the pages stay small
    "try": ("Push a T", ["pusht_fast"]),
    "try/arms": ("Arms", ["planar_arm", "arm2_02"]),
}


def on_nav(nav: Navigation, **_: Any) -> Navigation:
    """Link the pages in the navigation, which knows no file that is not in docs/."""
    links = [Link(title, f"{folder}/index.html") for folder, (title, _) in PAGES.items()]
    nav.items.append(Section("Try it", links))
    return nav


def on_post_build(config: Any) -> None:
    """Copy the pages to the built site."""
    shutil.copytree(exported(), config.site_dir, dirs_exist_ok=True)


@cache  # mkdocs serve builds the site after every change
def exported() -> Path:
    """Return a folder with the exported pages; it takes two minutes."""
    from hma_model.cli.export import export_checkpoint

    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    runtime = Path(found) if (found := os.environ.get("HMA_ORT_WEB")) else None
    for page, (_, robots) in PAGES.items():
        export_checkpoint("embedded", [], folder / page, robots, runtime=runtime)
    return folder
