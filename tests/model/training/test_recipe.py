"""Recipes: what is accepted, merged and refused, and what follows from the shards."""

import math
from pathlib import Path

import pytest
import torch

from hma_data.errors import RecipeError, UsageError
from hma_data.storage.paths import shipped
from hma_data.tokenizers.base import TokenizerSpec, get_tokenizer
from hma_data.tokenizers.shapes import get_spec
from hma_model.training.recipe import differences, load_recipe, make_recipe, parse_overrides, recipe_for
from tests.model.robots import SPEC
from tests.model.shards import make_shards


@pytest.fixture
def write(tmp_path: Path):
    def write(name: str, text: str) -> Path:
        path = tmp_path / f"{name}.yaml"
        path.write_text(text)
        return path

    return write


def test_overrides_reach_nested_keys_and_are_yaml():
    given = ["model.layers=2", "lr=1e-3", "data=[a, b]", "mixture.weights.arm=2", "out=null"]
    recipe = load_recipe("discrete_tiny", given)
    assert recipe.model == {**load_recipe("discrete_tiny").model, "layers": 2}
    assert (recipe.lr, recipe.data, recipe.out) == (1e-3, ("a", "b"), None)
    assert recipe.mixture.weights == {"arm": 2.0}


def test_one_folder_of_data_needs_no_list():
    assert load_recipe("discrete_tiny", ["data=shards/arm"]).data == ("shards/arm",)


def test_a_home_folder_is_meant_by_its_tilde(monkeypatch):
    monkeypatch.setenv("HOME", "/ada")
    recipe = make_recipe({"data": ["~/shards", "s3://bucket/~"], "out": "~/runs", "start": "~/base"})
    assert recipe.data == ("/ada/shards", "s3://bucket/~")
    assert (recipe.out, recipe.start) == ("/ada/runs", "/ada/base")


def test_a_later_override_wins():
    assert load_recipe("discrete_tiny", ["steps=5", "steps=7"]).steps == 7


@pytest.mark.parametrize("override", ["steps", "=3", "model..layers=2", ".=1", "", "data=[a", "lr=&x 1"])
def test_a_malformed_override_is_wrong_usage(override):
    with pytest.raises(UsageError) as caught:
        load_recipe("discrete_tiny", [override])
    assert caught.value.exit_code == 2


def test_extends_takes_what_is_not_given(write):
    write("base", "steps: 9\nmodel: {layers: 3, width: 32}\nlr: 0.5\n")
    recipe = load_recipe(write("mine", "extends: base\nmodel: {width: 64}\nlr: 0.25\n"))
    assert (recipe.steps, recipe.model, recipe.lr) == (9, {"layers": 3, "width": 64}, 0.25)


def test_extends_replaces_objectives_as_a_whole(write):
    write("base", "objectives: {forward: 1.0}\n")
    recipe = load_recipe(write("mine", "extends: base\nobjectives: {passive: 1}\n"))
    assert recipe.objectives == {"passive": 1.0}


def test_extends_finds_the_shipped_recipes(write):
    assert load_recipe(write("mine", "extends: discrete_tiny\nsteps: 2\n")).model["width"] == 128


def test_recipes_that_extend_each_other_are_refused(write):
    write("a", "extends: b\n")
    with pytest.raises(RecipeError, match=r"extends itself.*a\.yaml -> b\.yaml -> a\.yaml"):
        load_recipe(write("b", "extends: a\n").with_name("a.yaml"))


WRONG = [  # a recipe, and what the error says
    ("stepz: 3", r"stepz: unknown key, did you mean 'steps'\?"),
    ("mixture: {temprature: 3}", r"mixture\.temprature: unknown key, did you mean 'temperature'\?"),
    ("model: {layer: 3}", r"model\.layer: unknown key, did you mean 'layers'\?"),
    ("model: {grid: [4, 4]}", r"model\.grid: follows from the shards"),
    ("steps: true", "steps: must be a number, not true or false"),
    ("steps: 0", "steps: .*greater than or equal to 1"),
    ("lr: .nan", "lr: .*is nan"),
    ("lr: -1", "lr: .*greater than 0"),
    ("schedule: linear", r"schedule: .*'constant_with_warmup' or 'cosine'.*is 'linear'"),
    ("[1, 2]", "must be a mapping, is list"),
    ("steps: 3\nsteps: 4", "given twice"),
    ("model: {layers: true}", r"model\.layers: must be a number, not true or false \(is True\)"),
    ("model: {layers: 1.5}", r"model\.layers: must be a whole number .*\(is 1\.5\)"),
    ("model: {layers: two}", r"model\.layers: must be a whole number .*\(is 'two'\)"),
    ("model: {layers: null}", r"model\.layers: must be a whole number .*\(is None\)"),
    ("model: {mup: 'yes please'}", r"model\.mup: must be true or false"),
    ("model: {corrupt_max: .nan}", r"model\.corrupt_max: must be a finite number"),
    ("model: {conditioning: modulatio}", r"model\.conditioning: .*not allowed.*modulation"),
    ("model: {conditioning: [3]}", r"model\.conditioning: must be a word or a list"),
    ("model: {width: 33, heads: 2}", r"model\.heads: 2 is not allowed: give a divisor of the width, 33"),
    ("objectives: {forwrd: 1}", "objectives: .*forwrd.*forward, passive"),
    ("objectives: {}", "objectives: .*not all vanish"),
    ("betas: [2.0, 0.9]", r"betas\.0: must be less than 1"),
    ("lr: 1e300", "lr: must be less than or equal to 1000000"),
    ("mixture: {caps: {arm: 3}}", r"mixture\.caps\.arm: must be less than or equal to 1"),
    ("data: ['']", r"data\.0: must name a folder or URI"),
    ("layers: 3", r"layers: unknown key, did you mean 'model\.layers'\?"),
    ("temperature: 3", r"temperature: unknown key, did you mean 'mixture\.temperature'\?"),
    ("LR: 3", r"LR: unknown key, did you mean 'lr'\?"),
    ("schedule: cosin", r"schedule: .*did you mean 'cosine'\?"),
    ("mixture: [1]", "mixture: must be a mapping"),
    ("3: 4", "3: keys must be words"),
    ("extends: nowhere", r"broken\.yaml: extends 'nowhere': no such recipe"),
    ("track: [tensorbord]", r"track\.0: .*'tensorboard', 'trackio' or 'wandb'"),
    ("self_forwrd: 1", r"self_forwrd: unknown key, did you mean 'self_forward'\?"),
    ("mixture: {caps: {arm: .inf}}", r"mixture\.caps\.arm: .*finite"),
    ("data: [3]", r"data\.0: .*string"),
    ("stepz: 3\nlr: fast\nmodel: {layer: 1}", r"model\.layer: .*lr: .*stepz: "),  # all at once
]


@pytest.mark.parametrize(("text", "message"), WRONG)
def test_what_is_wrong_is_said_with_key_value_and_remedy_before_any_shard_is_opened(write, text, message):
    with pytest.raises(RecipeError, match=message) as caught:
        load_recipe(write("broken", text))
    assert "broken.yaml" in caught.value.where and "Input should" not in str(caught.value)
    assert caught.value.exit_code == 1


def test_numbers_of_the_network_may_be_written_as_yaml_reads_texts():
    model = load_recipe("discrete_tiny", ["model.corrupt_max=1e-1", "model.layers=2.0"]).model
    assert (model["corrupt_max"], model["layers"]) == (0.1, 2) and isinstance(model["layers"], int)


@pytest.mark.parametrize(
    ("name", "overrides", "message"),
    [
        ("discrete_tiny", ["extends=discrete_base"], "extends: cannot be an override"),
        (Path(__file__).parent, [], "no such recipe"),
        ("discrete_tinny", [], "did you mean 'discrete_tiny'"),
        ("unet_colors", ["model.crop=10", "model.patch=1"], r"model\.crop: 10 .* give 0, or a multiple of 4"),
    ],
)
def test_a_recipe_or_an_override_that_cannot_be_is_named(name, overrides, message):
    with pytest.raises(RecipeError, match=message):
        load_recipe(name, overrides)


def test_the_network_follows_the_shards_tokenizer():
    config = make_recipe({"frames": 5, "model": {"layers": 1}}).network(SPEC)
    assert (config.grid, config.factored, config.frames, config.tokenizer) == (
        (2, 3),
        (8, 8),
        5,
        SPEC.to_json(),
    )


@pytest.mark.parametrize(
    ("stated", "digits", "expected"),
    [
        ((512, 512), 8, (8,) * 6),
        ((512, 512), 0, (512, 512)),
        ((8,) * 5, 512, (512, 64)),
        ((6, 4), 24, (24,)),
    ],
)
def test_digits_are_split_and_joined_without_changing_the_ids(stated, digits, expected):
    spec = TokenizerSpec("x", 1, "discrete", 128, (8, 8), vocab_size=math.prod(stated), factored=stated)
    assert load_recipe("discrete_tiny", [f"digits={digits}"]).factored(spec) == expected


@pytest.mark.parametrize(
    ("grid", "digits", "places", "side"),
    [
        ((16, 16), (8,) * 5, 64, 2),  # fsq-lab
        ((8, 8), (512, 512), 64, 1),  # fsq-8
        ((16, 16), (512, 512), 64, 1),  # fsq-16: the ids of squares would not fit
        ((12, 20), (8, 8), 64, 2),
        ((16, 16), (2, 2), 16, 4),
        ((16, 16), (8, 8), 256, 1),
        ((16, 16), (8, 8), 0, 1),
    ],
)
def test_places_choose_the_smallest_squares_that_are_few_enough(grid, digits, places, side):
    spec = TokenizerSpec("x", 1, "discrete", 128, grid, vocab_size=math.prod(digits), factored=digits)
    recipe = load_recipe("discrete_tiny", ["digits=0", f"places={places}"])
    assert recipe.network(spec).merge == side
    assert load_recipe("discrete_tiny", [f"places={places}", "model.merge=1"]).network(spec).merge == 1


def test_places_choose_patches_of_latents():
    spec = get_tokenizer("vae-8").spec
    assert load_recipe("continuous_tiny").network(spec).token_grid == (8, 8)
    assert load_recipe("continuous_tiny", ["places=0"]).network(spec).patch == 2
    assert load_recipe("continuous_base").network(spec).patch == 2


def test_what_only_says_where_and_how_often_may_change_in_a_run():
    old = make_recipe({"out": "a", "device": "cpu", "keep_last": 1, "workers": 0, "data": ["a"]})
    new = make_recipe({"out": "b", "device": "cuda:1", "keep_last": 9, "workers": 4, "data": ["b"]})
    assert differences(old.identity(), new.identity()) == []


def test_the_difference_names_keys_with_both_values():
    old, new = make_recipe({"lr": 1e-3}), make_recipe({"lr": 2e-3, "model": {"layers": 4}})
    assert differences(old.identity(), new.identity()) == [
        "lr: 0.001, now 0.002",
        "model.layers: None, now 4",
    ]


def test_overrides_of_one_mapping_gather():
    assert parse_overrides(["objectives.full=0.5", "objectives.policy=0.5"]) == {
        "objectives": {"full": 0.5, "policy": 0.5}
    }
    assert load_recipe("discrete_tiny", ["objectives.full=0.3"]).objectives == {"forward": 1, "full": 0.3}
    assert load_recipe("discrete_tiny", ["objectives={full: 0.3}"]).objectives == {"full": 0.3}
    assert parse_overrides(["model.layers=2", "model.width=64"]) == {"model": {"layers": 2, "width": 64}}


@pytest.mark.parametrize(
    "changes",
    [{"video_loss": "regression"}, {"video_loss": "diffusion"}, {"levels": [8]}, {"levels": [8, 16, 24]}],
)
def test_a_unet_needs_no_further_key_and_takes_either_loss(changes):
    model = {"trunk": "unet", "shared_modulation": True, "copy_previous": True} | changes
    assert make_recipe({"data": ["x"], "model": model}).model["trunk"] == "unet"


# -- what is shipped

SHIPPED = sorted(path.stem for path in (shipped("recipes") / "train").glob("*.yaml"))


@pytest.mark.parametrize(
    ("source", "tokenizer", "name"),
    [
        ("embedded", "fsq-lab", "finetune_tiny"),
        ("embedded", "palette-64", "finetune_colors"),
        ("embedded", "vae-8", "finetune_tiny"),  # the run names the tokenizers
        ("embedded-fsq", "fsq-lab", "finetune_tiny"),
        ("embedded-lab", "palette-64", "finetune_colors"),
        ("org/name", "palette-64", "finetune"),
    ],
)
def test_bundled_models_are_finetuned_by_recipes_of_their_own(tmp_path, source, tokenizer, name):
    shards = make_shards(tmp_path / "shards", "my_arm", spec=get_spec(tokenizer))
    assert recipe_for(source, shards) == name and name in SHIPPED


TOKENIZERS = {
    "world": "fsq-lab",
    "unet_tiny": "raw-128",
    "finetune_colors": "palette-64",
    "unet_colors": "palette-64",
    "world_arm": "palette-64",
    "world_pusht": "palette-64",
    "world_unet": "palette-64",
    "world_whole": "palette-64",
}


@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_recipe_validates_and_makes_a_network(name):
    recipe = load_recipe(name)
    spec = SPEC
    if name.startswith("continuous"):
        spec = TokenizerSpec(
            name="svd-vae", version=1, kind="continuous", image_size=256, grid=(32, 32), channels=4,
            dtype="float16", latent_scale=0.18215,
        )  # fmt: skip
    elif (tokenizer := TOKENIZERS.get(name)) is not None:
        spec = get_spec(tokenizer)
    config = recipe.network(spec)
    assert config.kind == spec.kind and config.frames == recipe.frames


def test_the_xl_model_has_the_papers_parameters_with_one_robot():
    spec = TokenizerSpec(
        name="magvit2", version=1, kind="discrete", image_size=256, grid=(16, 16), vocab_size=2**18,
        factored=(512, 512),
    )  # fmt: skip
    from hma_model.config import ActionSpace
    from hma_model.network.model import HMA

    for name, low, high in (("discrete_base", 40e6, 50e6), ("discrete_xl", 640e6, 720e6)):
        with torch.device("meta"):
            model = HMA(load_recipe(name).network(spec))
            model.add_embodiment(ActionSpace("arm", 7, 5, (0.0,) * 7, (1.0,) * 7, (True,) * 7))
        assert low < sum(p.numel() for p in model.parameters()) < high


def test_the_mixture_of_forty_names_forty_embodiments_of_the_registry():
    from hma_data.registry.embodiment import find

    names = [folder.removeprefix("shards/") for folder in load_recipe("pretrain40").data]
    assert len(set(names)) == 40
    for name in names:
        assert find(name).id == name
