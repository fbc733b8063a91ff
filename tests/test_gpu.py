"""What a GPU computes is what a CPU does, within the rounding of its arithmetic: `pytest -m gpu`."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hma_data import lab
from hma_data.conversion.job import convert
from hma_data.lab import family
from hma_data.loading.dataset import Batch
from hma_data.shards.reader import ShardSet
from hma_data.tokenizers.base import get_tokenizer
from hma_model.checkpoint.folder import resolve
from hma_model.cli import main
from hma_model.evaluation.losses import validation_losses, windows
from hma_model.generation.rollout import Rollout
from hma_model.network.masking import VideoMask, corrupt_tokens
from hma_model.network.model import HMA
from hma_model.network.trunks.transformer import attend
from hma_model.training.logging import read_metrics
from hma_model.training.loop import train
from hma_model.training.recipe import make_recipe
from tests.model.network_parts import small_batch, small_model
from tests.model.runs import TINY, weights
from tests.model.shards import make_shards

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU"),
    pytest.mark.xdist_group("gpu"),
]
GPU = "cuda"
ROBOTS = ["arm", "hand.v1", "arm"]
KINDS = ["discrete", "continuous"]


def frames_of(batch: Batch, kind: str = "discrete") -> torch.Tensor:
    frames = batch.tokens if kind == "discrete" else batch.latents
    assert frames is not None
    return frames


@pytest.mark.parametrize("masked", [True, False])
def test_more_sequences_than_a_kernel_takes_are_attended(masked: bool) -> None:
    mask = torch.ones(6, 6, dtype=torch.bool).tril() if masked else None
    q, k, v = torch.randn(3, 70_000, 1, 6, 8)
    on_gpu = [x.to(GPU).requires_grad_() for x in (q, k, v)]
    there = attend(on_gpu[0], on_gpu[1], on_gpu[2], None if mask is None else mask.to(GPU), 0.4)
    there.sum().backward()
    assert torch.allclose(there.cpu(), attend(q, k, v, mask, 0.4), atol=1e-4)


@pytest.fixture(autouse=True)
def exact_products() -> None:
    """Compare float32 with float32: no test here lets products be rounded to TF32."""
    assert torch.get_float32_matmul_precision() == "highest"


@pytest.mark.parametrize("objective", ["forward", "policy", "inverse", "full"])
@pytest.mark.parametrize("way", ["window", "pairs"])
@pytest.mark.parametrize("kind", KINDS)
def test_losses_and_gradients_are_those_of_a_cpu(kind: str, way: str, objective: str) -> None:
    found = []
    for device in ("cpu", GPU):
        model = small_model(kind=kind, training_pass=way, objectives={objective: 1.0}, corrupt_max=0.0)
        model = model.to(device).train()
        batch = small_batch(model.config, ROBOTS).to(torch.device(device))
        loss = model(batch, objective, torch.Generator().manual_seed(3)).loss
        loss.backward()
        found.append(
            (
                float(loss.detach()),
                {n: p.grad.cpu() for n, p in model.named_parameters() if p.grad is not None},
            )
        )
    (here, mine), (there, theirs) = found
    assert there == pytest.approx(here, rel=1e-4)
    assert mine.keys() == theirs.keys()
    for name, gradient in mine.items():
        assert torch.allclose(theirs[name], gradient, rtol=1e-2, atol=1e-4), name


def test_digits_are_corrupted_at_the_given_rate_by_draws_that_repeat() -> None:
    config = small_model().config
    tokens = torch.zeros(64, 5, 16, dtype=torch.int64, device=GPU)
    mask = VideoMask(torch.zeros(64, 5, 16, dtype=torch.bool), torch.full((64, 5), 0.3))
    one, again, other = (
        corrupt_tokens(config, tokens, mask, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)
    )
    assert torch.equal(one, again) and not torch.equal(one, other)
    low = one % config.digits[0]
    assert float((low != 0).float().mean()) == pytest.approx(0.3 * (1 - 1 / config.digits[0]), abs=0.03)


@pytest.mark.parametrize("cache", [True, False])
@pytest.mark.parametrize("options", [{}, {"digit_order": "chain"}, {"copy_previous": True}], ids=str)
def test_the_likeliest_tokens_are_those_of_a_cpu(options: dict[str, Any], cache: bool) -> None:
    made = []
    for device in ("cpu", GPU):
        model = small_model(**options).to(device)
        batch = small_batch(model.config, ROBOTS, frames=9)
        frames = model.generate(
            frames_of(batch)[:, :3],
            batch.actions,
            ROBOTS,
            6,
            temperature=0.0,
            cache=cache,
            order="confidence",
        )
        assert frames.device.type == device
        made.append(frames.cpu())
    assert (made[0] == made[1]).float().mean() >= 0.98  # a tie of two values may fall either way


def test_latents_are_drawn_as_on_a_cpu() -> None:
    made = []
    for device in ("cpu", GPU):
        model = small_model(kind="continuous").to(device)
        batch = small_batch(model.config, ROBOTS, frames=9)
        generator = torch.Generator().manual_seed(5)
        prompt = frames_of(batch, "continuous")[:, :3]
        frames = model.generate(prompt, batch.actions, ROBOTS, 4, generator=generator)
        made.append(frames.cpu())
    assert torch.allclose(made[0], made[1], rtol=1e-2, atol=1e-2)


def test_a_draw_repeats_and_a_row_does_not_depend_on_those_beside_it() -> None:
    model = small_model().to(GPU)
    batch = small_batch(model.config, ROBOTS, frames=9)

    def draw(rows: list[int]) -> torch.Tensor:
        rollout = Rollout(model, [ROBOTS[row] for row in rows], len(rows), temperature=0.7)
        rollout.prompt(frames_of(batch)[rows, :3], batch.actions[rows], seeds=rows)
        return torch.stack([rollout.step(batch.actions[rows, i]) for i in range(2, 8)], dim=1)

    whole = draw([0, 1, 2])
    assert torch.equal(whole, draw([0, 1, 2]))
    assert (whole[1] == draw([1])[0]).float().mean() >= 0.98


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("precision", ["float32", "bf16"])
def test_a_compiled_rollout_makes_the_frames_of_the_plain_one(kind: str, precision: str) -> None:
    model = small_model(kind=kind).to(GPU)
    batch = small_batch(model.config, ROBOTS[:1], frames=12)
    prompt = frames_of(batch, kind)[:, :3]
    order = "confidence" if kind == "discrete" else "random"
    given: dict[str, Any] = {"temperature": 0.0, "order": order, "precision": precision}
    made = [
        model.generate(
            prompt, batch.actions, "arm", 9, compile=on, generator=torch.Generator().manual_seed(1), **given
        ).cpu()
        for on in (False, True)
    ]
    if kind == "discrete":
        assert (made[0] == made[1]).float().mean() >= (0.98 if precision == "float32" else 0.6)
    else:
        assert torch.allclose(made[0], made[1], atol=0.02 if precision == "float32" else 0.5)


@pytest.mark.parametrize("name", ["fsq-lab", "fsq-16", "vae-8"])
def test_a_tokenizer_encodes_and_decodes_as_on_a_cpu(name: str) -> None:
    here, there = get_tokenizer(name), get_tokenizer(name, device=GPU)
    size = here.spec.image_size
    frames = np.zeros((5, size, size, 3), np.uint8)
    for number, frame in enumerate(frames):
        frame[..., 0] = np.roll(np.linspace(0, 255, size), 9 * number)
        frame[size // 4 : size // 2, :, 1] = 200
    mine, theirs = here.encode(frames), there.encode(frames)
    if here.spec.kind == "discrete":
        assert (mine == theirs).mean() >= (0.99 if name == "fsq-lab" else 0.8)  # others compute in bfloat16
    else:
        assert np.abs(mine.astype(np.float32) - theirs.astype(np.float32)).mean() < 0.05 * mine.std()
    error = here.decode(mine).astype(float) - there.decode(mine).astype(float)
    assert np.abs(error).mean() < 1.0


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("shards")
    arm, hand = make_shards(folder / "arm", "arm"), make_shards(folder / "hand", "hand", dims=3, seed=1)
    return [str(arm), str(hand)]


@pytest.mark.parametrize("optimizer", ["adamw", "muon"])
def test_a_run_has_the_curve_of_a_cpu_and_its_checkpoint_loads_there(shards, optimizer, tmp_path) -> None:
    given = {**TINY, "data": shards, "optimizer": optimizer, "ema": 0.5, "self_forward": 0.5}
    given["model"] = {"layers": 1, "width": 16, "heads": 2, "corrupt_max": 0.0}  # a GPU draws its own digits
    runs = [
        train(make_recipe({**given, "device": device}), out=tmp_path / device, show=False)
        for device in ("cpu", GPU)
    ]
    curves = [[loss for _, loss in run.losses] for run in runs]
    assert curves[1] == pytest.approx(curves[0], rel=1e-2)
    assert runs[1].masked_val_loss == pytest.approx(runs[0].masked_val_loss, rel=1e-2)
    assert json.loads((tmp_path / GPU / "environment.json").read_text())["device"] != "cpu"
    assert all(line["memory_mib"] > 0 for line in read_metrics(tmp_path / GPU) if line["kind"] == "train")
    loaded = HMA.from_pretrained(resolve(tmp_path / GPU))
    losses, _ = validation_losses(loaded.eval(), windows(ShardSet(shards[0]), "val", 4, 6))
    assert np.isfinite(list(losses.by_embodiment().values())).all()


def test_a_run_goes_on_where_it_was(shards: list[str], tmp_path: Path) -> None:
    recipe = make_recipe({**TINY, "data": shards, "device": GPU, "optimizer": "muon", "ema": 0.5})
    whole = train(recipe, out=tmp_path / "whole", show=False)

    def stop(facts: dict[str, Any]) -> None:
        if facts["step"] == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(recipe, out=tmp_path / "cut", show=False, on_progress=stop)
    again = train(recipe, out=tmp_path / "cut", show=False)
    assert [loss for _, loss in again.losses] == pytest.approx([loss for _, loss in whole.losses], rel=1e-3)
    one, other = weights(whole.checkpoint), weights(again.checkpoint)
    assert one.keys() == other.keys()
    assert all(torch.allclose(value.float(), other[name].float(), atol=1e-3) for name, value in one.items())


@pytest.mark.parametrize(
    "options", [{"precision": "bf16"}, {"compile": True}, {"checkpointing": True}], ids=str
)
def test_a_run_in_another_way_has_nearly_the_same_curve(shards, options, tmp_path) -> None:
    given = {**TINY, "data": shards, "device": GPU}
    usual, other = (
        train(make_recipe({**given, **more}), out=tmp_path / name, show=False)
        for name, more in (("usual", {}), ("other", options))
    )
    assert [loss for _, loss in other.losses] == pytest.approx([loss for _, loss in usual.losses], rel=0.05)


@pytest.fixture(scope="module")
def sliders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder, robot = tmp_path_factory.mktemp("sliders"), family.embodiment("rails_03")
    recording = lab.record("rails_03", folder / "recording", 3, 0)
    for device in ("cpu", GPU):
        convert(robot, recording, "fsq-lab", folder / device, device=device)
    return {device: folder / device for device in ("cpu", GPU)}


def test_shards_made_on_a_gpu_hold_the_tokens_of_a_cpu(sliders: dict[str, Path]) -> None:
    (mine,), (theirs,) = (windows(ShardSet(sliders[d]), "train", 8, 8) for d in ("cpu", GPU))
    assert (frames_of(mine) == frames_of(theirs)).float().mean() >= 0.98
    assert torch.equal(mine.actions, theirs.actions)


def test_the_embedded_model_is_evaluated_and_generates_on_a_gpu(sliders, tmp_path) -> None:
    shards, found = str(sliders["cpu"]), []
    for device in ("cpu", GPU):
        words = ["embedded", shards, "--split", "train", "--windows", "8", "--device", device]
        assert main(["evaluate", *words, "--out", str(tmp_path / device)]) == 0
        found += json.loads((tmp_path / device / "results.json").read_text())["results"]
    assert found[1]["loss"] == pytest.approx(found[0]["loss"], rel=1e-3)
    assert found[1]["shuffled_loss"] == pytest.approx(found[0]["shuffled_loss"], rel=1e-3)
    film = tmp_path / "film.mp4"
    assert main(["generate", "embedded", shards, "--device", GPU, "--out", str(film)]) == 0
    assert film.stat().st_size > 1000
