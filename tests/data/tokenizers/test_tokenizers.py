"""The tokenizers inside the package: what they give back, and what they refuse."""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from hma_data.errors import TokenizerError
from hma_data.storage.paths import shipped
from hma_data.tokenizers.base import Tokenizer, full_name, get_tokenizer
from hma_data.tokenizers.catalog import CATALOG, EMBEDDED
from hma_data.tokenizers.checkpoints import read_weights, save_weights
from hma_data.tokenizers.embedded import FsqAutoencoder, Quantizer
from hma_data.tokenizers.shapes import FsqConfig, VaeConfig, get_spec
from hma_data.tokenizers.training.eval import CodebookUse, evaluate, psnr_db, ssim, to_markdown
from hma_data.tokenizers.training.frames import read_films
from hma_data.tokenizers.training.recipe import load_recipe
from tests.data.fresh import run_fresh
from tests.data.tokenizer_files import assert_contract, scenes, write_tiny_whole

FORMAT, WEIGHTS = FsqConfig.format, EMBEDDED / "fsq.safetensors"
SMALL = FsqConfig(width=(8, 8), hidden=8, encoder_blocks=(1, 1), decoder_blocks=(1, 1, 1), fine_width=4)


@pytest.fixture(scope="module")
def fsq8() -> Tokenizer:
    return get_tokenizer("fsq-8")


HERE = [name for name, entry in CATALOG.items() if entry.weights in ("embedded", "none")]


def test_the_spec_of_embedded_weights_needs_no_torch() -> None:
    run_fresh(
        "import sys; from hma_data.conversion.job import get_spec\n"
        "assert get_spec('fsq-16').grid == (16, 16) and 'torch' not in sys.modules"
    )


def test_a_name_may_end_in_another_filter_for_resizing() -> None:
    usual, other = get_tokenizer("raw-64"), get_tokenizer("raw-64:antialias")
    assert other.spec == replace(usual.spec, resize_filter="antialias") and usual.spec != other.spec
    for name in (other.spec.name, "fsq-8"):
        assert get_spec(f"{name}:antialias") == get_tokenizer(f"{name}:antialias").spec
    assert get_tokenizer(full_name(other.spec.to_json())).spec == other.spec
    with pytest.raises(TokenizerError, match="has no filter 'cubic' for .* — write raw-64:area"):
        get_spec("raw-64:cubic")


@pytest.mark.slow  # a process that imports torch
def test_the_spec_of_a_file_of_weights_is_read_without_torch_in_this_process(tmp_path: Path) -> None:
    path = write_tiny_whole(tmp_path / "taesd.safetensors")
    digest = get_tokenizer("taesd", weights=path).spec.digest
    run_fresh(
        "import sys\n"
        "from hma_data.errors import TokenizerError\n"
        "from hma_data.tokenizers.shapes import get_spec\n"
        f"path = {str(path)!r}\n"
        f"assert get_spec('taesd', weights=path).digest == {digest!r}\n"
        "try: get_spec('magvit2', weights=path)\n"
        "except TokenizerError as fault: assert path in str(fault)\n"
        "else: raise AssertionError\n"
        "assert 'torch' not in sys.modules"
    )


@pytest.mark.parametrize("name", HERE)
def test_every_tokenizer_keeps_the_contract(name):
    tokenizer = get_tokenizer(name)
    assert tokenizer.spec.name == name and get_spec(name) == tokenizer.spec
    frames = scenes(3, tokenizer.spec.image_size)
    assert psnr_db(frames, assert_contract(tokenizer, frames)).mean() > 20


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("name", ["fsq-8", "vae-8"])
def test_a_frame_has_the_same_tokens_in_any_batch(name):
    tokenizer = get_tokenizer(name)
    frames = scenes(7, tokenizer.spec.image_size)
    order = np.random.default_rng(0).permutation(7)
    whole = tokenizer.encode(np.concatenate([frames, frames[order]]))
    assert np.array_equal(whole[order], whole[7:])
    parts = [tokenizer.encode(frames[start:stop]) for start, stop in ((0, 1), (1, 6), (6, 7))]
    assert np.array_equal(np.concatenate(parts), whole[:7])


@pytest.mark.parametrize(("name", "count"), [("fsq-8", 8), ("fsq-16", 3), ("vae-8", 3)])
def test_a_frame_has_the_same_latents_to_the_last_bit_on_any_number_of_threads(name, count, threads):
    # Ids alone would hide it: one latent in a million lies so near a border that its last bits count.
    tokenizer = get_tokenizer(name)
    frames = scenes(4, tokenizer.spec.image_size)
    seen: list[torch.Tensor] = []
    hook = tokenizer.network.encoder.register_forward_hook(lambda *call: seen.append(call[-1].clone()))
    threads(1)
    alone = tokenizer.encode(frames)
    threads(count)
    assert np.array_equal(tokenizer.encode(frames), alone)
    hook.remove()
    one, many = ({z.numpy().tobytes() for z in half} for half in (seen[:4], seen[4:]))
    assert len(one) == 4 and one == many


@pytest.mark.parametrize("name", ["fsq-8", "vae-8"])
def test_a_frame_has_the_same_tokens_however_it_lies_in_memory(name):
    tokenizer = get_tokenizer(name)
    frames = scenes(3, tokenizer.spec.image_size)
    whole = tokenizer.encode(frames)
    wide = np.zeros((3, *frames.shape[1:3], 5), np.uint8)
    wide[..., 1:4] = frames
    planes = np.ascontiguousarray(frames.transpose(0, 3, 1, 2)).transpose(0, 2, 3, 1)
    frozen = frames.copy()
    frozen.flags.writeable = False
    for same in (wide[..., 1:4], planes, frozen, frames[::-1][::-1]):
        assert np.array_equal(tokenizer.encode(same), whole)


def test_tokens_decode_to_the_same_pixels_in_any_batch(fsq8):
    tokens = np.random.default_rng(2).integers(0, 2**18, (12, 8, 8))
    parts = [fsq8.decode(tokens[start:stop]) for start, stop in ((0, 1), (1, 4), (4, 12))]
    assert np.array_equal(np.concatenate(parts), fsq8.decode(tokens))


def test_threads_may_encode_at_the_same_time(fsq8, threads):
    threads(2)
    frames = scenes(12, 128)
    whole = fsq8.encode(frames)
    with ThreadPoolExecutor(3) as pool:
        parts = list(pool.map(fsq8.encode, [frames[:4], frames[4:8], frames[8:]]))
    assert np.array_equal(np.concatenate(parts), whole)


@pytest.mark.parametrize("levels", [((8, 8, 8), (8, 8, 8)), ((16, 4), (3,))])
def test_ids_and_levels_are_one_to_one(levels):
    quantizer = Quantizer(FsqConfig(levels=levels))
    count = int(np.prod(quantizer.sizes))
    ids = torch.arange(count).view(1, 1, count)
    assert torch.equal(quantizer.to_ids(quantizer.to_digits(ids)), ids)


def test_the_low_digit_is_made_of_the_first_channels():
    quantizer = Quantizer(FsqConfig())
    levels = torch.zeros(1, 6, 1, 2)
    levels[0, :3, 0, 0] = torch.tensor([1.0, 2.0, 3.0])
    levels[0, 3:, 0, 1] = torch.tensor([4.0, 5.0, 6.0])
    low, high = 1 + 2 * 8 + 3 * 64, 4 + 5 * 8 + 6 * 64
    assert quantizer.to_ids(levels).tolist() == [[[low, 512 * high]]]


def test_every_level_is_equally_likely_for_normal_latents():
    quantizer = Quantizer(FsqConfig())
    latents = torch.randn(40, 6, 50, 50, generator=torch.Generator().manual_seed(0))
    share = torch.bincount(quantizer.to_levels(latents).flatten().long(), minlength=8) / latents.numel()
    assert torch.allclose(share, torch.full((8,), 1 / 8), atol=2e-3)


def test_levels_stay_in_range_for_extreme_latents():
    quantizer = Quantizer(FsqConfig())
    latents = torch.tensor([-1e30, -9.0, 9.0, 1e30]).view(4, 1, 1, 1).expand(4, 6, 1, 1)
    levels = quantizer.to_levels(latents)[:, 0, 0, 0].tolist()
    assert levels == [0, 0, 7, 7]


def test_quantisation_passes_the_gradient_of_the_squashing():
    quantizer = Quantizer(FsqConfig())
    latents = torch.linspace(-2, 2, 24).view(4, 6, 1, 1).requires_grad_()
    quantizer(latents).sum().backward()
    expected = torch.exp(-(latents.detach() ** 2) / 2) * (2 / np.pi) ** 0.5  # derivative of erf(z/√2)
    assert latents.grad is not None and torch.allclose(latents.grad, expected, atol=1e-6)


@pytest.mark.parametrize(
    "frames",
    [
        np.zeros((2, 256, 256, 3), np.uint8),
        np.zeros((2, 128, 128, 3), np.float32),
        np.zeros((128, 128, 3), np.uint8),
        np.zeros((2, 128, 128, 4), np.uint8),
    ],
)
def test_frames_of_another_size_or_dtype_are_refused(fsq8, frames):
    with pytest.raises(TokenizerError, match="takes uint8 images"):
        fsq8.encode(frames)


@pytest.mark.parametrize(
    ("name", "tokens", "said"),
    [
        *(("fsq-8", np.eye(8, dtype=np.int64)[None] * bad, "262143") for bad in (2**18, 2**32 - 1, -1)),
        ("fsq-8", np.zeros((1, 16, 16), np.uint32), "decodes"),
        ("fsq-8", np.zeros((1, 8, 8), np.float32), "decodes"),
        ("raw", np.zeros((1, 3, 256, 256), np.float32), "float32"),
        ("vae-8", np.zeros((1, 4, 16, 16), np.float16), "decodes"),
        ("vae-8", np.zeros((1, 4, 32, 32), np.uint8), "decodes"),
        ("vae-8", np.full((1, 4, 32, 32), np.nan, np.float16), "decodes finite"),
        ("vae-8", np.full((1, 4, 32, 32), np.inf, np.float32), "decodes finite"),
    ],
)
def test_ids_outside_the_vocabulary_and_another_grid_or_kind_are_refused(name, tokens, said):
    with pytest.raises(TokenizerError, match=said):
        get_tokenizer(name).decode(tokens)


@pytest.mark.parametrize(
    ("name", "given", "said"),
    [
        ("fsq-17", {}, "fsq-16"),  # one of those that there are
        ("fsq-8", {"device": "abacus"}, "abacus"),
        ("fsq-8", {"weights": "gone.safetensors"}, r"gone\.safetensors"),
        ("magvit2", {"weights": "gone.ckpt"}, r"gone\.ckpt: no such file"),
    ],
)
def test_what_is_not_there_is_named(name, given, said):
    with pytest.raises(TokenizerError, match=said):
        get_tokenizer(name, **given)


@pytest.mark.parametrize(
    ("write", "said"),
    [
        *((lambda path, keep=keep: path.write_bytes(WEIGHTS.read_bytes()[:keep]), "safetensors")
          for keep in (0, 4, 100, 5000, -1)),
        (lambda path: torch.save({"encoder": torch.zeros(2)}, path), "not a complete safetensors file"),
        (lambda path: save_file({"conv.weight": torch.zeros(3, 3)}, path, {"format": "pt"}), "hma-fsq-1"),
    ],
    ids=["cut at 0", "cut at 4", "cut at 100", "cut at 5000", "last byte cut", "pickle", "architecture"],
)  # fmt: skip
def test_a_file_of_other_than_whole_weights_is_refused(tmp_path, write, said):
    write(tmp_path / "other.safetensors")
    with pytest.raises(TokenizerError, match=said):
        get_tokenizer("fsq-8", weights=str(tmp_path / "other.safetensors"))


LIES = [{"width": [64, 256]}, {"levels": [[1]]}, {"levels": [[4096] * 9]}, {"hidden": "many"}, {"width": 3}]
VAE_LIES = [{"width": 64}, {"decoder_blocks": [1]}, {"noise": float("nan")}, {"latent_scale": 0}]


@pytest.mark.parametrize(
    ("kind", "change"), [*((FsqConfig, lie) for lie in LIES), *((VaeConfig, lie) for lie in VAE_LIES)]
)
def test_weights_whose_config_lies_are_refused(tmp_path, kind, change):
    path, name = tmp_path / "lying.safetensors", "fsq" if kind is FsqConfig else "vae"
    config, tensors, _ = read_weights(EMBEDDED / f"{name}.safetensors", kind.format, kind)
    values = json.dumps(config.model_dump() | change)
    save_file(tensors, path, {"format": kind.format, "config": values})
    with pytest.raises(TokenizerError, match="does not fit the network|does not describe the network"):
        get_tokenizer(f"{name}-8", weights=str(path))


def test_weights_that_are_not_finite_are_refused(tmp_path):
    path = tmp_path / "damaged.safetensors"
    tensors = dict(FsqAutoencoder(SMALL).named_parameters())
    tensors["decoder.head.bias"] = torch.full((48,), torch.nan)
    save_weights(path, FORMAT, SMALL, tensors, {})
    with pytest.raises(TokenizerError, match=r"decoder\.head\.bias holds values that are not finite"):
        get_tokenizer("fsq-8", weights=str(path))


def test_other_weights_are_another_tokenizer(tmp_path, fsq8):
    path = tmp_path / "small.safetensors"
    save_weights(path, FORMAT, SMALL, dict(FsqAutoencoder(SMALL).named_parameters()), {})
    other = get_tokenizer("fsq-8", weights=str(path))
    assert other.spec.digest != fsq8.spec.digest and get_spec("fsq-8", weights=path) == other.spec
    assert other.encode(scenes(2, 128)).shape == (2, 8, 8)


@pytest.mark.parametrize("name", ["fsq", "vae"])
def test_the_shipped_weights_are_of_the_shipped_recipe(name):
    from safetensors import safe_open

    with safe_open(EMBEDDED / f"{name}.safetensors", "pt") as file:
        facts = json.loads(file.metadata()["training"])
    recipe = load_recipe(shipped("recipes") / "tokenizer" / f"{name}.yaml")
    assert facts["recipe_sha256"] == recipe.digest()
    assert (facts["steps"], facts["seed"]) == (recipe.training.steps, recipe.seed)
    assert len(facts["corpus_sha256"]) == 64 and facts["seconds"] > 0 and facts["machine"]


def test_weights_hold_nothing_but_the_network():
    config, _, _ = read_weights(WEIGHTS, FORMAT, FsqConfig)
    expected = {name: tuple(p.shape) for name, p in FsqAutoencoder(config).named_parameters()}
    assert {name: tuple(t.shape) for name, t in load_file(WEIGHTS).items()} == expected


def test_ssim_and_psnr_agree_with_scikit_image():
    from skimage import metrics

    true = scenes(2, 64)
    noise = np.random.default_rng(1).normal(0, 20, true.shape)
    made = np.clip(true + noise, 0, 255).astype(np.uint8)
    for index in range(2):
        grey = [(x[index] / 255.0) @ [0.299, 0.587, 0.114] for x in (true, made)]
        theirs = metrics.structural_similarity(
            *grey, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
        )
        assert ssim(true, made)[index] == pytest.approx(theirs, abs=1e-6)
        theirs = metrics.peak_signal_noise_ratio(true[index], made[index])
        assert psnr_db(true, made)[index] == pytest.approx(theirs)


def test_codebook_use_of_known_ids(fsq8):
    use = CodebookUse(fsq8.spec)
    use.add(np.array([[[0, 1], [512, 513]]]))
    result = use.result()
    assert result["digit_use"] == [round(2 / 512, 4)] * 2
    assert result["joint_perplexity"] == 4 and result["entropy_bits_per_token"] == 2


def test_codebook_use_of_a_vocabulary_of_billions():
    spec = get_spec("palette-64")
    use = CodebookUse(spec)
    for last in (0, spec.vocab_size - 1):
        use.add(np.array([[[0, 1], [254, last]]], np.uint32))
    result = use.result()
    assert (
        result["joint_used_ids"] == 4 and result["digit_use"] == [round(3 / 255, 4)] + [round(2 / 255, 4)] * 3
    )


def test_evaluation_does_not_depend_on_how_frames_are_batched(fsq8):
    frames = scenes(5, 128)
    single, whole = evaluate(fsq8, iter(frames), worst=2), evaluate(fsq8, [frames], worst=2)
    for key in ("frames", "psnr_db", "ssim", "digit_use", "joint_perplexity"):
        assert single[key] == whole[key]
    value, index, true, made = whole["worst_frames"][0]
    assert value == pytest.approx(whole["psnr_db_min"], abs=1e-3)
    assert np.array_equal(true, frames[index]) and made.shape == true.shape


def test_raw_is_measured_as_lossless():
    result = evaluate(get_tokenizer("raw"), [scenes(1, 256)])
    assert result["psnr_db"] == 99 and result["ssim"] == pytest.approx(1)
    assert result["bits_per_frame"] == 256 * 256 * 24
    assert "| raw |" in to_markdown({"raw": result})


def test_no_frames_cannot_be_measured(fsq8, tmp_path):
    with pytest.raises(TokenizerError, match="no frame"):
        evaluate(fsq8, [])
    with pytest.raises(TokenizerError, match="no image"):
        list(read_films(tmp_path, 128))


@pytest.mark.real
@pytest.mark.parametrize(("name", "psnr_db", "ssim"), [("fsq-16", 26.0, 0.83), ("vae-8", 30.0, 0.92)])
def test_real_robot_frames_come_back_as_promised(real_data, name, psnr_db, ssim):
    video = min((real_data / "lerobot" / "g1_v21" / "videos").rglob("*.mp4"))
    result = evaluate(get_tokenizer(name), read_films(video, 256, frames=4))
    assert result["psnr_db"] >= psnr_db and result["ssim"] >= ssim


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_a_gpu_that_is_not_there_is_one_line_without_an_address() -> None:
    with pytest.raises(TokenizerError, match="cannot run on device 'cuda': .* — use --device cpu") as fault:
        get_tokenizer("fsq-8", device="cuda")
    assert "http" not in str(fault.value) and "\n" not in str(fault.value)
