"""The pages: the site builds without a warning, links and named tests exist, commands are those of `hma`."""

import ast
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest
import typer
from playwright.sync_api import sync_playwright

from hma_model.cli import app
from tests.command import ROOT

DOCS = ROOT / "docs"
TOP = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
PAGES = [*TOP, *sorted(DOCS.rglob("*.md"))]
FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
LOADED = re.compile(r"""<(?:script|link|img|iframe)[^>]*?\b(?:src|href)=["']?((?:https?:)?//[^"'\s>]+)""")


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.slow
@pytest.mark.timeout(1200)  # it exports the page "Try it"
def test_the_site_builds_without_a_warning_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    env = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(words, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    for page in tmp_path.rglob("*.html"):
        assert LOADED.findall(page.read_text()) == [], page
    for sheet in tmp_path.rglob("*.css"):
        assert not re.search(r"(@import|url\()\s*[\"']?(https?:)?//", sheet.read_text()), sheet
    assert "def generate" not in (tmp_path / "reference/python.html").read_text()  # signatures, not source
    assert 'id="hma_model.network.model.HMA.generate"' in (tmp_path / "reference/python.html").read_text()
    require_search_from_a_folder(tmp_path)
    for page, robots in (("try", {"pusht_fast"}), ("try/arms", {"planar_arm", "arm2_02"})):
        manifest = json.loads((tmp_path / page / "manifest.json").read_text())
        assert {robot["id"] for robot in manifest["robots"]} == robots
    beside_runtime = [path for path in (tmp_path / "try").rglob("*.*") if path.parent.name != "ort"]
    assert sum(path.stat().st_size for path in beside_runtime) < 20e6
    for page, link in (("index.html", "try/index.html"), ("reference/cli.html", "../try/index.html")):
        assert re.search(rf'href="{link}"[^>]*>\s*(<[^>]*>\s*)?Push a T', (tmp_path / page).read_text())


def require_search_from_a_folder(site: Path) -> None:
    """Search in the site as it is opened from the disk, where there is a browser."""
    assert (site / "search/search_index.js").is_file() and (site / "iframe-worker.js").is_file()
    if not (chromium := shutil.which("chromium")):
        return
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page()
        page.goto((site / "index.html").as_uri())
        page.locator(".md-search__input").press_sequentially("quarantine.jsonl")
        found = page.locator(".md-search-result__item a").first
        found.wait_for(state="attached")
        assert "format.html" in (found.get_attribute("href") or "")
        browser.close()


def reference() -> Any:
    spec = spec_from_file_location("make_reference", DOCS / "make_reference.py")
    assert spec and spec.loader
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_generated_pages_are_up_to_date() -> None:
    for name, page in reference().PAGES.items():
        assert (DOCS / "reference" / name).read_text() == page(), "run: python docs/make_reference.py"


@cache
def anchors(page: Path) -> set[str]:
    found: set[str] = set()
    for title in re.findall(r"^#+ (.+)$", FENCE.sub("", page.read_text()), re.MULTILINE):
        plain = LINK.sub("", title) if title.startswith("[") else re.sub(r"[`*]", "", title)
        found.add(re.sub(r"[^\w\- ]", "", plain.strip().lower()).replace(" ", "-"))
    return found


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_link_leads_somewhere(page: Path) -> None:
    wrong = []
    for target in LINK.findall(FENCE.sub("", page.read_text())):
        if re.match(r"(https?:|mailto:)", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            wrong.append(target)
        elif DOCS in page.parents and DOCS not in file.parents:
            wrong.append(f"{target} is outside of the site")
    assert not wrong


def test_the_code_that_makes_a_frame_agrees_with_generate() -> None:
    page = (ROOT / "docs/how-a-frame-is-made.md").read_text()
    code = page.split("```python\n")[1].split("```")[0]
    exec(compile(code, "docs/how-a-frame-is-made.md", "exec"), {})  # asserts that the tokens are equal


def test_the_tests_that_the_guarantees_name_exist() -> None:
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", (DOCS / "guarantees.md").read_text())
    assert named
    for file, function in named:
        tree = ast.parse((ROOT / file).read_text())
        assert function in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}, file


def commands(page: Path) -> Iterator[list[str]]:
    for kind, text in FENCE.findall(page.read_text()):
        if kind not in ("bash", "sh"):
            continue
        for line in re.sub(r"\\\n", " ", text).splitlines():
            words = shlex.split(line, comments=True) if "hma " in line else []
            for i in [i for i, word in enumerate(words) if word == "hma"]:
                end = [
                    j for j in range(i, len(words)) if words[j] in ("&&", "|", ">") or words[j].endswith(";")
                ]
                yield [word.rstrip(";") for word in words[i + 1 : end[0] + 1 if end else None]]


@cache
def application() -> Any:
    return typer.main.get_command(app)


def check_command(words: list[str]) -> None:
    command = application()
    while words and hasattr(command, "commands") and not words[0].startswith("-"):
        assert words[0] in command.commands, words
        command, words = command.commands[words[0]], words[1:]
    known = {name for param in command.params for name in (*param.opts, *param.secondary_opts)}
    for word in words:
        if re.match(r"--?[a-z]", word):
            assert word.partition("=")[0] in known | {"--help", "--debug"}, words


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_command_of_a_page_has_verbs_and_options_of_hma(page: Path) -> None:
    for words in commands(page):
        check_command(words)


@pytest.mark.parametrize("wrong", ["convrt -e arm", "convert --sauce x", "hub push-all a b"])
def test_a_command_that_is_not_of_hma_is_found(wrong: str) -> None:
    with pytest.raises(AssertionError):
        check_command(wrong.split())


def test_the_readme_shows_the_two_commands() -> None:
    page, tests = (ROOT / "README.md").read_text(), "pip install uv && uv run --group dev pytest\n"
    assert "pip install uv && uv run hma demo" in page and tests.strip() in page
    assert tests in (ROOT / ".ci" / "run").read_text()


def test_a_users_first_command_installs_no_group_of_developers() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert project["tool"]["uv"]["default-groups"] == []
    assert "pytest" in " ".join(project["dependency-groups"]["dev"])
