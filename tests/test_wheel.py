"""What the wheel holds, and that it works away from the checkout."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


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


def hma(site: Path, where: Path, *arguments: str) -> str:
    code = """
import sys, hma_data
assert sys.argv.pop(1) in hma_data.__file__
from hma_model.cli import main
sys.exit(main())
"""
    done = subprocess.run(
        [sys.executable, "-P", "-c", code, str(site), *arguments],
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
    assert "hma_model/simulate/page.html" in files
    assert not any(name.startswith(("tests/", "docs/")) for name in files)


def test_the_registry_answers_from_another_folder(installed: Path, tmp_path: Path) -> None:
    assert "pusht_fast" in hma(installed, tmp_path, "registry", "list")


def test_the_tokenizer_works_from_another_folder(installed: Path, tmp_path: Path) -> None:
    assert "fsq-16" in hma(installed, tmp_path, "tokenizer", "list", "--json")
