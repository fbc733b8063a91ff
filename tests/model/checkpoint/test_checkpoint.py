"""Checkpoints: what is saved comes back, parts that do not belong together do not, and files stay whole."""

import hashlib
import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from hma_data.errors import CheckpointError, HMAError
from hma_data.storage.files import file_sha256
from hma_data.tokenizers.shapes import palette_spec
from hma_model.checkpoint import io
from hma_model.checkpoint import io as checkpoint
from hma_model.checkpoint.folder import (
    README,
    SAMPLE,
    STEM,
    TRUNK,
    Checkpoint,
    read_metadata,
    require_tokenizer,
)
from hma_model.hub import publish as hub
from hma_model.network.model import HMA
from tests.hostile import Edit, cut, flip, swap, values, whole
from tests.hub_state import ROBOTS
from tests.model.robots import CONFIG, SPEC, make_model, save, yaml
from tests.model.robots import stats as stats_of


def test_the_layout_is_the_contracts(folder):
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    parts = ("stem.safetensors", "head.safetensors", "embodiment.yaml", "stats.json", "card.json")
    expected = {"config.json", "trunk.safetensors", "README.md"}
    assert files == expected | {f"embodiments/{name}/{part}" for name in ROBOTS for part in parts}
    assert json.loads((folder / "config.json").read_text())["format_version"] == 1


def test_the_cards_and_stems_name_the_trunk_by_its_sha256(folder):
    trunk = hashlib.sha256((folder / "trunk.safetensors").read_bytes()).hexdigest()
    for name in ROBOTS:
        assert Checkpoint.open(folder).card(name)["trunk_sha256"] == trunk
        stem = folder / "embodiments" / name / "stem.safetensors"
        assert read_metadata(stem)["trunk_sha256"] == trunk


def test_saving_a_loaded_model_gives_the_same_files(folder, tmp_path):
    save(tmp_path / "again", ROBOTS, model=checkpoint.load(folder))
    for path in folder.rglob("*.*"):
        if path.is_file():
            assert (tmp_path / "again" / path.relative_to(folder)).read_bytes() == path.read_bytes(), path


def test_loading_one_embodiment_reads_no_other(folder):
    for path in (folder / "embodiments/hand").iterdir():
        path.write_bytes(b"not what it should be")
    assert list(checkpoint.load(folder, ["arm"]).embodiments) == ["arm"]


@pytest.mark.parametrize("name", ["../arm", "arm/../arm", "/etc", "", "a\\b", "..", "a..b"])
def test_a_name_that_is_no_id_is_refused(folder, name):
    with pytest.raises(CheckpointError, match="not an embodiment's id"):
        checkpoint.load(folder, [name])


def test_a_tokenizer_other_than_the_models_is_refused_with_the_difference(folder):
    other = {**SPEC.to_json(), "image_size": 32}
    with pytest.raises(CheckpointError, match="image_size is 16 there and 32 here"):
        require_tokenizer(Checkpoint.open(folder).config, type(SPEC).from_json(other), folder)


def test_colours_other_than_the_models_are_refused_with_where_its_own_are():
    spec, other = (palette_spec("palette-64", 64, np.eye(3, dtype=np.uint8) * n) for n in (1, 2))
    config = CONFIG.replace(tokenizer=spec.to_json(), factored=spec.factored)
    with pytest.raises(CheckpointError, match="other colours of 'palette-64' — .*--weights PATH"):
        require_tokenizer(config, other, "runs/own")


@pytest.mark.parametrize("colors", ["zz0000", "../../x", 7, "ffffff" * 300, "ffffff000000"])
def test_a_configuration_of_colours_that_are_none_names_its_file(folder, colors):
    path = folder / "config.json"
    values = json.loads(path.read_text())
    values["tokenizer"]["colors"] = colors
    path.write_text(json.dumps(values))
    with pytest.raises(CheckpointError, match=r"config\.json: does not describe a model: tokenizer: ha?"):
        Checkpoint.open(folder)


def test_a_failed_save_leaves_the_older_checkpoint_intact(folder, tmp_path):
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}

    def full_disk(_: Path) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(CheckpointError, match="No space left on device"):
        save(folder, ROBOTS, seed=1, training=full_disk)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


def test_saving_over_a_checkpoint_replaces_it_whole(folder):
    model = save(folder, {"arm": 2}, seed=1)
    again = checkpoint.load(folder)
    assert list(again.embodiments) == ["arm"]
    assert torch.equal(again.trunk.position, model.trunk.position)


def test_a_folder_with_something_else_is_not_overwritten(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(CheckpointError, match="is not a checkpoint"):
        save(tmp_path, {"arm": 2})
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_a_model_with_an_embodiment_without_yaml_is_not_saved(tmp_path):
    with pytest.raises(CheckpointError, match="no embodiment YAML was given for hand"):
        robots = {"arm": yaml("arm")}
        numbers = {"arm": stats_of(2)}
        checkpoint.save(make_model(ROBOTS), tmp_path / "m", embodiment_yaml=robots, stats=numbers, cards={})


def test_a_missing_folder_and_an_empty_one_say_so(tmp_path):
    with pytest.raises(CheckpointError, match="no such folder"):
        checkpoint.load(tmp_path / "nothing")
    with pytest.raises(CheckpointError, match=r"has no config\.json"):
        checkpoint.load(tmp_path)


@pytest.fixture
def halved(tmp_path: Path) -> Path:
    for name in ("whole", "half"):
        robots = {"arm": 2, "hand": 3}
        save(tmp_path / name, robots, samples={"arm": b"a picture"}, half=name == "half")
    return tmp_path / "half"


def test_weights_are_rounded_and_statistics_are_not(halved: Path) -> None:
    whole, half = io.load(halved.with_name("whole")).state_dict(), io.load(halved).state_dict()
    for name, value in whole.items():
        rounded = value.is_floating_point() and "normalizer" not in name
        assert half[name].dtype == value.dtype
        assert torch.equal(half[name], value.half().to(value.dtype) if rounded else value)
    home = halved / "embodiments" / "arm"
    assert (home / SAMPLE).read_bytes() == b"a picture" and SAMPLE in (halved / README).read_text()
    assert load_file(home / STEM)["normalizer.mean"].dtype == torch.float32
    stored = Checkpoint.open(halved)
    assert stored.card("arm")["data"] == {"windows": 12}
    for name in ("arm", "hand"):
        stored.check(name)
    sizes = [(folder / TRUNK).stat().st_size for folder in (halved, halved.with_name("whole"))]
    assert sizes[0] < 0.7 * sizes[1]


def test_a_robot_joins_the_published_trunk(halved: Path, tmp_path: Path) -> None:
    HMA.from_pretrained(halved, embodiments=["arm"]).push_to_hub(tmp_path / "repo")
    assert Checkpoint.open(tmp_path / "repo").embodiments == ("arm",)
    HMA.from_pretrained(halved, embodiments=["hand"]).push_to_hub(tmp_path / "repo")
    there = Checkpoint.open(tmp_path / "repo")
    assert there.embodiments == ("arm", "hand") and there.trunk_sha256 == Checkpoint.open(halved).trunk_sha256
    given = torch.randint(0, 65, (1, 4, 2, 3)), torch.randn(1, 4, 6), "hand"
    with torch.no_grad():
        logits = [io.load(folder).video_logits(*given) for folder in (halved, tmp_path / "repo")]
    assert torch.equal(*logits)


def test_a_changed_trunk_is_published_as_it_is(halved: Path, tmp_path: Path) -> None:
    model = HMA.from_pretrained(halved)
    with torch.no_grad():
        model.trunk.position.add_(0.001)
    model.push_to_hub(tmp_path / "repo")
    assert torch.equal(io.load(tmp_path / "repo").trunk.position, model.trunk.position)


def test_weights_beyond_float16_are_refused(tmp_path: Path) -> None:
    model = make_model({"arm": 2})
    with torch.no_grad():
        model.trunk.absent[0, 0] = 1e5
    with pytest.raises(CheckpointError, match=r"trunk\.absent holds 1e\+05, which float16 cannot represent"):
        save(tmp_path / "half", {"arm": 2}, model=model, half=True)
    assert not (tmp_path / "half").exists()


# -- hostile checkpoints


def weights(change: Callable[[torch.Tensor], torch.Tensor]) -> Edit:
    """Change every tensor, and let cards, config.json and stems name the weights that are there now."""

    def edit(path: Path) -> None:
        save_file({key: change(value) for key, value in load_file(path).items()}, path, read_metadata(path))
        fit(next(parent for parent in path.parents if (parent / "config.json").exists()))

    return edit


def fit(folder: Path) -> None:
    trunk = file_sha256(folder / "trunk.safetensors")
    values(trunk_sha256=trunk)(folder / "config.json")
    for home in (folder / "embodiments").iterdir():
        stem = home / "stem.safetensors"
        save_file(load_file(stem), stem, read_metadata(stem) | {"trunk_sha256": trunk})
        digests = {part.name: file_sha256(part) for part in home.iterdir() if part.name != "card.json"}
        values(trunk_sha256=trunk, files=digests)(home / "card.json")


def of_another_trunk(path: Path) -> None:
    """Put the file of a checkpoint of the same robots on another trunk in its place."""
    folder = next(parent for parent in path.parents if (parent / "config.json").exists())
    other = folder.with_name("other")
    save(other, {"arm": 2, "hand": 3}, seed=1)
    path.write_bytes((other / path.relative_to(folder)).read_bytes())


def fitted(edit: Edit) -> Edit:
    return lambda path: (edit(path), fit(path.parents[2]))


UNET = {
    "kind": "continuous", "trunk": "unet", "video_loss": "regression", "copy_previous": True,
    "shared_modulation": True, "levels": [8],
}  # fmt: skip
MODEL = [
    UNET | {"frames": 10**6}, UNET | {"grid": [2**13, 2**13]},
    {"layers": 10**9}, {"width": 2**40, "heads": 8}, {"width": 2**19, "heads": 8},
    {"factored": [10**6, 10**6]}, {"grid": [10**5, 10**5]}, {"frames": 10**6, "layout": "released"},
    {"mlp_ratio": 1e300}, {"layers": 1.5}, {"layers": "9" * 999}, {"grid": None}, {"frames": 10**30},
    {"layers": [[]]}, {"kind": "continuous", "diffusion_width": 10**6, "grid": [2, 4]}, {"objectives": 7},
    {"conditioning": [{}]},
]  # fmt: skip
HEADS = {
    "a header of 4 EiB": struct.pack("<Q", 2**62), "a header of 99 MB": struct.pack("<Q", 99_000_000),
    "a header of all bits": b"\xff" * 8, "no header": b"", "a list as header": struct.pack("<Q", 2) + b"[]",
    "a shape beyond the file": struct.pack("<Q", 66)
    + b'{"a":{"dtype":"F32","shape":[99999999999,9],"data_offsets":[0,4]}}',
}  # fmt: skip
LONG = "k" * 10**6 + "\\u001b"
CONFIG_FILE, TRUNK_FILE, ARM = "config.json", "trunk.safetensors", "embodiments/arm/"
STEM_FILE, HEAD, STATS = ARM + "stem.safetensors", ARM + "head.safetensors", ARM + "stats.json"
CARD, YAML = ARM + "card.json", ARM + "embodiment.yaml"
FLOAT8 = torch.float8_e4m3fn
OWN = {**SPEC.to_json(), "weights_sha256": "0" * 64}
HOSTILE: dict[str, tuple[str, Edit, str]] = {  # the file, what is done to it, and what the error says
    "a trunk cut short": (TRUNK_FILE, cut(1000), r"trunk\.safetensors: is another trunk"),
    "an empty trunk": (TRUNK_FILE, cut(0), r"trunk\.safetensors: is empty — copy it again"),
    "no trunk": (TRUNK_FILE, Path.unlink, r"trunk\.safetensors.*again"),
    "another trunk": (TRUNK_FILE, of_another_trunk, r"trunk\.safetensors: is another trunk"),
    "a bit of the head": (HEAD, flip(), r"head\.safetensors: is not the file that card\.json names"),
    "no head": (HEAD, Path.unlink, r"head\.safetensors.*again"),
    "a bit of the stem": (STEM_FILE, flip(), r"stem\.safetensors: is not the file that card\.json names"),
    "a stem cut short": (STEM_FILE, cut(-100), r"stem\.safetensors: is not a complete safetensors file"),
    "the stem of another trunk": (
        STEM_FILE,
        of_another_trunk,
        r"stem\.safetensors: belongs to another trunk",
    ),
    "a pickle": (STEM_FILE, whole(b"cos\nsystem\n(S'touch ran'\ntR."), "is not a complete safetensors file"),
    "a bit of the statistics": (STATS, flip(), r"with other statistics than stats\.json"),
    "a pickle of statistics": (STATS, whole(b"cos\nsystem\n(S'touch ran'\ntR."), r"stats\.json"),
    "an empty card": (CARD, cut(0), r"card\.json: is not valid JSON"),
    "the card of another robot": (CARD, values(id="x"), r"card\.json: is the card of 'x'"),
    "the card of another trunk": (CARD, values(trunk_sha256="0" * 64), "belongs to another trunk"),
    "a card with a key twice": (CARD, swap("{", '{"files": {},'), r"card\.json: .*'files' is given twice"),
    "YAML that is none": (YAML, fitted(whole(b"a: [1")), r"embodiment\.yaml"),
    "YAML with a tag": (YAML, fitted(whole(b"id: !!python/object/apply:os.system ['touch ran']\n")), "yaml"),
    "the YAML of another robot": (YAML, swap("id: arm", "id: hand"), r"embodiment\.yaml: is not the file"),
    "YAML with another rate": (YAML, swap("hz: 10", "hz: 12"), r"embodiment\.yaml: is not the file"),
    "a huge stride": (YAML, fitted(swap("stride: 2", "stride: 100000000")), "too small for chunks"),
    "a config cut short": (CONFIG_FILE, cut(50), r"config\.json: is not valid JSON"),
    "a config with a key twice": (CONFIG_FILE, swap("{", '{"library": 1,'), "key 'library' is given twice"),
    "a long key twice": (CONFIG_FILE, whole(f'{{"{LONG}": 1, "{LONG}": 2}}'.encode()), "is given twice"),
    "another tokenizer": (CONFIG_FILE, values(tokenizer=OWN), "was trained on another tokenizer"),
    "another library": (CONFIG_FILE, values(library="diffusers"), "is not of hma-toolkit: .*'diffusers'"),
    "a stem in bool": (STEM_FILE, weights(torch.Tensor.bool), "as bool, not floating point"),
    "a head in int64": (HEAD, weights(torch.Tensor.long), "as int64, not floating point"),
    "a trunk in float8": (
        TRUNK_FILE,
        weights(lambda t: t.to(FLOAT8)),
        "as float8_e4m3fn, not floating point",
    ),
    "a trunk of NaN": (TRUNK_FILE, weights(lambda t: t * float("nan")), "that are not finite"),
    "a head of infinity": (HEAD, weights(lambda t: t + float("inf")), "that are not finite"),
    **{
        f"format {found!r}": (
            CONFIG_FILE,
            values(format_version=found),
            f"format_version {found!r}.*update.*save",
        )
        for found in (2, 0, None, "1")
    },
    **{
        name: (STEM_FILE, whole(head + bytes(16)), "is not a complete safetens")
        for name, head in HEADS.items()
    },
    **{
        f"a model with {' and '.join(change)} {i}": (CONFIG_FILE, values("model", **change), "model")
        for i, change in enumerate(MODEL)
    },
}


def refuses(case: str, act: str) -> bool:
    """Tell which acts look at what a row spoils: sizes and tensors are read where a model is made of them."""
    if case.startswith("a model with"):
        return act == "load"
    if HOSTILE[case][2].endswith(("floating point", "not finite")):
        return act == "load" or (act == "push" and HOSTILE[case][0] != TRUNK_FILE)
    if case in ("a huge stride", "YAML that is none", "YAML with a tag"):
        return act != "pull"
    return act == "push" or case != "the card of another robot"  # which others can live with


def test_a_range_that_is_not_of_the_action_is_refused(folder: Path) -> None:
    values("action", min=[0.0])(folder / STATS)
    with pytest.raises(HMAError, match=r"stats\.json: has action\.min or action\.max of another length"):
        checkpoint.Checkpoint.open(folder).stats("arm")


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_checkpoint_is_neither_loaded_nor_pushed_nor_pulled(folder, tmp_path, monkeypatch, case):
    name, spoil, said = HOSTILE[case]
    monkeypatch.chdir(tmp_path)
    spoil(folder / name)
    acts = {
        "load": lambda: checkpoint.load(folder, ["arm"]),
        "push": lambda: hub.push(folder, tmp_path / "hub"),
        "pull": lambda: hub.pull(folder, ["arm"], out=tmp_path / "out"),
    }
    if case.startswith("a model with"):
        monkeypatch.setattr(HMA, "__init__", lambda *given: pytest.fail("a model was built"))
    for act in (acts[one] for one in acts if refuses(case, one)):
        with pytest.raises(HMAError, match=said) as found:
            act()
        shown = str(found.value)
        assert "\n" not in shown and len(shown) < 500 and (found.value.remedy or name == YAML)
    assert not (tmp_path / "ran").exists() and not (refuses(case, "push") and (tmp_path / "hub").exists())
