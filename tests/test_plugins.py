"""Sources and tokenizers of other packages: those of the docs, installed and run; broken ones named."""

import json
import re
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from hma_data.errors import PluginError, SourceError, TokenizerError
from hma_data.sources.base import open_source
from hma_data.sources.detect import detect
from hma_data.tokenizers.base import get_tokenizer
from tests.command import ROOT, fails, hma
from tests.conftest import problems, write_toy

PAGE = (ROOT / "docs/extending.md").read_text()
FILES = dict(re.findall(r"^```\w+\n# (\S+)\n(.*?)^```", PAGE, re.M | re.S))
COMMANDS = re.findall(r"^hma (.+)$", PAGE, re.M)
TOKENIZER = FILES["toy_robot/tokenizer.py"]
DULL = TOKENIZER.replace('"grey-8"', '"dull"').replace("toy_robot.tokenizer", "bad_tokenizer")
Install = Callable[..., Path]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    before = set(sys.modules)

    def made(name: str, files: dict[str, str], points: dict[str, dict[str, str]]) -> Path:
        site = tmp_path / f"site-{name}"
        for path, text in files.items():
            (site / path).parent.mkdir(parents=True, exist_ok=True)
            (site / path).write_text(text)
        info = site / f"{name.replace('-', '_')}-0.1.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n")
        groups = [
            "\n".join([f"[{group}]", *(f"{key} = {value}" for key, value in rows.items())])
            for group, rows in points.items()
        ]
        (info / "entry_points.txt").write_text("\n\n".join(groups) + "\n")
        monkeypatch.syspath_prepend(str(site))
        return site

    yield made
    for module in set(sys.modules) - before:
        if any(str(tmp_path) in place for place in [str(getattr(sys.modules[module], "__file__", ""))]):
            del sys.modules[module]


@pytest.fixture
def toy_robot(install: Install) -> None:
    project = tomllib.loads(FILES["pyproject.toml"])["project"]
    modules = {name: text for name, text in FILES.items() if name.endswith(".py")}
    install(project["name"], modules, project["entry-points"])


@pytest.fixture
def episodes(tmp_path: Path) -> Path:
    draw = np.random.default_rng(0)
    (tmp_path / "episodes").mkdir()
    for i in range(3):
        frames = draw.integers(0, 256, (12, 40, 48, 3), np.uint8)
        np.savez(tmp_path / f"episodes/run_{i}.npz", frames=frames, actions=draw.normal(size=(12, 3)))
    (tmp_path / "npz_arm.yaml").write_text(FILES["npz_arm.yaml"])
    return tmp_path


@pytest.mark.slow
def test_the_example_of_the_page_runs(toy_robot: None, episodes: Path) -> None:
    assert [words.split()[0] for words in COMMANDS] == ["inspect", "registry", "convert", "shards"]
    for words in COMMANDS:
        done = hma(*words.split(), cwd=episodes)
        assert done.returncode == 0, f"hma {words}\n{done.stdout}{done.stderr}"
    facts = json.loads(hma("shards", "info", "shards", "--json", cwd=episodes).stdout)
    assert facts["totals"]["episodes"] == 3 and facts["totals"]["frames"] == 36
    assert hma("shards", "preview", "shards", "--out", "seen", cwd=episodes).returncode == 0
    listed = json.loads(hma("tokenizer", "list", "--json").stdout)
    assert listed[-1]["name"] == "grey-8" and listed[-1]["usable"]
    schema = json.loads(hma("registry", "schema").stdout)
    assert schema["$defs"]["SourceSpec"]["properties"]["format"]["enum"][-1] == "npz"


def test_a_built_in_format_is_recognised_before_that_of_a_package(toy_robot: None, episodes: Path) -> None:
    assert detect(episodes / "episodes") == "npz" == detect("s3://bucket/run_0.npz")
    write_toy(episodes / "episodes/toy.hdf5", [3])
    assert detect(episodes / "episodes") == "hdf5"


def test_a_bad_episode_of_a_package_goes_to_quarantine(toy_robot: None, episodes: Path) -> None:
    np.savez(episodes / "episodes/run_3.npz", actions=np.zeros((12, 3)))
    words = "convert -e npz_arm.yaml --source episodes --tokenizer grey-8 --out shards --max-quarantine 0.5"
    done = hma(*words.split(), "--json", "--workers", "0", cwd=episodes)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["quarantined"] == 1


def test_what_no_package_adds_is_an_error_that_lists_what_is_known(episodes: Path) -> None:
    more = "an installed package may add {} by entry points of hma_data.{}"
    done = hma("registry", "validate", "npz_arm.yaml", "--json", cwd=episodes)
    (problem,) = json.loads(done.stdout)["problems"]
    assert done.returncode == 1 and problem["path"] == "source.format" and problem["value"] == "'npz'"
    assert "'rlds', 'rosbag', 'hdf5'" in problem["allowed"]
    assert more.format("formats", "sources") in problem["allowed"]
    with pytest.raises(SourceError, match=more.format("formats", "sources")):
        open_source("npz")
    with pytest.raises(TokenizerError, match="known: .*raw.*" + more.format("tokenizers", "tokenizers")):
        get_tokenizer("grey-8")


def test_a_judgement_of_the_registry_changes_when_a_package_is_installed(request, episodes) -> None:
    words = ("registry", "validate", "npz_arm.yaml")
    assert hma(*words, cwd=episodes).returncode == 1
    request.getfixturevalue("toy_robot")
    assert hma(*words, cwd=episodes).returncode == 0


@pytest.mark.parametrize(
    ("module", "said"),
    [
        ("import no_such_module", "importing bad_source failed: ModuleNotFoundError"),
        ("1 / 0", "importing bad_source failed: ZeroDivisionError"),
        ("", r"bad_source has no open\(\)"),
        ("def open():\n    return 5", r"open\(\) gave int, which is not .*Source"),
        ("def open():\n    raise OSError('no disk')", r"open\(\) failed: OSError: no disk"),
    ],
)
def test_a_broken_source_is_one_error_that_names_its_package(module, said, install, tmp_path) -> None:
    install("bad-robot", {"bad_source.py": module}, {"hma_data.sources": {"npz": "bad_source"}})
    with pytest.raises(PluginError, match=f"^bad-robot 0.1, entry point 'npz' of hma_data.sources: {said}"):
        open_source("npz")
    assert (
        problems(json.loads(json.dumps({"source": {"format": "npz"}}))) != []
    )  # judged without importing it


def test_a_broken_source_is_told_only_where_no_other_knows_the_recording(install, toy_robot, episodes):
    install("bad-robot", {"bad_source.py": "1 / 0"}, {"hma_data.sources": {"aaa": "bad_source"}})
    assert detect(episodes / "episodes") == "npz" and detect("gs://bucket/folder") == "rlds"
    (episodes / "notes").mkdir()
    (episodes / "notes/day.txt").write_text("one")
    fails(hma("inspect", "notes", cwd=episodes), 1, "bad-robot 0.1", "ZeroDivisionError")


@pytest.mark.parametrize(
    ("module", "said"),
    [
        ("1 / 0", "importing bad_tokenizer:ENTRY failed: ZeroDivisionError"),
        ("ENTRY = 5", "gives a int, not an Entry"),
        ("def ENTRY():\n    raise OSError('no disk')", r"bad_tokenizer:ENTRY\(\) failed: OSError: no disk"),
        (TOKENIZER, "its Entry is named 'grey-8', not 'dull'"),
        (DULL.replace("bad_tokenizer", "missing"), "importing missing failed: ModuleNotFoundError"),
        (DULL.replace("load = Grey", ""), r"load\(\) failed: AttributeError: .*'load'"),
        (DULL.replace("load = Grey", "def load(name):\n    return 5"), r"load\(\) failed: TypeError"),
        (DULL.replace("load = Grey", "def load(name, **_):\n    return 5"), r"load\(\) returns int, not a"),
        (DULL.replace("Spec(name", "Spec('grey-9'"), "its spec is named 'grey-9', not 'dull'"),
    ],
)
def test_a_broken_tokenizer_is_one_error_that_names_its_package(module, said, install) -> None:
    points = {"hma_data.tokenizers": {"dull": "bad_tokenizer:ENTRY"}}
    install("bad-robot", {"bad_tokenizer.py": module}, points)
    where = "bad-robot 0.1, entry point 'dull' of hma_data.tokenizers"
    with pytest.raises(PluginError, match=f"^{where}: .*{said}"):
        get_tokenizer("dull")


def test_a_broken_tokenizer_is_not_listed_and_the_others_are(install: Install, toy_robot: None) -> None:
    points = {"hma_data.tokenizers": {"dull": "bad_tokenizer:ENTRY"}}
    install("bad-robot", {"bad_tokenizer.py": "1 / 0"}, points)
    done = hma("tokenizer", "list", "--json")
    assert done.returncode == 1 and "not listed: bad-robot 0.1" in done.stderr
    assert {"fsq-16", "grey-8"} <= {entry["name"] for entry in json.loads(done.stdout)}


def test_a_name_of_two_packages_is_an_error_that_names_both(install: Install, toy_robot: None) -> None:
    install("other-robot", {"other.py": ""}, {"hma_data.sources": {"npz": "other"}})
    with pytest.raises(PluginError, match=r"other-robot 0\.1 and toy-robot 0\.1.*two packages"):
        open_source("npz")


def test_a_package_cannot_replace_what_is_built_in(install: Install) -> None:
    points = {"hma_data.sources": {"hdf5": "bad_source"}, "hma_data.tokenizers": {"raw": "bad_source:X"}}
    install("bad-robot", {"bad_source.py": "1 / 0"}, points)
    assert open_source("hdf5") and get_tokenizer("raw").spec.name == "raw"
