"""Training of tokenizers, discrete and continuous: what it makes, repeats, continues and refuses."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from hma_data.errors import RecipeError, TokenizerError
from hma_data.storage.paths import shipped
from hma_data.tokenizers.base import Tokenizer, get_tokenizer
from hma_data.tokenizers.catalog import EMBEDDED
from hma_data.tokenizers.checkpoints import read_weights, save_weights
from hma_data.tokenizers.embedded import FsqAutoencoder, VaeAutoencoder
from hma_data.tokenizers.shapes import FsqConfig, VaeConfig
from hma_data.tokenizers.training.eval import evaluate, psnr_db
from hma_data.tokenizers.training.frames import draw_batch, load_pools
from hma_data.tokenizers.training.muon import Muon, orthogonal
from hma_data.tokenizers.training.recipe import DrawnSource, load_recipe
from hma_data.tokenizers.training.train import start_from, train
from tests.data import tokenizer_files
from tests.data.tokenizer_files import Stopped, draw_scene, drawn_corpus, scenes, stop_at

RECIPE = shipped("recipes") / "tokenizer" / "fsq.yaml"
SMALL = FsqConfig(width=(8, 8), hidden=8, encoder_blocks=(1, 1), decoder_blocks=(1, 1, 1), fine_width=4)


def write_recipe(folder: Path, **training: object) -> Path:
    return tokenizer_files.write_recipe(folder, SMALL.model_dump(), **training)


def test_training_makes_weights_that_tokenize(tmp_path):
    out = tmp_path / "w.safetensors"
    lines: list[str] = []
    facts = train(write_recipe(tmp_path), out, report=lines.append, report_every=3)
    assert facts["steps"] == 6 and len(lines) == 3
    tokenizer = get_tokenizer("fsq-8", weights=str(out))
    assert psnr_db(scenes(4, 128), tokenizer.decode(tokenizer.encode(scenes(4, 128)))).mean() > 14
    assert float(torch.tensor(1e-40) * 1.0) > 0  # denormal numbers are as they were


@pytest.mark.slow
def test_training_again_gives_the_same_weights_also_of_crops_drawn_ahead(tmp_path):
    recipe, facts = write_recipe(tmp_path), {}
    for workers in (0, 3):
        facts[workers] = train(recipe, tmp_path / str(workers), workers=workers, report=lambda _: None)
    alone, ahead = (load_file(tmp_path / name) for name in ("0", "3"))
    assert all(torch.equal(alone[name], ahead[name]) for name in alone)
    assert facts[0] | {"seconds": 0} == facts[3] | {"seconds": 0}


def test_a_device_that_is_not_there_is_refused_before_anything_is_read(tmp_path):
    with pytest.raises(TokenizerError, match="abacus"):
        train(tmp_path / "gone.yaml", tmp_path / "w", device="abacus")


@pytest.mark.slow
def test_a_stopped_training_may_be_given_another_end_but_no_other_past(tmp_path):
    recipe, out = write_recipe(tmp_path, fall=[[2, 1], [6, 0]]), tmp_path / "w"
    with pytest.raises(Stopped):
        train(recipe, out, report=stop_at(4), report_every=1)
    with pytest.raises(RecipeError, match="other settings"):
        train(recipe, out, {"training.fall": [[3, 1], [6, 0]]}, report=lambda _: None)
    sooner = {"training.steps": 5, "training.fall": [[2, 1], [4, 0.5], [5, 0]]}
    assert train(recipe, out, sooner, report=lambda _: None)["steps"] == 5


GROWN = {"network.decoder_blocks": [1, 2, 3], "network.fine_width": 6, "network.hidden": 12}


def test_a_training_may_start_from_a_smaller_network_and_decodes_as_it_did(tmp_path):
    train(write_recipe(tmp_path), tmp_path / "small", report=lambda _: None)
    small, _, _ = opened = read_weights(tmp_path / "small", FsqConfig.format, FsqConfig)
    grown = load_recipe(write_recipe(tmp_path), GROWN).network
    assert isinstance(grown, FsqConfig) and grown != small
    before, after = FsqAutoencoder(small), FsqAutoencoder(grown)
    start_from(after, tmp_path / "small")
    before.load_state_dict({name: tensor.float() for name, tensor in opened[1].items()})
    pictures = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0)) * 2 - 1
    with torch.no_grad():
        assert torch.equal(before.encode(pictures), after.encode(pictures))
        ids = before.encode(pictures)
        torch.testing.assert_close(after.decode(ids), before.decode(ids), rtol=0, atol=1e-5)


def test_a_larger_network_is_no_start(tmp_path):
    train(write_recipe(tmp_path), tmp_path / "large", GROWN, report=lambda _: None)
    with pytest.raises(TokenizerError, match="does not fit into the recipe's network"):
        train(write_recipe(tmp_path), tmp_path / "w", {"start": str(tmp_path / "large")})


def test_a_decoder_that_learns_alone_leaves_the_tokens_as_they_are(tmp_path):
    train(write_recipe(tmp_path), tmp_path / "first", report=lambda _: None)
    settings = {**GROWN, "network.hidden": SMALL.hidden, "training.decoder_only": True}
    for before, after in (("first", "second"), ("second", "third")):
        start = {"start": str(tmp_path / before)}
        train(write_recipe(tmp_path), tmp_path / after, settings | start, report=str)
    first, *later = (get_tokenizer("fsq-8", weights=tmp_path / name) for name in ("first", "second", "third"))
    pictures = scenes(3, 128)
    ids = first.encode(pictures)
    for tokenizer in later:
        assert tokenizer.spec == first.spec
        assert np.array_equal(tokenizer.encode(pictures), ids)
        assert not np.array_equal(tokenizer.decode(ids), first.decode(ids))
    train(write_recipe(tmp_path), tmp_path / "fourth", {"start": f"{tmp_path}/second", **GROWN}, report=str)
    assert get_tokenizer("fsq-8", weights=tmp_path / "fourth").spec != first.spec


def test_a_state_of_another_training_is_refused(tmp_path):
    (tmp_path / "w.state").write_bytes(b"junk")
    with pytest.raises(RecipeError, match=r"w\.state"):
        train(write_recipe(tmp_path), tmp_path / "w", report=lambda _: None)


def test_crops_depend_on_seed_and_step_alone(tmp_path):
    source = DrawnSource(**drawn_corpus(tmp_path, 3))
    pools, digest = load_pools([source], tmp_path)
    again, same = load_pools([source], tmp_path)
    assert digest == same
    crops = draw_batch(pools, 48, 6, 7, 3)
    assert np.array_equal(crops, draw_batch(again, 48, 6, 7, 3))
    assert not np.array_equal(crops, draw_batch(pools, 48, 6, 7, 4))
    assert crops.min() >= -1 and crops.max() <= 1


def test_the_shipped_recipe_is_valid_and_makes_the_shipped_network():
    config, _, _ = read_weights(EMBEDDED / "fsq.safetensors", FsqConfig.format, FsqConfig)
    assert load_recipe(RECIPE).network == config


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        ({"training.steps": 0}, "training.steps"),
        ({"training.stepz": 5}, "training.stepz"),
        ({"loss.l2": float("nan")}, "loss.l2"),
        ({"network.hidden": 0}, "network"),
        ({"seed.x": 1}, "seed.x"),
        ({"training.fall": [[5, 0.5], [4000, 0]]}, "training"),
        ({"training.fall": [[5, 1], [7, 0]]}, "training"),
        ({"sources": []}, "sources"),
        ({"training.decoder_only": True}, "name that file"),
    ],
)
def test_recipe_faults_name_the_key(overrides, named):
    with pytest.raises(RecipeError, match=named):
        load_recipe(RECIPE, overrides)


def test_a_corpus_that_is_not_there_is_named(tmp_path):
    with pytest.raises(RecipeError, match="scikit-image"):
        train(RECIPE, tmp_path / "w", {"corpus": str(tmp_path)})


def test_pictures_that_were_not_drawn_are_named_with_what_draws_them(tmp_path):
    drawn_corpus(tmp_path, 3)
    with pytest.raises(RecipeError, match=r"holds 3 images, the recipe says 4 — recipes/tokenizer/draw.py"):
        load_pools([DrawnSource(kind="drawn", pictures=4)], tmp_path)


@pytest.mark.slow
def test_the_script_draws_what_the_recipe_lists(tmp_path):
    script = Path(__file__).parents[3] / "recipes/tokenizer/draw.py"
    command = [sys.executable, str(script), str(tmp_path), "--pusht", "2", "--drawn", "3"]
    subprocess.run(command, check=True)
    pools, _ = load_pools(
        [DrawnSource(kind="pusht", pictures=2), DrawnSource(kind="drawn", pictures=3)], tmp_path
    )
    assert [(pool.name, len(pool.pictures)) for pool in pools] == [("pusht", 2), ("drawn", 3)]


@pytest.mark.parametrize("shape", [(6, 40), (40, 6)])
def test_orthogonal_brings_singular_values_near_one(shape):
    matrix = torch.randn(*shape, generator=torch.Generator().manual_seed(0))
    values = torch.linalg.svdvals(orthogonal(matrix))
    assert values.min() > 0.6 and values.max() < 1.3


def test_weight_decay_bounds_the_norm_of_a_matrix_that_is_always_pushed_one_way():
    push = torch.eye(4)
    norms = {}
    for decay in (0.0, 0.5):
        weight = torch.nn.Parameter(torch.zeros(4, 4))
        optimizer = Muon([weight], lr=0.1, decay=decay)
        for _ in range(200):
            weight.grad = -push
            optimizer.step()
        norms[decay] = float(torch.linalg.matrix_norm(weight.detach(), 2))
    assert norms[0.0] > 10 and norms[0.5] < 1.3 / 0.5


# -- continuous latents


FORMAT = VaeConfig.format
SMALL_VAE = VaeConfig(width=8, hidden=8, encoder_blocks=1, decoder_blocks=(1, 1), fine_width=4)


@pytest.fixture(scope="module")
def vae() -> Tokenizer:
    return get_tokenizer("vae-8")


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    rng = np.random.default_rng(6)
    return np.stack([draw_scene(rng, 256) for _ in range(9)])


def test_scaled_latents_have_about_unit_variance(vae, frames):
    scaled = vae.encode(frames).astype(np.float64) * vae.spec.latent_scale
    assert 0.6 < scaled.std() < 1.6 and abs(scaled.mean()) < 0.5


def test_near_latents_decode_to_near_pictures(vae, frames):
    latents = vae.encode(frames)
    noise = np.random.default_rng(0).normal(0, 0.05, latents.shape)
    plain, moved = vae.decode(latents), vae.decode((latents + noise).astype(np.float16))
    assert psnr_db(plain, moved).mean() > 30


def test_weights_of_the_discrete_tokenizer_are_refused():
    with pytest.raises(TokenizerError, match=r"does not hold hma-vae-1 weights \(format 'hma-fsq-1'\)"):
        get_tokenizer("vae-8", weights=str(EMBEDDED / "fsq.safetensors"))


def test_the_scale_belongs_to_the_spec(tmp_path):
    digests = set()
    for scale in (1.0, 0.5):
        config = VaeConfig(**{**SMALL_VAE.model_dump(), "decoder_blocks": (1, 1), "latent_scale": scale})
        torch.manual_seed(0)
        path = tmp_path / f"{scale}.safetensors"
        save_weights(path, FORMAT, config, dict(VaeAutoencoder(config).named_parameters()), {})
        tokenizer = get_tokenizer("vae-8", weights=str(path))
        assert tokenizer.spec.latent_scale == scale
        digests.add(tokenizer.spec.digest)
    assert len(digests) == 2


def test_training_measures_the_scale_of_the_latents(tmp_path):
    network = SMALL_VAE.model_dump(exclude={"latent_scale"})
    recipe = tokenizer_files.write_recipe(tmp_path, network, pictures=6, steps=8)
    train(recipe, tmp_path / "w", report=lambda _: None)
    config, _, _ = read_weights(tmp_path / "w", FORMAT, VaeConfig)
    assert config.latent_scale != 1.0
    result = evaluate(
        get_tokenizer("vae-8", weights=str(tmp_path / "w")),
        [np.stack([draw_scene(np.random.default_rng(1), 256)])],
    )
    assert 0.3 < result["latent_std_scaled"] < 3
