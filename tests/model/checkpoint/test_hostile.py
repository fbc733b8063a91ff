"""Checkpoints that are damaged, hostile, or made of parts that do not belong together.

Each row of HOSTILE spoils one file of a checkpoint. Loading, pushing and pulling it each end with one line
that names the fault and a remedy, and nothing is made.
"""

import struct
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from hma_data.errors import HMAError
from hma_data.storage.files import file_sha256
from hma_model.checkpoint import io as checkpoint
from hma_model.checkpoint.folder import read_metadata
from hma_model.hub import publish as hub
from hma_model.network.model import HMA
from tests.hostile import Edit, cut, flip, swap, values, whole
from tests.model.robots import SPEC, save


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
CONFIG, TRUNK, ARM = "config.json", "trunk.safetensors", "embodiments/arm/"
STEM, HEAD, STATS = ARM + "stem.safetensors", ARM + "head.safetensors", ARM + "stats.json"
CARD, YAML = ARM + "card.json", ARM + "embodiment.yaml"
FLOAT8 = torch.float8_e4m3fn
OWN = {**SPEC.to_json(), "weights_sha256": "0" * 64}
HOSTILE: dict[str, tuple[str, Edit, str]] = {  # the file, what is done to it, and what the error says
    "a trunk cut short": (TRUNK, cut(1000), r"trunk\.safetensors: is another trunk"),
    "an empty trunk": (TRUNK, cut(0), r"trunk\.safetensors: is empty — copy it again"),
    "no trunk": (TRUNK, Path.unlink, r"trunk\.safetensors.*again"),
    "another trunk": (TRUNK, of_another_trunk, r"trunk\.safetensors: is another trunk"),
    "a bit of the head": (HEAD, flip(), r"head\.safetensors: is not the file that card\.json names"),
    "no head": (HEAD, Path.unlink, r"head\.safetensors.*again"),
    "a bit of the stem": (STEM, flip(), r"stem\.safetensors: is not the file that card\.json names"),
    "a bit of the stem's header": (STEM, flip(12), r"stem\.safetensors: is not a complete safetensors file"),
    "a bit of the header's length": (STEM, flip(6), r"stem\.safetensors: is not a complete safetensors file"),
    "a stem cut short": (STEM, cut(-100), r"stem\.safetensors: is not a complete safetensors file"),
    "the stem of another trunk": (STEM, of_another_trunk, r"stem\.safetensors: belongs to another trunk"),
    "a pickle": (STEM, whole(b"cos\nsystem\n(S'touch ran'\ntR."), "is not a complete safetensors file"),
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
    "a config cut short": (CONFIG, cut(50), r"config\.json: is not valid JSON"),
    "a config with a key twice": (CONFIG, swap("{", '{"library": 1,'), "key 'library' is given twice"),
    "a long key twice": (CONFIG, whole(f'{{"{LONG}": 1, "{LONG}": 2}}'.encode()), "is given twice"),
    "another tokenizer": (CONFIG, values(tokenizer=OWN), "was trained on another tokenizer"),
    "another library": (CONFIG, values(library="diffusers"), "is not of hma-toolkit: .*'diffusers'"),
    "a stem in bool": (STEM, weights(torch.Tensor.bool), "as bool, not floating point"),
    "a head in int64": (HEAD, weights(torch.Tensor.long), "as int64, not floating point"),
    "a trunk in float8": (TRUNK, weights(lambda t: t.to(FLOAT8)), "as float8_e4m3fn, not floating point"),
    "a trunk of NaN": (TRUNK, weights(lambda t: t * float("nan")), "that are not finite"),
    "a head of infinity": (HEAD, weights(lambda t: t + float("inf")), "that are not finite"),
    **{
        f"format {found!r}": (CONFIG, values(format_version=found), f"format_version {found!r}.*update.*save")
        for found in (2, 0, None, "1")
    },
    **{name: (STEM, whole(head + bytes(16)), "is not a complete safetens") for name, head in HEADS.items()},
    **{
        f"a model with {' and '.join(change)} {i}": (CONFIG, values("model", **change), "model")
        for i, change in enumerate(MODEL)
    },
}


def refuses(case: str, act: str) -> bool:
    """Tell which acts look at what a row spoils: sizes and tensors are read where a model is made of them."""
    if case.startswith("a model with"):
        return act == "load"
    if HOSTILE[case][2].endswith(("floating point", "not finite")):
        return act == "load" or (act == "push" and HOSTILE[case][0] != TRUNK)
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
