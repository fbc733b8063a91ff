"""Put the bundled model's page into the site as `try/`, linked as "Try it": the hook of mkdocs.yml.

The page takes its runtime from a CDN, or from the npm package that HMA_ORT_WEB names.
"""

import atexit
import os
import shutil
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

from mkdocs.structure.nav import Link, Navigation

ROBOTS = ["rails_03", "planar_arm", "pusht_fast"]  # few, so that the page stays small


def on_nav(nav: Navigation, **_: Any) -> Navigation:
    """Link the page in the navigation, which knows no file that is not in docs/."""
    nav.items.append(Link("Try it", "try/index.html"))
    return nav


def on_post_build(config: Any) -> None:
    """Copy the page to the built site."""
    shutil.copytree(page(), Path(config.site_dir) / "try", dirs_exist_ok=True)


@cache  # mkdocs serve builds the site after every change
def page() -> Path:
    """Return the folder of the exported page; it takes a minute."""
    from hma_model.cli.export import export_checkpoint

    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    runtime = Path(found) if (found := os.environ.get("HMA_ORT_WEB")) else None
    export_checkpoint("embedded", [], folder / "try", ROBOTS, runtime=runtime)
    return folder / "try"
