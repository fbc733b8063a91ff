"""Ranks of a run: one process's curve, any number of ranks goes on, and one error where they fail."""

import errno
import json
import os
import subprocess
import sys
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import pytest
import torch
import torch.distributed as dist

from hma_data.errors import HMAError, ShardError, TrainingError
from hma_model.checkpoint.folder import resolve
from hma_model.training.logging import read_metrics
from hma_model.training.loop import train
from hma_model.training.parallel import ParallelModel, Ranks, join, read_error, report_once, write_error
from hma_model.training.recipe import make_recipe
from tests.model.processes import ROOT, errors, run_ranks
from tests.model.runs import TINY, train_until, weights


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


def spread(recipe, out: Path, on_step=None, codes=(0, 0)) -> str:
    """Train on ranks that end with these exit codes, with on_step(rank, facts) after each step."""
    return run_ranks(partial(train_rank, recipe, out, on_step), out.with_name("said.txt"), codes)


def train_rank(recipe, out: Path, on_step, rank: int) -> None:
    train(recipe, out=out, on_progress=on_step and partial(on_step, rank))


def exit_after_five(rank: int, facts) -> None:
    if facts["step"] == 5:
        os._exit(9)


def fail_and_outlast(failing: int, pid: Path, rank: int, facts) -> None:
    """After two steps one rank fails; the other goes on once that one is gone."""
    if facts["step"] == 2 and rank == failing:
        pid.write_text(str(os.getpid()))
        raise ShardError("shards/arm", "lies on a disk that this rank alone has lost", "mount it")
    while facts["step"] == 2 and not (pid.exists() and pid.read_text() and not alive(int(pid.read_text()))):
        time.sleep(0.01)


def alive(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


def curve(out: Path) -> list[float]:
    return [line["loss"] for line in read_metrics(out) if line["kind"] == "train"]


def close(one: Path, other: Path) -> None:
    a, b = weights(one), weights(other)
    assert a.keys() == b.keys()
    for name, value in a.items():
        assert torch.allclose(value.float(), b[name].float(), rtol=1e-3, atol=2e-5), name


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["ddp", "fsdp"])
def test_two_ranks_give_the_curve_and_the_weights_of_one(recipe, alone, tmp_path, mode):
    told = spread(recipe(parallel=mode), tmp_path / "run")
    assert curve(tmp_path / "run") == pytest.approx([loss for _, loss in alone.losses], rel=1e-4), told
    close(alone.checkpoint, resolve(tmp_path / "run"))
    assert f"4 passes per step over 2 ranks, {mode}" in told
    assert json.loads((tmp_path / "run" / "environment.json").read_text())["ranks"] == 2


@pytest.mark.slow
def test_a_sharded_run_cut_on_two_ranks_goes_on_on_one(recipe, alone, tmp_path):
    spread(recipe(parallel="fsdp"), tmp_path / "run", exit_after_five, codes=(9, 9))
    assert resolve(tmp_path / "run").name == "step-00000004"
    again = train(recipe(), out=tmp_path / "run", show=False)
    assert [loss for _, loss in again.losses] == pytest.approx([loss for _, loss in alone.losses], rel=1e-4)
    close(alone.checkpoint, again.checkpoint)


@pytest.mark.slow
def test_a_run_cut_on_one_rank_goes_on_on_two(recipe, alone, tmp_path):
    train_until(recipe(), tmp_path / "run", 3)
    told = spread(recipe(parallel="fsdp"), tmp_path / "run")
    assert "resuming from step 2" in told
    assert curve(tmp_path / "run") == pytest.approx([loss for _, loss in alone.losses], rel=1e-4)
    close(alone.checkpoint, resolve(tmp_path / "run"))


@pytest.mark.slow
def test_a_step_shared_otherwise_goes_on_with_windows_anew_and_says_so(recipe, tmp_path):
    given = recipe(accumulate=1, batch_size=4)
    train_until(given, tmp_path / "run", 3)
    told = spread(given, tmp_path / "run")
    assert "the sampler restarts: " in told and "has 1 passes per step, this run has 2" in told
    assert len(curve(tmp_path / "run")) == 6


@pytest.mark.slow
def test_torchrun_starts_the_command(recipe, alone, tmp_path):
    done = torchrun(recipe(steps=2), tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("step 2, ") == 1
    first, _ = curve(tmp_path / "run")
    assert first == pytest.approx(alone.losses[0][1], rel=1e-4)


@pytest.mark.slow
def test_the_command_says_once_why_it_cannot_start_on_any_rank(recipe, tmp_path):
    done = torchrun(recipe(data=[str(tmp_path / "gone")]), tmp_path)
    assert done.returncode and len(errors(done.stderr)) == 1, done.stderr


def torchrun(recipe, folder: Path) -> subprocess.CompletedProcess[str]:
    path = folder / "recipe.yaml"
    path.write_text(json.dumps(recipe.values()))
    command = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "hma_model.cli"]
    return subprocess.run(
        [sys.executable, *command, "train", str(path), "--out", str(folder / "run")],
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
def test_a_full_disk_on_the_first_rank_ends_all(recipe, tmp_path):
    work = partial(train_on_a_full_disk, recipe(), tmp_path / "run")
    said = errors(run_ranks(work, tmp_path / "said.txt", codes=(1, 1)))
    assert len(said) == 1 and "No space left on device" in said[0]


def train_on_a_full_disk(recipe, out: Path, rank: int) -> None:
    full = OSError(errno.ENOSPC, "No space left on device")
    with mock.patch("hma_model.training.run.write_atomic", side_effect=full):
        train(recipe, out=out)


@pytest.mark.slow
@pytest.mark.parametrize("rank", [0, 1])
def test_a_fault_that_one_rank_has_is_said_once_however_much_later_the_other_ends(recipe, tmp_path, rank):
    on_step = partial(fail_and_outlast, rank, tmp_path / "pid")
    said = errors(spread(recipe(), tmp_path / "run", on_step, codes=(1, 1)))
    assert len(said) == 1 and "lies on a disk that this rank alone has lost — mount it" in said[0]


@pytest.mark.slow
def test_a_fault_that_all_ranks_have_before_they_meet_is_said_once(tmp_path):
    assert errors(run_ranks(fail, tmp_path / "said.txt", codes=(1, 1, 1))) == ["error: here: is gone"]


def fail(rank: int) -> None:
    raise ShardError("here", "is gone")


@pytest.mark.parametrize(
    ("fault", "said"),
    [(ShardError("here", "is gone"), "here: is gone"), (TypeError("no number"), "TypeError: no number")],
)
def test_a_rank_that_has_lost_the_others_finds_their_first_error(fault, said):
    store = dist.HashStore()
    assert read_error(store) is None
    write_error(store, 1, fault)
    write_error(store, 0, OSError("another"))
    assert str(read_error(store)) == f"rank 1: {said}"


def test_one_process_raises_its_own_error():
    with pytest.raises(ShardError), report_once():
        raise ShardError("here", "is gone")


@pytest.mark.slow
def test_a_rank_ends_though_an_error_keeps_the_network_past_its_group(tmp_path):
    run_ranks(free_the_error_last, tmp_path / "said.txt")


def free_the_error_last(rank: int) -> None:
    """Rank 0 frees the error of a run while a collective is under way, which rank 1 then completes.

    The collective's thread frees a tensor that Python knows, for which it takes the GIL. The error's
    traceback holds the network under DDP, and with it the last reference to the process group.
    """
    store = dist.TCPStore("127.0.0.1", int(os.environ["MASTER_PORT"]), is_master=False)
    try:
        with join(torch.device("cpu")) as world:
            if rank == 0:
                fail_under_ddp(world)
            network = ParallelModel(Network(), world, "ddp")
            store.wait(["freeing"])
            await_sleep(int(store.get("freeing")))
            world.sum(torch.ones(1))
            del network
    except HMAError as fault:
        held = fault
        store.set("freeing", str(os.getpid()))
        del held, fault


class Network(torch.nn.Linear):
    device, config = torch.device("cpu"), SimpleNamespace(absent_action="embedding")

    def __init__(self) -> None:
        super().__init__(2, 2)
        self.trunk = SimpleNamespace(blocks=SimpleNamespace(parameters=self.parameters))


def fail_under_ddp(world: Ranks) -> None:
    network = ParallelModel(Network(), world, "ddp")
    dist.all_reduce(torch.ones(1), async_op=True)
    raise TrainingError(str(network), "fails")


def await_sleep(pid: int) -> None:
    """Wait until a process waits for something itself, ten times in a row, or has ended."""
    asleep = 0
    with suppress(OSError):  # it may end between two looks
        while asleep < 10 and alive(pid):
            time.sleep(0.01)
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
            asleep = asleep + 1 if state == "S" else 0


def test_one_process_is_a_world_of_one():
    world = Ranks()
    assert world.main and world.gather(3) == [3] and world.once(lambda: 4) == 4
    assert torch.equal(world.sum(torch.ones(2)), torch.ones(2))
