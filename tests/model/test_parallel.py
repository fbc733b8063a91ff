"""Ranks, forked here as torchrun starts them: one process's curve, and any number of ranks goes on."""

import errno
import json
import multiprocessing
import multiprocessing.connection
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch.distributed import HashStore, TCPStore

from hma_data.errors import ShardError, TrainingError
from hma_model import checkpoint, voice
from hma_model.parallel import World
from hma_model.recipe import make_recipe
from hma_model.runlog import read_metrics
from hma_model.train import train
from hma_model.voice import Voice, one_voice
from tests.model.runs import TINY, weights
from tests.model.shards import make_shards

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.filterwarnings("ignore:.*use of fork:DeprecationWarning")


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> list[str]:
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("shards")
    arm, hand = make_shards(folder / "arm", "arm"), make_shards(folder / "hand", "hand", dims=3, seed=1)
    return [str(arm), str(hand)]


@pytest.fixture(scope="module")
def recipe(data):
    def recipe(**changes):
        # one sample a pass: the ranks of a step often have different robots, and so different stems
        few = {"batch_size": 1, "accumulate": 4, "eval_every": 0, "ema": 0.5, "weight_decay": 0.5}
        mixed = {"objectives": {"forward": 1, "policy": 1}, "model": {**TINY["model"], "layers": 2}}
        return make_recipe({**TINY, "data": data, **few, **mixed, **changes})

    return recipe


@pytest.fixture(scope="module")
def alone(recipe, tmp_path_factory):
    return train(recipe(), out=tmp_path_factory.mktemp("alone") / "run", show=False)


def spread(recipe, out: Path, kill_after: int = 0, ranks: int = 2, fail: int | None = None) -> str:
    """Train on forked ranks, which spares them torch's import; returns what they said.

    A rank that fails or is killed ends the others, as torchrun does. Rank `fail` has a fault after two steps.
    """
    store = TCPStore(
        "127.0.0.1", 0, is_master=True, wait_for_workers=False
    )  # torchrun's, which outlives ranks
    told = out.with_name("told.txt")
    context = multiprocessing.get_context("fork")
    processes = [
        context.Process(target=_rank, args=(rank, ranks, store.port, recipe, out, kill_after, told, fail))
        for rank in range(ranks)
    ]
    for process in processes:
        process.start()
    multiprocessing.connection.wait([p.sentinel for p in processes])
    for process in processes:
        process.join(60 if all(p.exitcode in (0, None) for p in processes) else 10)
        process.kill()
    return told.read_text()


def _rank(rank, ranks, port, recipe, out, kill_after, told, fail) -> None:
    os.environ.update(
        RANK=str(rank), LOCAL_RANK=str(rank), WORLD_SIZE=str(ranks),
        MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port), TORCHELASTIC_USE_AGENT_STORE="True",
    )  # fmt: skip
    os.dup2(os.open(told, os.O_CREAT | os.O_WRONLY | os.O_APPEND), 2)
    sys.stderr = os.fdopen(2, "w")

    def kill(facts) -> None:
        if facts["step"] == kill_after:
            os._exit(9)
        if facts["step"] == 2 and rank == fail:
            raise ShardError("shards/arm", "lies on a disk that this rank alone has lost", "mount it")

    with one_voice():
        train(recipe, out=out, on_progress=kill)


def curve(out: Path) -> list[float]:
    return [line["loss"] for line in read_metrics(out) if line["kind"] == "train"]


def train_until(recipe, out: Path, step: int) -> None:
    """Train and be killed after a step."""

    def kill(facts) -> None:
        if facts["step"] == step:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(recipe, out=out, show=False, on_progress=kill)


def close(one: Path, other: Path) -> None:
    a, b = weights(one), weights(other)
    assert a.keys() == b.keys()
    for name, value in a.items():
        assert torch.allclose(value.float(), b[name].float(), rtol=1e-3, atol=2e-5), name


@pytest.mark.parametrize("mode", ["ddp", "fsdp"])
def test_two_ranks_give_the_curve_and_the_weights_of_one(recipe, alone, tmp_path, mode):
    told = spread(recipe(parallel=mode), tmp_path / "run")
    assert curve(tmp_path / "run") == pytest.approx([loss for _, loss in alone.losses], rel=1e-4), told
    close(alone.checkpoint, checkpoint.resolve(tmp_path / "run"))
    assert f"4 passes a step over 2 ranks, {mode}" in told
    assert json.loads((tmp_path / "run" / "environment.json").read_text())["ranks"] == 2


def test_a_sharded_run_cut_on_two_ranks_goes_on_on_one(recipe, alone, tmp_path):
    spread(recipe(parallel="fsdp"), tmp_path / "run", kill_after=5)
    assert checkpoint.resolve(tmp_path / "run").name == "step-00000004"
    again = train(recipe(), out=tmp_path / "run", show=False)
    assert [loss for _, loss in again.losses] == pytest.approx([loss for _, loss in alone.losses], rel=1e-4)
    close(alone.checkpoint, again.checkpoint)


def test_a_run_cut_on_one_rank_goes_on_on_two(recipe, alone, tmp_path):
    train_until(recipe(), tmp_path / "run", 3)
    told = spread(recipe(parallel="fsdp"), tmp_path / "run")
    assert "going on from step 2" in told
    assert curve(tmp_path / "run") == pytest.approx([loss for _, loss in alone.losses], rel=1e-4)
    close(alone.checkpoint, checkpoint.resolve(tmp_path / "run"))


def test_a_step_shared_otherwise_goes_on_with_windows_anew_and_says_so(recipe, tmp_path):
    given = recipe(accumulate=1, batch_size=4)
    train_until(given, tmp_path / "run", 3)
    told = spread(given, tmp_path / "run")
    assert "the sampler begins anew: " in told and "is of 1 passes a step, this run has 2" in told
    assert len(curve(tmp_path / "run")) == 6


def test_torchrun_starts_the_command(recipe, data, alone, tmp_path):
    path = tmp_path / "recipe.yaml"
    path.write_text(json.dumps(recipe(steps=2).values()))
    command = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "hma_model.cli"]
    done = subprocess.run(
        [sys.executable, *command, "train", str(path), "--out", str(tmp_path / "run")],
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("step 2, ") == 1
    first, _ = curve(tmp_path / "run")
    assert first == pytest.approx(alone.losses[0][1], rel=1e-4)


def test_ranks_that_cannot_share_a_step_are_told(recipe, tmp_path):
    told = spread(recipe(batch_size=3, accumulate=1), tmp_path / "run")
    assert "RecipeError" in told and "3 windows a step cannot be shared evenly by 2 ranks" in told


def test_a_full_disk_on_the_first_rank_ends_all(recipe, tmp_path, monkeypatch):
    def write(path, content):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("hma_model.trainer.write_atomic", write)
    told = spread(recipe(), tmp_path / "run")
    faults = [line for line in told.splitlines() if line.startswith("hma_data.errors.OutputError: ")]
    assert len(faults) == 1 and "No space left on device" in faults[0]


@pytest.mark.parametrize("rank", [0, 1])
def test_a_fault_that_one_rank_has_is_said_once(recipe, tmp_path, rank):
    told = spread(recipe(steps=60), tmp_path / "run", fail=rank)
    faults = [line for line in told.splitlines() if line.startswith("hma_data.errors.")]
    assert len(faults) == 1 and "lies on a disk that this rank alone has lost — mount it" in faults[0]


def test_a_rank_says_itself_what_the_first_does_not_and_the_first_is_silent_then(monkeypatch):
    monkeypatch.setattr(voice, "MOMENT", 0.05)
    store, fault = HashStore(), ShardError("here", "is gone")
    first, second = Voice(store, 0, 2), Voice(store, 1, 2)
    assert first.heard() is None
    second.leave(fault)
    second.settle(fault)
    assert not silent(fault, "1", monkeypatch)
    heard = first.heard()
    assert str(heard) == "rank 1: here: is gone" and silent(heard, "0", monkeypatch)


def test_a_rank_is_silent_where_the_first_has_spoken(monkeypatch):
    store, fault = HashStore(), ShardError("here", "is gone")
    first, second = Voice(store, 0, 2), Voice(store, 1, 2)
    second.leave(fault)
    heard = first.heard()
    first.leave(heard)
    second.settle(fault)
    assert silent(fault, "1", monkeypatch) and not silent(heard, "0", monkeypatch)


def silent(fault, rank: str, monkeypatch) -> bool:
    """Whether a command on a rank ends without a word, with the fault's exit code."""
    monkeypatch.setenv("RANK", rank)
    try:
        with one_voice():
            raise fault
    except (ShardError, TrainingError):
        return False
    except SystemExit as ended:
        return ended.code == fault.exit_code


def test_before_ranks_have_met_the_others_give_the_first_a_moment(monkeypatch):
    waited: list[float] = []
    monkeypatch.setattr(voice.time, "sleep", waited.append)
    for rank, moments in (("0", []), ("1", [voice.MOMENT])):
        monkeypatch.setenv("RANK", rank)
        waited.clear()
        with pytest.raises(ShardError), one_voice():
            raise ShardError("here", "is gone")
        assert waited == moments


def test_one_process_is_a_world_of_one():
    world = World()
    assert world.main and world.gather(3) == [3] and world.once(lambda: 4) == 4
    assert torch.equal(world.sum(torch.ones(2)), torch.ones(2))
