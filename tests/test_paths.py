"""Every public function that takes a path takes it as text, as a `Path` and as any other path object."""

import ast
import hashlib
import os
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hma_data.conversion.job import Conversion, convert, plan_conversion
from hma_data.conversion.output import Share
from hma_data.conversion.plan import Settings, estimate
from hma_data.conversion.rewrite import merge, restat, split
from hma_data.errors import HMAError, UsageError
from hma_data.inspection.infer import infer
from hma_data.inspection.inspect import examine, inspect_recording
from hma_data.lab import record
from hma_data.loading import dataset as loader
from hma_data.registry import catalog as registry
from hma_data.registry.embodiment import Embodiment, find
from hma_data.shards.manifest import Manifest
from hma_data.shards.memmap import export
from hma_data.shards.preview import describe, preview, tokenizer_of
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.sources.base import open_source
from hma_data.sources.detect import detect
from hma_data.sources.hands.detect import load_models
from hma_data.storage.files import file_sha256
from hma_data.storage.paths import StrPath, as_address, as_path, as_text
from hma_data.storage.remote import RemotePath, place
from hma_data.tokenizers import get_tokenizer
from hma_data.tokenizers.catalog import EMBEDDED
from hma_data.tokenizers.training import eval as tokenizer_report
from hma_data.tokenizers.training import recipe as tokenizer_recipe
from hma_data.tokenizers.training import train as tokenizer_train
from hma_data.tokenizers.training.frames import films_of, read_films, recording_films
from hma_model.checkpoint import io as checkpoint
from hma_model.checkpoint.folder import Checkpoint, resolve, training_checkpoints
from hma_model.demo.run import demo
from hma_model.evaluation.evaluate import evaluate
from hma_model.evaluation.losses import unconditional_baseline, windows
from hma_model.evaluation.rollout_video import RolloutVideo, write_video
from hma_model.hub import datasets as hub_data
from hma_model.hub import listing as hub_list
from hma_model.hub import publish as hub
from hma_model.network.model import HMA
from hma_model.training import logging as runlog
from hma_model.training.loop import finetune, train
from hma_model.training.recipe import find_recipe, load_recipe, make_recipe
from tests.conftest import ARM_YAML, BlockTokenizer, write_toy
from tests.data.bag_files import make_recording, write_ros1
from tests.data.hands_files import rows, write_table
from tests.data.sources.rlds.test_rlds import toy as write_rlds
from tests.data.tokenizer_files import write_magvit2
from tests.data.tokenizers.test_tokenizer_train import write_recipe
from tests.data.videos import encode, make_v3
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


@dataclass(frozen=True)
class Made:
    """One small thing of each kind that a public function reads."""

    folder: Path
    arm: Embodiment

    def __getattr__(self, name: str) -> Path:
        return next(self.folder.glob(f"{name}*"))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("paths")
    torch.set_num_threads(1)
    arm = Embodiment.from_yaml(ARM_YAML)
    (folder / "toy_arm.yaml").write_text(ARM_YAML)
    write_toy(folder / "hdf5.hdf5", (5, 6))
    write_rlds(folder / "rlds")
    (folder / "bags").mkdir()
    write_ros1(folder / "bags/one.bag", make_recording(4))
    make_v3(folder / "lerobot", (4, 5))
    (folder / "videos").mkdir()
    encode(folder / "videos/a.mp4", range(6))
    write_table(folder / "videos/hands.csv", rows("a.mp4", 6))
    convert(
        arm, folder / "hdf5.hdf5", BlockTokenizer(), folder / "shards", settings=Settings(val_fraction=0.4)
    )
    export(folder / "shards", folder / "memmap")
    make_shards(folder / "tokens", "arm")
    robots.save(folder / "checkpoint", {"arm": 2})
    robots.save(folder / "run/checkpoints/step-00000001", {"arm": 2})
    (folder / "run/metrics.jsonl").write_text('{"kind": "train", "step": 1, "loss": 2.0}\n')
    write_magvit2(folder / "magvit2.safetensors")
    write_recipe(folder).rename(folder / "tokenizer.yaml")
    (folder / "training.yaml").write_text("data: [somewhere]\nout: run\n")
    (folder / "foreign").mkdir()
    (folder / "foreign/letter.txt").write_text("dear")
    return Made(folder, arm)


def content(folder: Path) -> dict[str, str]:
    """The files below a folder."""
    return {str(p.relative_to(folder)): file_sha256(p) for p in sorted(folder.rglob("*")) if p.is_file()}


def parameters(model: HMA) -> dict[str, list[float]]:
    return {name: value.flatten().tolist() for name, value in model.state_dict().items()}


def fault_of(call: Callable[[], Any]) -> str:
    with pytest.raises(HMAError) as fault:
        call()
    return str(fault.value)


def read_all(source: str, path: Path, given: Given, arm: Embodiment | None) -> Any:
    opened, uri = open_source(source), given(path)
    read = opened.read(uri, opened.episode_ids(uri)[0], arm).source if arm else None
    return opened.inspect(uri).to_json(), opened.index(uri, arm), opened.episode_ids(uri), read


def converted(made: Made, given: Given, out: Path) -> Any:
    settings = Settings(limit=2, val_fraction=0)
    source = given(made.hdf5)
    convert(made.arm, source, BlockTokenizer(), given(out / "set"), settings=settings)
    share = Share(0, 1)
    Conversion(made.arm, source, BlockTokenizer(), given(out / "shared"), settings=settings).run_share(share)
    plan, uri = plan_conversion(made.arm, source, BlockTokenizer().spec, settings)
    estimated = estimate(plan, given(made.hdf5), made.arm, BlockTokenizer(), 1)
    return content(out), plan.facts, uri, estimated.bytes


def published(made: Made, given: Given, out: Path) -> Any:
    checkpoint_, target = given(made.checkpoint), given(out / "hub")
    hub.push(checkpoint_, target)
    hub.push_model(robots.make_model({"so100": 6}), given(out / "other"))
    hub.pull(target, out=given(out / "pulled"))
    found = hub.list_embodiments(target), hub_list.survey(target)
    return content(out), str(found).replace(str(out), ""), hub.is_repository(target)


def trained(made: Made, given: Given, out: Path) -> Any:
    recipe = make_recipe({**TINY, "data": [str(made.tokens)]})
    foreign, data, name = given(made.foreign), [given(made.tokens)], given(Path("finetune"))
    return (
        fault_of(lambda: train(recipe, out=foreign, show=False)),
        fault_of(lambda: finetune(given(made.run), data, out=foreign, recipe=name)),
        [path.name for path in training_checkpoints(given(made.run))],
        runlog.read_metrics(given(made.run)),
    )


def kept(made: Made, given: Given, out: Path) -> Any:
    """A checkpoint that is written, changed, opened and removed."""
    folder = out / "kept"
    robots.save(given(folder), {"arm": 2})  # type: ignore[arg-type]
    checkpoint.write_readme(given(folder))
    found = content(folder), Checkpoint.open(given(folder)).embodiments, resolve(given(folder)).name
    checkpoint.remove(given(folder))
    return found, folder.exists()


def shards_made_anew(made: Made, given: Given, out: Path) -> Any:
    merge([given(made.shards)], given(out / "merged"))
    split(given(made.shards), given(out / "split"), seed=3)
    export(given(made.shards), given(out / "flat"))
    return content(out), restat(given(out / "merged")).to_text()


def tokenized(made: Made, given: Given, out: Path) -> Any:
    magvit2 = get_tokenizer("magvit2", weights=given(made.magvit2))
    fsq = get_tokenizer(given(Path("fsq-8")), weights=given(EMBEDDED / "fsq.safetensors"))
    shown = tokenizer_report.write_report(given(out), "Figures", {"fsq": {"psnr": 20.0}}, [])
    return (
        magvit2.spec,
        fsq.spec,
        fault_of(lambda: get_tokenizer("raw", weights=given(out))),
        content(out),
        shown,
    )


def tokenizer_trained(made: Made, given: Given, out: Path) -> Any:
    file, weights = given(made.tokenizer), given(out / "w.safetensors")
    fault = fault_of(lambda: tokenizer_train.train(file, weights, {"training.steps": "none"}))
    return fault.replace(str(out), ""), tokenizer_recipe.load_recipe(file)


def frames(made: Made, given: Given, out: Path) -> Any:
    spec = BlockTokenizer.spec
    taken = [
        *read_films(given(made.videos / "a.mp4"), 16, frames=2),
        *recording_films(made.arm, given(made.hdf5), spec, frames=2),
        *films_of(given(made.hdf5), spec, embodiment=made.arm, frames=2),
        *films_of(given(made.shards), spec, frames=2),
    ]
    return [hashlib.sha256(np.ascontiguousarray(picture)).hexdigest() for picture in taken]


def evaluated(made: Made, given: Given, out: Path) -> Any:
    model, data = robots.make_model({"arm": 2}), given(made.tokens)
    batches = list(windows(data, "val", 4, 2))
    baseline = unconditional_baseline([data], batches).mean()

    class Blocks:
        spec = robots.SPEC

        def decode(self, tokens: Any) -> Any:
            return np.repeat(np.repeat(np.repeat(tokens[..., None], 8, 1), 8, 2), 3, 3).astype(np.uint8)

    return len(batches), baseline, evaluate(model, Blocks(), data, count=1, batch_size=1)  # type: ignore[arg-type]


def loaded(made: Made, given: Given, out: Path) -> Any:
    mixture = loader.MixtureDataset([given(made.tokens)], 2, frames=4)
    one = next(iter(mixture)).tokens
    whole = loader.WindowDataset(given(made.tokens), "val", 4)
    assert one is not None
    return (
        one.tolist(),
        len(whole),
        list(loader.open_sets([given(made.tokens)])),
        ShardSet(given(made.tokens)).spec,
    )


def recorded(made: Made, given: Given, out: Path) -> Any:
    (out / "pendulum").mkdir()
    return fault_of(lambda: record("pendulum", given(out), 1)).replace(str(out), "")


def drawn(made: Made, given: Given, out: Path) -> Any:
    write_video(
        given(out / "film.webp"),
        RolloutVideo(np.zeros((2, 16, 16, 3), np.uint8), 5.0, 1, np.zeros((1, 2, 3), np.float32)),
    )
    return content(out)


def hands(made: Made, given: Given, out: Path) -> Any:
    return fault_of(lambda: load_models(given(out / "models"))).replace(str(out), "")


CASES: dict[str, Callable[[Made, Given, Path], Any]] = {
    "embodiment": lambda made, given, out: (Embodiment.load(given(made.toy_arm)), find(given(made.toy_arm))),
    "find beside a checkpoint": lambda made, given, out: find("arm", beside=given(made.checkpoint)),
    "registry": lambda made, given, out: (
        registry.registry_folders(given(made.checkpoint)),
        list(registry.registry_files([given(made.folder)])),
        registry.entries([given(made.toy_arm)]),
    ),
    "detect": lambda made, given, out: [
        detect(given(path)) for path in (made.hdf5, made.rlds, made.bags, made.lerobot, made.videos)
    ],
    "hdf5": lambda made, given, out: read_all("hdf5", made.hdf5, given, made.arm),
    "rlds": lambda made, given, out: read_all("rlds", made.rlds, given, None),
    "bags": lambda made, given, out: read_all("rosbag", made.bags, given, None),
    "lerobot": lambda made, given, out: read_all("lerobot", made.lerobot, given, None),
    "videos": lambda made, given, out: read_all("hands", made.videos, given, None),
    "inspect": lambda made, given, out: inspect_recording(given(made.hdf5), given(made.toy_arm)),
    "doctor": lambda made, given, out: (
        examine(given(made.hdf5), given(made.toy_arm)),
        examine(given(made.shards)),
    ),
    "infer": lambda made, given, out: infer(given(made.lerobot), "my_arm"),
    "convert": converted,
    "shard set": lambda made, given, out: (
        Manifest.load(given(made.shards)).to_text(),
        describe(given(made.shards)),
        verify(given(made.shards)),
    ),
    "preview": lambda made, given, out: (
        preview(given(made.shards), given(out), episodes=1, frames=2, tokenizer=BlockTokenizer()).episodes,
        fault_of(lambda: tokenizer_of(ShardSet(made.shards), given(out))),
        (out / "sheet.png").read_bytes(),
    ),
    "shards made anew": shards_made_anew,
    "loader": loaded,
    "tokenizers": tokenized,
    "tokenizer training": tokenizer_trained,
    "frames": frames,
    "record": recorded,
    "pictures": drawn,
    "hands": hands,
    "recipe": lambda made, given, out: (load_recipe(given(made.training)), find_recipe(given(made.training))),
    "train": trained,
    "evaluate": evaluated,
    "checkpoint": kept,
    "hub": published,
    "from_pretrained": lambda made, given, out: [
        parameters(HMA.from_pretrained(given(made.checkpoint))),
        parameters(hub.from_pretrained(given(made.run))),
        robots.make_model({"so100": 6}).push_to_hub(given(out / "mine")).removeprefix(str(out)),
    ],
    "hub of shards": lambda made, given, out: (
        hub_data.push_data(given(made.tokens), given(out / "hub")).removeprefix(str(out)),
        content(hub_data.pull_data(given(out / "hub"), given(out / "back"))),
    ),
    "demo": lambda made, given, out: fault_of(lambda: demo(given(made.foreign))),
}


@pytest.mark.parametrize("case", CASES)
def test_any_form_of_a_path_gives_the_same(made: Made, tmp_path: Path, case: str) -> None:
    results = {}
    for form, given in FORMS.items():
        (out := tmp_path / form).mkdir()
        results[form] = repr(CASES[case](made, given, out)).replace(str(out), "")
    assert results["str"] == results["Path"] == results["PathLike"]


# -- what a path object says


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


@pytest.mark.parametrize("path", [b"set", Bare(b"set")])
@pytest.mark.parametrize("take", [as_path, as_address, place, detect, find, ShardSet, HMA.from_pretrained])
def test_a_path_of_bytes_is_refused(take: Callable[[Any], Any], path: Any) -> None:
    with pytest.raises(UsageError, match=r"^b'set': is a path of bytes — give text"):
        take(path)


@pytest.mark.parametrize("path", [None, 3])
def test_what_is_no_path_is_a_type_error(path: Any) -> None:
    with pytest.raises(TypeError, match="os.PathLike"):
        as_text(path)


def test_home_is_meant_by_a_tilde_in_any_form(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    write_toy(tmp_path / "toy.hdf5", (3,))
    assert {detect(given(Path("~/toy.hdf5"))) for given in FORMS.values()} == {"hdf5"}


# -- the annotations of what is public

PUBLIC = (
    "hma_data.conversion.job", "hma_data.conversion.plan", "hma_data.conversion.rewrite",
    "hma_data.inspection.infer", "hma_data.inspection.inspect", "hma_data.lab", "hma_data.loading.dataset",
    "hma_data.loading.mixture", "hma_data.registry.catalog", "hma_data.registry.embodiment",
    "hma_data.shards.manifest", "hma_data.shards.memmap", "hma_data.shards.preview",
    "hma_data.shards.reader", "hma_data.shards.verify", "hma_data.sources.bags.source",
    "hma_data.sources.base", "hma_data.sources.detect", "hma_data.sources.hands.detect",
    "hma_data.sources.hands.source", "hma_data.sources.hdf5.source",
    "hma_data.sources.lerobot.source", "hma_data.sources.rlds.source", "hma_data.tokenizers.base",
    "hma_data.tokenizers.training.frames", "hma_data.tokenizers.training.recipe",
    "hma_data.tokenizers.training.eval", "hma_data.tokenizers.training.train",
    "hma_model.checkpoint.folder", "hma_model.checkpoint.io", "hma_model.demo.run",
    "hma_model.evaluation.evaluate", "hma_model.evaluation.losses", "hma_model.evaluation.perceptual",
    "hma_model.evaluation.report", "hma_model.evaluation.rollout_video", "hma_model.evaluation.suite",
    "hma_model.hub.datasets",
    "hma_model.hub.listing", "hma_model.hub.publish", "hma_model.hub.sample", "hma_model.network.model",
    "hma_model.released.conversion",
    "hma_model.training.logging", "hma_model.training.loop", "hma_model.training.recipe",
    "hma_model.training.report",
)  # fmt: skip
INNER = {  # take what a public function has made of a path already
    "hma_data.registry.embodiment": {"todos"},
    "hma_data.conversion.plan": {"make_plan", "read_clip"},
    "hma_data.registry.catalog": {"file_id"},
    "hma_data.shards.manifest": {
        "damaged_files",
        "shard_sizes",
        "stored_embodiment",
        "derive",
        "finish",
        "Gathered",
        "Derived",
    },
    "hma_data.shards.verify": {"check_rows", "check_shard"},
    "hma_data.sources.detect": {"of_another_format", "by_files"},
    "hma_data.sources.common.places": {
        "is_away",
        "existing_path",
        "local_path",
        "leaves",
        "first_bytes",
        "file_fingerprint",
        "unfollowed",
        "nothing_there",
    },
    "hma_data.tokenizers.training.frames": {"read_pictures", "load_pools"},
    "hma_data.tokenizers.training.train": {"Run"},
    "hma_model.checkpoint.folder": {"inside", "read_metadata"},
    "hma_model.hub.publish": {"embodiment_ids"},
    "hma_model.training.recipe": {"differences"},
    "hma_model.training.logging": {"EventFile", "Remote", "RunLog", "open_trackers"},
    "hma_model.evaluation.rollout_video": {"newest_sheets", "write_sheets"},
}
NAMES = {
    "path", "paths", "uri", "uris", "folder", "folders", "out", "source", "target", "repo", "checkpoint",
    "data", "recipe_path", "name_or_path", "file", "files", "beside", "run", "address", "weights",
}  # fmt: skip


def parameters_for_paths(code: str, inner: Collection[str] = ()) -> dict[str, str]:
    """Name -> annotation of every parameter of a module's public functions that is a path."""
    found = {}
    classes: list[tuple[str, Any]] = [("", ast.parse(code))]
    for prefix, node in classes:
        for item in node.body:
            name = getattr(item, "name", "_")
            if name in inner or (name.startswith("_") and name != "__init__"):
                continue
            if isinstance(item, ast.ClassDef):
                classes.append((f"{name}.", item))
            elif isinstance(item, ast.FunctionDef):
                for given in (*item.args.args, *item.args.kwonlyargs):
                    annotation = ast.unparse(given.annotation) if given.annotation else ""
                    words = set(re.findall(r"\w+", annotation))
                    is_text = given.arg in NAMES and "str" in words and "Mapping" not in words
                    if (words & {"Path", "StrPath", "PathLike"} or is_text) and "Callable" not in words:
                        found[f"{prefix}{name}({given.arg})"] = annotation
    return found


@pytest.mark.parametrize("module", PUBLIC)
def test_public_functions_say_that_they_take_any_path(module: str) -> None:
    spec = find_spec(module)
    assert spec and spec.origin
    found = parameters_for_paths(Path(spec.origin).read_text(), INNER.get(module, ()))
    assert found
    assert not {where: said for where, said in found.items() if "StrPath" not in said}


def test_a_new_public_function_is_seen() -> None:
    code = """
def share(folder: Path, name: str) -> None: ...
def _inner(folder: Path) -> None: ...
class Set:
    def __init__(self, data: Sequence[str | Path]) -> None: ...
    def read(self, uri: str, out: StrPath | None = None) -> None: ...
"""
    assert parameters_for_paths(code) == {
        "share(folder)": "Path",
        "Set.__init__(data)": "Sequence[str | Path]",
        "Set.read(uri)": "str",
        "Set.read(out)": "StrPath | None",
    }


def test_strpath_is_text_or_any_path_object() -> None:
    assert StrPath == str | os.PathLike[str]
