"""What the wheel holds, and that it works away from the checkout."""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import PathDistribution, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from hma_data import __version__
from hma_model.checkpoint.folder import BUNDLED

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.slow  # a wheel is built


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built here and unpacked; a folder to put on PYTHONPATH."""
    folder = tmp_path_factory.mktemp("wheel")
    build = "import sys; from hatchling.build import build_wheel; print(build_wheel(sys.argv[1]))"
    done = subprocess.run(
        [sys.executable, "-c", build, str(folder)], cwd=ROOT, capture_output=True, text=True, check=True
    )
    with zipfile.ZipFile(folder / done.stdout.split()[-1]) as wheel:
        wheel.extractall(folder / "site")
    return folder / "site"


def hma(site: Path, where: Path, *commands: str) -> str:
    """Run commands of the unpacked wheel in one process."""
    code = """
import sys, hma_data
assert sys.argv.pop(1) in hma_data.__file__
from hma_model.cli import main
sys.exit(any(main(words.split()) for words in sys.argv[1:]))
"""
    done = subprocess.run(
        [sys.executable, "-P", "-c", code, str(site), *commands],
        cwd=where,
        env={**os.environ, "PYTHONPATH": str(site), "HMA_REGISTRY": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_it_holds_registry_recipes_and_weights(installed: Path) -> None:
    files = {path.relative_to(installed).as_posix() for path in installed.rglob("*")}
    assert "hma_data/shipped/registry/lab/pusht_fast.yaml" in files
    assert any(name.startswith("hma_data/shipped/recipes/") and name.endswith(".yaml") for name in files)
    assert any(name.startswith("hma_data/tokenizers/weights/") for name in files)
    assert {
        "hma_model/play/page.html",
        "hma_model/play/controls.js",
        "hma_model/play/holding.json",
        "hma_data/py.typed",
        "hma_model/py.typed",
    } <= files
    assert {f"hma_model/{name}/trunk.safetensors" for name in BUNDLED} <= files
    assert not any(name.startswith(("tests/", "docs/")) for name in files)


def test_its_metadata_ask_for_one_opencv_and_state_the_version(installed: Path) -> None:
    (folder,) = installed.glob("hma_toolkit-*.dist-info")
    metadata = PathDistribution(folder).metadata
    asked = {re.split(r"[^\w-]", line)[0] for line in metadata.get_all("Requires-Dist", [])}
    licences = {path.name for path in (folder / "licenses").iterdir()}
    assert metadata["Version"] == __version__ and licences == {"LICENSE", "NOTICE"}
    assert {name for name in asked if "opencv" in name} == {"opencv-python-headless"}
    assert "gym-pusht" not in asked  # it asks for the other build of OpenCV


def test_an_extra_asks_for_what_pip_can_install_and_for_all_that_is_imported(installed: Path) -> None:
    (folder,) = installed.glob("hma_toolkit-*.dist-info")
    asked = [Requirement(line) for line in PathDistribution(folder).metadata.get_all("Requires-Dist", [])]
    stores = [one for one in asked if one.name in ("gcsfs", "s3fs")]
    (fsspec,) = [one for one in map(Requirement, requires("datasets") or ()) if one.name == "fsspec"]
    for store in stores:  # each release asks for the same release of fsspec
        assert not store.specifier.contains("2026.3") and fsspec.specifier.contains("2026.2")
    planning = {one.name for one in asked if one.marker and one.marker.evaluate({"extra": "planning"})}
    assert {"imageio", "stable-worldmodel"} <= planning  # it imports imageio, and does not ask for it


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="no checkout")
def test_it_says_which_revision_it_was_built_from(installed: Path, tmp_path: Path) -> None:
    command = ["git", "-C", str(ROOT), "rev-parse", "HEAD"]
    built = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)  # a user's repository around it
    shutil.copytree(installed, tmp_path / "site")
    code = "import torch, hma_model.training.runtime as r; print(r.environment(torch.device('cpu')))"
    site = tmp_path / "site"
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], env={**os.environ, "PYTHONPATH": str(site)},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert f"'git_revision': '{built}'" in done.stdout


def test_every_extra_that_an_error_names_is_one(installed: Path) -> None:
    (folder,) = installed.glob("hma_toolkit-*.dist-info")
    extras = set(PathDistribution(folder).metadata.get_all("Provides-Extra", []))
    code = "".join(path.read_text() for path in installed.glob("hma_*/**/*.py"))
    named = set(re.findall(r'install_command\("(\w+)"\)', code))
    assert named == extras


def test_the_registry_and_the_tokenizers_answer_from_another_folder(installed: Path, tmp_path: Path) -> None:
    said = hma(installed, tmp_path, "registry list", "tokenizer list --json")
    assert "pusht_fast" in said and "fsq-16" in said
