"""What Python users call with a path takes it as text, as a `Path` and as any other path object."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.conversion.rewrite import merge
from hma_data.errors import UsageError
from hma_data.inspection.infer import infer
from hma_data.inspection.inspect import examine, inspect_recording
from hma_data.loading.dataset import MixtureDataset, WindowDataset
from hma_data.registry.embodiment import Embodiment, find
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.sources.base import open_source
from hma_data.sources.detect import detect
from hma_data.storage.paths import StrPath, as_address, as_path, as_text
from hma_data.storage.remote import RemotePath, place
from hma_data.tokenizers import get_tokenizer
from hma_data.tokenizers.catalog import EMBEDDED
from hma_model.checkpoint.folder import Checkpoint
from hma_model.hub import publish as hub
from hma_model.hub.datasets import pull_data, push_data
from hma_model.network.model import HMA
from hma_model.training.logging import read_metrics
from hma_model.training.loop import train
from hma_model.training.recipe import load_recipe, make_recipe
from tests.conftest import ARM_YAML, BlockTokenizer, contents, write_toy
from tests.data.videos import make_v3
from tests.model import robots
from tests.model.runs import TINY
from tests.model.shards import make_shards

Given = Callable[[Path], StrPath]


class Bare:
    """A path object that is no `Path`, as other libraries have them."""

    def __init__(self, path: object) -> None:
        self._path = path

    def __fspath__(self) -> Any:
        return self._path


FORMS: dict[str, Given] = {"str": str, "Path": Path, "PathLike": lambda path: Bare(str(path))}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("paths")
    (folder / "toy_arm.yaml").write_text(ARM_YAML)
    write_toy(folder / "toy.hdf5", (5, 6))
    make_v3(folder / "lerobot", (4, 5))
    arm, settings = Embodiment.from_yaml(ARM_YAML), Settings(val_fraction=0.4)
    convert(arm, folder / "toy.hdf5", BlockTokenizer(), folder / "shards", settings=settings)
    make_shards(folder / "tokens", "arm")
    robots.save(folder / "checkpoint", {"arm": 2})
    (folder / "recipe.yaml").write_text("data: [somewhere]\nout: run\n")
    return folder


def read(made: Path, given: Given, out: Path) -> Any:
    opened, uri = open_source("hdf5"), given(made / "toy.hdf5")
    return opened.index(uri), opened.inspect(uri).to_json(), detect(uri)


def looked_at(made: Path, given: Given, out: Path) -> Any:
    recording, yaml = given(made / "toy.hdf5"), given(made / "toy_arm.yaml")
    return find(yaml), inspect_recording(recording, yaml), examine(given(made / "shards"))


def converted(made: Path, given: Given, out: Path) -> Any:
    arm, settings = find(made / "toy_arm.yaml"), Settings(limit=2, val_fraction=0)
    convert(arm, given(made / "toy.hdf5"), BlockTokenizer(), given(out / "set"), settings=settings)
    merge([given(out / "set")], given(out / "merged"))
    return contents(out).keys(), verify(given(out / "merged"))


def loaded(made: Path, given: Given, out: Path) -> Any:
    mixture = MixtureDataset([given(made / "tokens")], 2, frames=4)
    return next(iter(mixture)).tokens.tolist(), len(WindowDataset(given(made / "tokens"), "val", 4))


def trained(made: Path, given: Given, out: Path) -> Any:
    recipe = make_recipe({**TINY, "data": [str(made / "tokens")], "steps": 1, "eval_every": 0})
    run = train(recipe, out=given(out / "run"), show=False)
    return run.losses, len(list(read_metrics(given(out / "run")))), load_recipe(given(made / "recipe.yaml"))


def published(made: Path, given: Given, out: Path) -> Any:
    target = given(out / "hub")
    hub.push(given(made / "checkpoint"), target)
    hub.pull(target, out=given(out / "pulled"))
    push_data(given(made / "tokens"), given(out / "data"))
    return contents(out), contents(pull_data(given(out / "data"), given(out / "back")))


CASES: dict[str, Callable[[Path, Given, Path], Any]] = {
    "read a recording": read,
    "look at it": looked_at,
    "infer": lambda made, given, out: infer(given(made / "lerobot"), "my_arm"),
    "convert": converted,
    "read shards": lambda made, given, out: ShardSet(given(made / "shards")).manifest.to_text(),
    "load": loaded,
    "tokenizer": lambda made, given, out: (
        get_tokenizer("fsq-8", weights=given(EMBEDDED / "fsq.safetensors")).spec
    ),
    "train": trained,
    "open a checkpoint": lambda made, given, out: (
        Checkpoint.open(given(made / "checkpoint")).embodiments,
        HMA.from_pretrained(given(made / "checkpoint")).config,
    ),
    "publish": published,
}


@pytest.mark.parametrize("case", CASES)
def test_any_form_of_a_path_gives_the_same(made: Path, tmp_path: Path, case: str) -> None:
    results = {}
    for form, given in FORMS.items():
        (out := tmp_path / form).mkdir()
        results[form] = repr(CASES[case](made, given, out)).replace(str(out), "")
    assert results["str"] == results["Path"] == results["PathLike"]


@pytest.mark.parametrize(
    "uri", ["s3://bucket/set", "memory://set/one", "hf://datasets/org/name", "file:///a/b"]
)
def test_a_uri_in_a_path_object_gets_its_slashes_back(uri: str) -> None:
    assert as_text(Path(uri)) == as_text(Bare(uri)) == as_text(uri) == as_address(Path(uri)) == uri


def test_a_path_of_a_store_stays_one() -> None:
    path = RemotePath("memory://set/one")
    assert place(path) is path and as_path(path) is path
    assert place(Bare("memory://set/one")) == place("memory://set/one") == path
    assert as_text(path) == "memory://set/one"


def test_only_text_names_a_repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert hub.is_repository("org/name") and hub.is_repository(Bare("hf://org/name"))
    assert not hub.is_repository(Path("org/name")) and not hub.is_repository(Bare("org/name"))


@pytest.mark.parametrize("take", [as_path, as_address, place, detect, find, ShardSet, HMA.from_pretrained])
def test_a_path_of_bytes_is_refused(take: Callable[[Any], Any]) -> None:
    with pytest.raises(UsageError, match=r"^b'set': is a path of bytes — give text"):
        take(b"set")


@pytest.mark.parametrize("path", [None, 3])
def test_what_is_no_path_is_a_type_error(path: Any) -> None:
    with pytest.raises(TypeError, match=r"os\.PathLike"):
        as_text(path)


def test_home_is_meant_by_a_tilde_in_any_form(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    write_toy(tmp_path / "toy.hdf5", (3,))
    assert {detect(given(Path("~/toy.hdf5"))) for given in FORMS.values()} == {"hdf5"}


def test_strpath_is_text_or_any_path_object() -> None:
    assert StrPath == str | os.PathLike[str]
