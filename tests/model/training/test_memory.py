"""The estimate of a training's memory: near what is measured, and refused with keys that make it fit."""

import json
import subprocess
import sys

import pytest
import torch

from hma_data.errors import RecipeError, TrainingError
from hma_data.loading.rows import Batch
from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.shapes import get_spec
from hma_model.config import OBJECTIVES, ActionSpace
from hma_model.network.model import HMA
from hma_model.training import memory
from hma_model.training.loop import train
from hma_model.training.memory import activation_bytes, memory_errors, needed_bytes, require_memory
from hma_model.training.recipe import Recipe, load_recipe, make_recipe, parse_overrides
from tests.model.shards import make_shards

CPU = torch.device("cpu")
TOKENS = TokenizerSpec("fsq-16", 1, "discrete", 256, (16, 16), vocab_size=64**2, factored=(64, 64))
LAB = TokenizerSpec("fsq-lab", 1, "discrete", 128, (16, 16), vocab_size=8**5, factored=(8,) * 5)
PIXELS = TokenizerSpec.continuous("raw-128", 1, 128, 1, 3, latent_scale=1 / 255, dtype="uint8")
COLORS = get_spec("palette-64")
LATENTS = TokenizerSpec("vae-8", 1, "continuous", 256, (32, 32), channels=4, dtype="float16")
MEASURE = """
import json, sys, torch
from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.shapes import get_spec
from hma_model.training.recipe import make_recipe
from tests.model.training.test_memory import forward, network
recipe, spec = make_recipe(json.loads(sys.argv[1])), TokenizerSpec.from_json(json.loads(sys.argv[2]))
def peak():  # getrusage would begin with the peak of the process that started this one
    with open("/proc/self/status") as file:
        return 1024 * next(int(line.split()[1]) for line in file if line.startswith("VmHWM"))
before = peak()
model = network(recipe, spec, "cpu").train()
model.trunk.checkpointing = recipe.checkpointing
optimizer = torch.optim.AdamW(model.parameters())
for _ in range(2):
    forward(model, recipe).backward()
    optimizer.step()
    optimizer.zero_grad(set_to_none=True)
print(peak() - before)
"""


def network(recipe: Recipe, spec: TokenizerSpec, device: str = "meta") -> HMA:
    with torch.device(device):
        model = HMA(recipe.network(spec))
        model.add_embodiment(ActionSpace("arm", 7, 1, (0.0,) * 7, (1.0,) * 7, (True,) * 7))
    return model


def forward(model: HMA, recipe: Recipe) -> torch.Tensor:
    windows, frames = recipe.batch_size, recipe.frames
    shape = (windows, frames, *model.config.frame_shape)
    if model.config.kind == "continuous":
        seen = {"latents": torch.zeros(shape)}
    else:
        seen = {"tokens": torch.zeros(shape, dtype=torch.int64)}
    present = torch.ones(windows, frames, dtype=torch.bool)
    batch = Batch(["arm"] * windows, torch.zeros(windows, frames, 7), present, **seen)
    (objective,) = recipe.objectives
    with torch.autocast("cpu", torch.bfloat16, enabled=recipe.precision == "bf16"):
        return model(batch, objective, torch.Generator().manual_seed(0)).loss


SMALL = {"model": {"layers": 4, "width": 192}}
PAIRS = {"model": {"layers": 6, "width": 192, "training_pass": "pairs"}}
DIFFUSION = {"model": {"layers": 4, "width": 128, "diffusion_width": 512}, "batch_size": 8}
# Of enough windows that the passes outweigh what the process itself takes, which varies from run to run.
UNET = load_recipe("unet_tiny", ["frames=6", "batch_size=12"]).values()
WHOLE = load_recipe("unet_colors", ["frames=6", "batch_size=8", "model.crop=0"]).values()
MEASURED = [
    (TOKENS, SMALL),
    (PIXELS, UNET),
    (COLORS, WHOLE),
    (TOKENS, {"model": {"layers": 8, "width": 256}, "checkpointing": True}),
    (TOKENS, PAIRS),
    (LATENTS, DIFFUSION),
]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="peaks are read from /proc")
@pytest.mark.parametrize(("spec", "changes"), MEASURED)
def test_the_estimate_is_near_the_measured_peak(spec, changes):
    recipe = {"frames": 12, "batch_size": 3, "objectives": {"forward": 1}, **changes}
    words = [sys.executable, "-c", MEASURE, json.dumps(recipe), json.dumps(spec.to_json())]
    made = subprocess.run(words, capture_output=True, text=True, check=True)
    asked = make_recipe(recipe)
    estimate, measured = needed_bytes(network(asked, spec), asked, CPU), float(made.stdout.split()[-1])
    assert 0.7 < estimate / measured < 1.5, (estimate / memory.GIB, measured / memory.GIB)


@pytest.mark.parametrize(
    ("spec", "changes"),
    [(TOKENS, {"model": {"layers": 6, "width": 64}}), (LATENTS, DIFFUSION), (PIXELS, UNET), (COLORS, WHOLE)],
)
def test_the_estimate_of_a_pass_is_near_what_it_keeps_for_its_backward_pass(spec, changes):
    recipe = make_recipe({"objectives": {"forward": 1}, **changes, "frames": 4, "batch_size": 1})
    model = network(recipe, spec, "cpu").train()
    kept = {parameter.untyped_storage().data_ptr(): 0 for parameter in model.parameters()}

    def note(tensor: torch.Tensor) -> torch.Tensor:
        storage = tensor.untyped_storage()
        kept.setdefault(storage.data_ptr(), storage.nbytes())
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
        forward(model, recipe)
    assert 0.5 < activation_bytes(model.config, recipe, 1, CPU) / sum(kept.values()) < 2


@pytest.mark.parametrize(("spec", "changes"), [(TOKENS, SMALL), (COLORS, WHOLE)])
def test_a_finetuning_with_shorter_windows_than_its_checkpoint_keeps_less(spec, changes):
    recipe = make_recipe({"objectives": {"forward": 1}, **changes, "frames": 12})
    config, shorter = recipe.network(spec), recipe.model_copy(update={"frames": 4})
    assert activation_bytes(config, shorter, 1, CPU) < 0.5 * activation_bytes(config, recipe, 1, CPU)


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize(
    ("name", "spec"),
    [
        ("discrete_tiny", LAB),
        ("discrete_tiny", TOKENS),
        ("continuous_tiny", LATENTS),
        ("unet_tiny", PIXELS),
        ("unet_colors", COLORS),
    ],
)
def test_recipes_for_laptops_run_on_laptops(name, spec, objective):
    reads = name == "unet_colors" and OBJECTIVES[objective].readout  # no squares: fewer windows
    whole = ["model.crop=0", "batch_size=8"] if reads else []
    recipe = load_recipe(name, [f"objectives={{{objective}: 1}}", *whole])
    assert needed_bytes(network(recipe, spec), recipe, CPU) < 2 * memory.GIB


@pytest.mark.parametrize("name", ["discrete_base", "continuous_base"])
@pytest.mark.parametrize("free", [8, 64])
def test_what_does_not_fit_is_refused_with_keys_that_make_it_fit(name, free, monkeypatch):
    spec = TOKENS if name.startswith("discrete") else LATENTS
    monkeypatch.setattr(memory, "free_bytes", lambda device: free * memory.GIB)
    recipe = load_recipe(name)
    with torch.device("meta"), pytest.raises(RecipeError, match=r"needs about .* are free — set ") as refused:
        require_memory(network(recipe, spec), recipe, CPU)
    keys = refused.value.remedy.removeprefix("set ").split()
    smaller = make_recipe({**recipe.values(), **parse_overrides(keys)})
    assert smaller.windows_per_step == recipe.windows_per_step
    with torch.device("meta"):
        require_memory(network(smaller, spec), smaller, CPU)


@pytest.mark.parametrize("name", ["discrete_base", "continuous_base"])
def test_a_pass_that_finds_no_memory_names_the_batch_that_would_fit(name, monkeypatch):
    spec = TOKENS if name.startswith("discrete") else LATENTS
    recipe = load_recipe(name)
    model = network(recipe, spec)
    there = needed_bytes(model, recipe.model_copy(update={"batch_size": 2}), CPU)
    monkeypatch.setattr(memory, "free_bytes", lambda device: there)
    text = "CUDA out of memory. Tried to allocate 20.00 MiB"
    with (
        pytest.raises(TrainingError, match="memory: too little .* 20.00 MiB — set ") as refused,
        memory_errors(model, recipe, CPU),
    ):
        raise torch.OutOfMemoryError(text)
    keys = refused.value.remedy.removeprefix("set ").split()
    smaller = make_recipe({**recipe.values(), **parse_overrides(keys)})
    assert (smaller.batch_size, smaller.windows_per_step) == (2, recipe.windows_per_step)
    with pytest.raises(RuntimeError, match="another"), memory_errors(model, recipe, CPU):
        raise RuntimeError("another fault")


def test_a_network_that_no_batch_makes_fit_is_refused_before_anything_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "free_bytes", lambda device: memory.GIB)
    shards = make_shards(tmp_path / "arm", "arm")
    recipe = load_recipe("discrete_xl", [f"data=[{shards}]", "device=cpu", "batch_size=1", "workers=0"])
    with pytest.raises(RecipeError, match="recipe: memory: needs about .* use a smaller network"):
        train(recipe, out=tmp_path / "run", show=False)
    assert not (tmp_path / "run").exists()
