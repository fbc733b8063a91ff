"""The training loop: it learns, survives kills, refuses what has changed, and names what is broken."""

import itertools
import json
import math
import os
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from hma_data.errors import CheckpointError, OutputError, RecipeError, ShardError, TrainingError, UsageError
from hma_data.shards.reader import ShardSet
from hma_data.tokenizers.base import TokenizerSpec
from hma_model.checkpoint import io as checkpoint
from hma_model.config import HMAConfig
from hma_model.evaluation import evaluate
from hma_model.evaluation.rollout_video import rollout_video
from hma_model.generation.decode import cameras_for, decode
from hma_model.network.model import HMA
from hma_model.training.logging import read_metrics
from hma_model.training.loop import train
from hma_model.training.recipe import make_recipe
from hma_model.training.resume import seed_for
from hma_model.training.runtime import own_folder
from tests.conftest import BlockTokenizer
from tests.data.cameras import SIZES, arm, three_shards
from tests.model import shards as shard_files
from tests.model.runs import TINY, same, train_until
from tests.model.shards import make_shards


@pytest.mark.slow
def test_training_beats_what_ignoring_everything_reaches(recipe, tmp_path):
    data = [str(make_shards(tmp_path / "arm", "arm", episodes=60, length=32))]
    network = {"layers": 2, "width": 32, "heads": 2}
    result = train(
        recipe(data=data, steps=150, lr=5e-3, warmup=10, batch_size=16, model=network, eval_every=0),
        out=tmp_path / "run",
        show=False,
    )
    assert result.masked_val_loss < 0.9 * result.baseline
    losses = [loss for _, loss in result.losses]
    assert np.mean(losses[-10:]) < np.mean(losses[:10])


def test_the_result_is_a_checkpoint_with_cards_and_the_statistics_of_the_shards(tiny_run, data):
    opened, model = checkpoint.Checkpoint.open(tiny_run.checkpoint), checkpoint.load(tiny_run.checkpoint)
    assert set(model.embodiments) == {"arm", "hand"}
    card = opened.card("hand")
    assert card["data"] == {"episodes": 5, "frames": 120}
    assert card["metrics"]["val_loss"] > 0 and card["metrics"]["baseline_loss"] > 0
    assert card["training"] == {"steps": 6, "seed": 42}
    rows = tiny_run.evaluations[-1]["mixture"]
    assert sum(row["realised"] for row in rows) == pytest.approx(1) and all(row["samples"] for row in rows)
    manifest = json.loads((Path(data[1]) / "manifest.json").read_text())
    assert model.embodiments["hand"].mean == pytest.approx(manifest["stats"]["action"]["mean"], abs=1e-6)


def test_evaluating_more_often_changes_no_weight(recipe, tmp_path):
    seldom = train(recipe(eval_every=0, checkpoint_every=0), out=tmp_path / "seldom", show=False)
    often = train(recipe(eval_every=1, checkpoint_every=1), out=tmp_path / "often", show=False)
    assert same(seldom.checkpoint, often.checkpoint)


def test_a_finished_run_is_not_begun_again(recipe, finished):
    calls = []
    again = train(recipe(), out=finished.out, show=False, on_progress=calls.append)
    assert not calls and again == finished


def test_only_the_last_checkpoints_are_kept(recipe, tmp_path):
    result = train(recipe(checkpoint_every=1, keep_last=2), out=tmp_path / "run", show=False)
    names = sorted(path.name for path in (result.out / "checkpoints").iterdir())
    assert names == ["step-00000005", "step-00000006"]


def test_force_goes_on_with_a_changed_recipe(recipe, finished, tmp_path):
    out = shutil.copytree(finished.out, tmp_path / "run")
    result = train(recipe(lr=4e-3, steps=8, batch_size=2), out=out, show=False, force=True)
    assert [step for step, _ in result.losses] == list(range(1, 9))


def test_moved_shards_are_the_same_shards(recipe, tmp_path):
    shards = make_shards(tmp_path / "arm", "arm")
    train_until(recipe(data=[str(shards)]), tmp_path / "run", 3)
    shards.rename(tmp_path / "elsewhere")
    assert train(recipe(data=[str(tmp_path / "elsewhere")]), out=tmp_path / "run", show=False).step == 6


def test_when_every_checkpoint_is_damaged_nothing_is_overwritten(recipe, tmp_path):
    result = train(recipe(keep_last=1), out=tmp_path / "run", show=False)
    (result.checkpoint / "training/optimizer.safetensors").write_bytes(b"")
    with pytest.raises(CheckpointError, match=r"optimizer.safetensors: .*no checkpoint here can be read"):
        train(recipe(keep_last=1), out=tmp_path / "run", show=False)


@pytest.fixture
def poisoned(monkeypatch):
    """The loss of window 1 of the third batch is not a number."""
    plain, calls = HMA.forward, []

    def forward(self, batch, objective=None, generator=None):
        output = plain(self, batch, objective, generator)
        if self.training:
            calls.append(batch)
            if len(calls) == 3:
                output.per_sample[1] = float("nan")
                output.loss = output.loss * float("nan")
        return output

    monkeypatch.setattr(HMA, "forward", forward)
    return calls


def test_a_loss_that_is_no_number_can_be_skipped_and_is_counted(recipe, tmp_path, poisoned):
    result = train(recipe(nonfinite="skip"), out=tmp_path / "run", show=False)
    assert (result.step, result.skipped) == (6, 1)
    weights = checkpoint.load(result.checkpoint).state_dict()
    assert all(torch.isfinite(value).all() for value in weights.values())


def test_a_budget_of_cpu_seconds_ends_the_run_and_bends_the_rate(recipe, tmp_path, monkeypatch):
    clock = itertools.count()  # every step takes one second of it
    monkeypatch.setattr(time, "process_time", lambda: float(next(clock)))
    given = {"steps": 1000, "cpu_seconds": 5.0, "warmup": 0, "schedule": "cosine", "lr_end": 0.0}
    made = recipe(**given, checkpoint_every=2, eval_every=0, report=True)
    train_until(made, tmp_path / "run", 3)
    result = train(made, out=tmp_path / "run", show=False)
    assert (result.step, result.interrupted) == (5, False)
    assert "5 of 1,000" not in (result.out / "report.html").read_text()
    rates = [line["lr"] for line in read_metrics(result.out) if line["kind"] == "train"]
    assert rates == pytest.approx([made.lr * 0.5 * (1 + math.cos(math.pi * k / 5)) for k in range(5)])


def test_a_budget_of_seconds_ends_the_run_and_its_steps_may_end_it_sooner(recipe, tmp_path):
    for seconds, steps in ((1e-9, 1), (1e9, 3)):
        result = train(recipe(steps=3, seconds=seconds), out=tmp_path / str(steps), show=False)
        assert (result.step, result.interrupted) == (steps, False)


def test_sigterm_saves_and_the_run_goes_on_bit_for_bit_with_other_workers(recipe, finished, tmp_path, capsys):
    def send(facts) -> None:
        if facts["step"] == 3:
            os.kill(os.getpid(), signal.SIGTERM)

    cut = train(recipe(checkpoint_every=0), out=tmp_path / "cut", on_progress=send)
    assert "saved at step 3; run the same command to continue" in capsys.readouterr().err
    assert cut.interrupted and cut.step == 3 and cut.checkpoint.name == "step-00000003"
    again = train(recipe(checkpoint_every=0, workers=1), out=tmp_path / "cut", show=False)
    assert not again.interrupted and again.losses == finished.losses
    assert same(finished.checkpoint, again.checkpoint)


def test_the_folder_of_something_else_is_refused(recipe, tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(OutputError, match=r"holds letter\.txt"):
        train(recipe(), out=tmp_path, show=False)


def test_two_trainings_in_one_folder_are_refused(recipe, tmp_path):
    with own_folder(tmp_path / "run"), pytest.raises(OutputError, match="another training"):
        train(recipe(), out=tmp_path / "run", show=False)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"data": []}, RecipeError, "names no shards"),
        ({"data": ["nowhere"]}, ShardError, "nowhere"),
        ({"batch_size": 1000}, RecipeError, r"1000 windows per step are more than the \d+ there are"),
        ({"frames": 20}, ShardError, "no window of 20 frames"),
        ({"device": "cuda:99"}, RecipeError, "this machine has no cuda:99"),
        ({"model": {"width": 15, "heads": 2}}, RecipeError, "heads"),
        ({"mixture": {"weights": {"leg": 2}}}, RecipeError, r"recipe: mixture\.weights: name leg.* has arm"),
        ({"mixture": {"weights": {"arm": 0, "hand": 0}}}, RecipeError, r"mixture\.weights: leave nothing"),
        ({"accumulate": 1_000_000_000}, RecipeError, r"4000000000 windows per step are more"),
        ({"model": {"width": 131_072, "layers": 9}}, RecipeError, "memory: needs about .* GiB are free"),
    ],
)
def test_what_does_not_fit_the_data_is_said_before_training(recipe, tmp_path, changes, error, message):
    with pytest.raises(error, match=message):
        train(recipe(**changes), out=tmp_path / "new/run", show=False)
    assert not (tmp_path / "new").exists()


def test_a_folder_that_was_there_stays_and_a_run_in_it_is_not_harmed(recipe, tmp_path):
    (tmp_path / "run").mkdir()
    with pytest.raises(ShardError):
        train(recipe(data=["nowhere"]), out=tmp_path / "run", show=False)
    assert list((tmp_path / "run").iterdir()) == []


@pytest.mark.parametrize("fault", [torch.OutOfMemoryError("CUDA out of memory. Tried"), MemoryError()])
def test_too_little_memory_is_said_with_what_lowers_it(recipe, tmp_path, fault):
    def fail(facts):
        raise fault

    with pytest.raises(TrainingError, match="memory: too little .* — set batch_size=2 accumulate=2$"):
        train(recipe(), out=tmp_path / "run", show=False, on_progress=fail)


def test_without_validation_windows_training_goes_on_without_evaluation(recipe, tmp_path, capsys):
    shards = make_shards(tmp_path / "arm", "arm", held_out=0)
    result = train(recipe(data=[str(shards)]), out=tmp_path / "run")
    assert result.masked_val_loss is None and result.evaluations == []
    assert "no validation windows of 4 frames: arm" in capsys.readouterr().err


def test_seeds_differ_by_purpose_and_place():
    seeds = {seed_for(0, "masks", 1), seed_for(0, "masks", 2), seed_for(0, "init"), seed_for(1, "init")}
    assert len(seeds) == 4 and all(0 <= seed < 2**63 for seed in seeds)


def test_a_continuous_model_trains(tmp_path):
    spec = TokenizerSpec(
        name="raw", version=1, kind="continuous", image_size=16, grid=(4, 4), channels=2, dtype="float16"
    )
    shards = make_shards(tmp_path / "arm", "arm", spec=spec)
    model = {**TINY["model"], "patch": 2, "diffusion_width": 16, "diffusion_depth": 1}
    result = train(
        make_recipe({**TINY, "data": [str(shards)], "model": model}), out=tmp_path / "run", show=False
    )
    assert result.step == 6 and result.masked_val_loss > 0 and result.baseline is None


@pytest.fixture
def keyed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """Shards of robots that state one stats_key, of so many action dims each."""

    def make(*dims: int) -> list[str]:
        own = shard_files.yaml
        with monkeypatch.context() as patch:
            patch.setattr(shard_files, "yaml", lambda *given, **how: own(*given, **how) + "stats_key: arms\n")
            return [
                str(make_shards(tmp_path / f"arm{i}", f"arm{i}", width, episodes=4 + 4 * i, seed=i))
                for i, width in enumerate(dims)
            ]

    return make


@pytest.mark.parametrize("ema", [0.0, 0.9])
def test_robots_of_one_stats_key_share_statistics_and_stem(recipe, keyed, tmp_path, ema) -> None:
    data = keyed(2, 2)
    given = recipe(data=data, steps=6, checkpoint_every=2, ema=ema)
    whole = Path(train(given, out=tmp_path / "whole", show=False).checkpoint)
    folders = [whole / "embodiments" / name for name in ("arm0", "arm1")]
    stems = [load_file(folder / "stem.safetensors") for folder in folders]
    assert all(torch.equal(stems[0][name], value) for name, value in stems[1].items())
    if ema:
        trained = load_file(whole / "training" / "weights.safetensors")
        assert not torch.equal(stems[0]["input.weight"], trained["stems.id_arm0.input.weight"])
    one, other = (json.loads((folder / "stats.json").read_text())["action"] for folder in folders)
    rows = np.concatenate(
        [
            shards.episode_rows(row["episode_index"])["action"]
            for shards in map(ShardSet, data)
            for row in shards.episodes.to_pylist()
            if row["split"] == "train"
        ]
    ).astype(np.float64)
    assert one == other and one["count"] == len(rows)
    for key in ("mean", "std", "min", "max"):
        np.testing.assert_allclose(one[key], getattr(rows, key)(axis=0), rtol=1e-5, atol=1e-6)
    train_until(given, tmp_path / "killed", 3)
    assert same(whole, Path(train(given, out=tmp_path / "killed", show=False).checkpoint))


def test_robots_of_one_stats_key_whose_actions_differ_are_refused(recipe, keyed, tmp_path) -> None:
    with pytest.raises(RecipeError, match="arm1 have stats_key arms, and differ in action space, width"):
        train(recipe(data=keyed(2, 3), steps=1), out=tmp_path / "run", show=False)


# -- several views


NAMES = list(SIZES)
SHORT = TINY | {"steps": 2, "frames": 3, "batch_size": 2, "eval_windows": 2, "checkpoint_every": 0}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return three_shards(tmp_path_factory.mktemp("views"), val_fraction=0.3)


@pytest.fixture(scope="module")
def run(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run")
    train(make_recipe(SHORT | {"data": [str(made)], "cameras": NAMES}), out=out)
    return out


def test_three_views_are_trained_generated_and_evaluated(made: Path, run: Path) -> None:
    shards, tokenizer = ShardSet(made), BlockTokenizer()
    model = HMA.from_pretrained(run)
    assert model.config.views == 3
    assert model.config.token_grid == (24, 8)
    assert model.trunk.position.shape[1] == 24 * 8
    assert cameras_for(model, shards) == NAMES  # those of its training
    film = rollout_video(model, tokenizer, shards, prompt=1)
    assert film.frames.shape[2] > 3 * 3 * 64  # three panels of three views
    found = evaluate.measure(model, tokenizer, shards, evaluate.EvaluationSettings(windows=2)).found
    assert found["cameras"] == "top, wrist, side"
    assert np.isfinite(found["loss"])
    with pytest.raises(UsageError, match="the model takes 3"):
        rollout_video(model, tokenizer, shards, cameras="top")


def test_views_are_decoded_side_by_side(made: Path) -> None:
    from hma_data.loading.dataset import WindowDataset

    one, other = (WindowDataset(made, "train", 3, cameras=name)[0].tokens for name in ("side", "top"))
    both = WindowDataset(made, "train", 3, cameras=["side", "top"])[0].tokens
    alone = [decode(BlockTokenizer(), tokens) for tokens in (one, other)]
    np.testing.assert_array_equal(decode(BlockTokenizer(), both), np.concatenate(alone, axis=3))


def test_a_run_on_drawn_or_named_cameras_takes_one_view(made: Path, tmp_path: Path) -> None:
    for cameras in ("drawn", "wrist"):
        train(make_recipe(SHORT | {"data": [str(made)], "cameras": cameras}), out=tmp_path / cameras)
        model = HMA.from_pretrained(tmp_path / cameras)
        assert model.config.views == 1
        assert cameras_for(model, ShardSet(made)) == cameras


def test_another_number_of_views_cannot_start_from_it(made: Path, run: Path, tmp_path: Path) -> None:
    recipe = make_recipe(SHORT | {"data": [str(made)], "start": str(run)})
    with pytest.raises(RecipeError, match="are 1 in a frame, the checkpoint .* has 3"):
        train(recipe, out=tmp_path / "run")
    with pytest.raises(RecipeError, match="recipe: cameras: three_hdf5 has the cameras .* not nose"):
        train(make_recipe(SHORT | {"data": [str(made)], "cameras": ["nose", "top"]}), out=tmp_path / "run")
    with pytest.raises(RecipeError, match="cameras: must be first, drawn"):
        make_recipe({"cameras": []})


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_one_view_is_the_network_as_it_was(kind: str) -> None:
    config = HMAConfig(kind=kind, layers=1, width=16, heads=2, grid=(4, 4))
    assert "views" not in config.to_json()
    two = config.replace(views=2)
    assert HMAConfig.from_json(two.to_json()) == two
    assert two.tokens_per_frame == 2 * config.tokens_per_frame
    shape = two.frame_shape
    model = HMA(two)
    model.add_embodiment(arm())
    stored = torch.randint(0, 8, (1, 3, *shape)) if kind == "discrete" else torch.randn(1, 3, *shape)
    assert model.eval().generate(stored, None, arm().id, 1).shape == (1, 1, *shape)
