"""Train on several ranks under torchrun: join them, report their errors, and distribute the network.

    torchrun --nproc-per-node 8 --no-python hma train discrete_base "data=[…]" --out runs/base

A recipe states the whole step, and the ranks share its passes. Training is therefore the same on any number
of ranks. DDP keeps the whole network on every rank. FSDP2 shards the trunk's blocks; stems, heads, embeddings
and readouts stay whole, because the ranks may use different ones in the same step.

The error that ends a run is reported exactly once. A rank that fails writes its error into the store of the
run; a rank that has only lost the others finds it there. The first failing rank to claim the report prints
its error, and ignores the signal by which torchrun then ends it; the others exit silently. The claim needs
torchrun's store, which outlives the ranks. Ranks that are started in another way each print their own error.
"""

import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.distributed.tensor import DTensor, distribute_tensor

from hma_data.errors import HMAError, RecipeError, TrainingError
from hma_model.config import OBJECTIVES, HMAConfig
from hma_model.network.model import HMA
from hma_model.training.recipe import Recipe

PATIENCE = timedelta(hours=2)  # rank 0 evaluates and writes while the others wait
ANSWER = timedelta(seconds=30)  # the time limit for an answer of torchrun's store
PREFIX, ERROR, REPORTS = "errors", "error", "reports"  # of the keys in the store


def require_shardable(recipe: Recipe, config: HMAConfig) -> None:
    """Raise if several ranks cannot train a network so with `parallel=fsdp`.

    Raises:
        RecipeError: an option needs the whole network on every rank.
    """
    remedy = "use parallel=ddp"
    fault = "does not work with parallel=fsdp on several ranks"
    if recipe.self_forward:
        raise RecipeError("recipe: self_forward", fault, remedy)
    if recipe.optimizer == "muon":
        raise RecipeError("recipe: optimizer", f"muon {fault}", remedy)
    seeing = {OBJECTIVES[name].sees_actions for name, weight in recipe.objectives.items() if weight}
    if config.absent_action == "skip" and len(seeing) > 1:
        fault = "skip does not work with parallel=fsdp where only some objectives see actions"
        raise RecipeError("recipe: model.absent_action", fault, remedy)


@dataclass(frozen=True)
class Ranks:
    """The ranks of a run: `rank` is the number of this process, from 0, and `size` their number."""

    rank: int = 0
    size: int = 1

    @property
    def main(self) -> bool:
        """Check whether this is rank 0, which writes files and prints."""
        return self.rank == 0

    def sum(self, values: Tensor) -> Tensor:
        """Sum values over all ranks, in place."""
        if self.size > 1:
            dist.all_reduce(values)
        return values

    def gather[T](self, value: T) -> list[T]:
        """Return the values of all ranks, in the order of ranks."""
        if self.size == 1:
            return [value]
        found: list[Any] = [None] * self.size
        dist.all_gather_object(found, value)
        return found

    def once[T](self, action: Callable[[], T]) -> T:
        """Run `action` on rank 0 and return its result on all ranks; raise its error on all of them."""
        if self.size == 1:
            return action()
        outcome: list[Any] = [None, None]
        own: Exception | None = None
        if self.main:
            try:
                outcome[0] = action()
            except Exception as fault:  # any error: the others must not wait for a rank that has ended
                told = TrainingError("rank 0", f"{type(fault).__name__}: {fault}")
                own, outcome[1] = fault, fault if isinstance(fault, HMAError) else told
        dist.broadcast_object_list(outcome, src=0)
        if own is not None:
            raise own
        if outcome[1] is not None:
            raise outcome[1]
        return outcome[0]


@contextmanager
def join(device: torch.device) -> Iterator[Ranks]:
    """Join the ranks that torchrun has started, or run as a single process; ranks communicate by `device`.

    Raises:
        RecipeError: the ranks cannot find each other.
        TrainingError: another rank has ended; it states the reason if that rank reported one.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield Ranks()
        return
    store = _met(device)
    ranks = Ranks(dist.get_rank(), dist.get_world_size())
    try:
        yield ranks
    except Exception as fault:
        error = _explained(fault, ranks, store)
        write_error(store, ranks.rank, error)  # before the group ends: the others then look for it
        if error is fault:
            raise
        raise error from fault
    finally:
        if device.type != "cuda" or sys.exc_info()[0] is None:  # NCCL would wait for ended ranks
            dist.destroy_process_group()


def _met(device: torch.device) -> dist.Store:
    """Form the process group with the other ranks, and return a store for errors."""
    backend = "cpu:gloo,cuda:nccl" if device.type == "cuda" else "gloo"
    try:
        store, rank, size = next(dist.rendezvous("env://", timeout=PATIENCE))
        store.set_timeout(PATIENCE)
        own = dist.PrefixStore("group", store)
        dist.init_process_group(backend, store=own, rank=rank, world_size=size, timeout=PATIENCE)
    except (RuntimeError, ValueError) as fault:
        text = f"cannot connect to each other: {str(fault).splitlines()[0]}"
        raise RecipeError("ranks", text, "start them with torchrun") from fault
    return dist.PrefixStore(PREFIX, store)


def _explained(fault: Exception, ranks: Ranks, store: dist.Store) -> Exception:
    """Return the error to raise for a fault; if this rank lost the others, the error that ended them."""
    if isinstance(fault, HMAError) or not isinstance(fault, RuntimeError):
        return fault
    where, said = f"rank {ranks.rank}", str(fault).partition("\n")[0][:200]
    if not isinstance(fault, dist.DistError) and "gloo" not in str(fault):
        return TrainingError(where, f"{type(fault).__name__}: {said}", "--debug shows where")
    remedy = "see what ended another rank, and run the same command to continue"
    return read_error(store) or TrainingError(where, f"has lost the other ranks: {said}", remedy)


def write_error(store: dist.Store, rank: int, error: Exception) -> None:
    """Write the error that ends a rank into the store, unless another rank has written one."""
    kind = "" if hasattr(error, "exit_code") else f"{type(error).__name__}: "
    with suppress(RuntimeError):  # the store is gone with the process that kept it
        store.compare_set(ERROR, "", f"{rank} {kind}{error}")


def read_error(store: dist.Store) -> TrainingError | None:
    """Return the error that another rank has written, or None."""
    try:
        if not store.check([ERROR]):
            return None
        rank, _, text = store.get(ERROR).decode().partition(" ")
    except RuntimeError:
        return None
    return TrainingError(f"rank {rank}", text)


@contextmanager
def report_once() -> Iterator[None]:
    """Let one rank of a failed run raise its error; end the others silently with its exit code.

    Raises:
        SystemExit: another rank reports its error.
    """
    try:
        yield
    except Exception as error:
        if int(os.environ.get("WORLD_SIZE", "1")) == 1:
            raise
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if _claim_report():
            raise
        raise SystemExit(getattr(error, "exit_code", 1)) from error


def _claim_report() -> bool:
    """Check whether this rank must report: it is the first to claim it, or there is no store."""
    if os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True":
        return True
    host, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
    try:
        store = dist.TCPStore(host, port, is_master=False, wait_for_workers=False, timeout=ANSWER)
        attempt = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")
        return bool(store.add(f"{PREFIX}/{REPORTS} {attempt}", 1) == 1)
    except RuntimeError:  # torchrun has ended
        return True


# -- the distributed network


class _DDP(nn.parallel.DistributedDataParallel):
    """DDP that frees its reducer before the last Python reference to its process group.

    Freeing a group waits for its threads, and these threads take the GIL to free the tensors of their last
    collectives. A Python reference frees the group without the GIL. The reducer would free it with the GIL,
    and the process would hang. The reducer is the last owner if an error or a variable keeps the network
    alive past `destroy_process_group()`.
    """

    def __del__(self) -> None:
        group = self.__dict__.get("process_group")
        for owner in ("logger", "reducer"):
            self.__dict__.pop(owner, None)
        del group


class ParallelModel:
    """A model, the same on every rank, that is distributed over the ranks; `mode` fsdp shards it in place."""

    def __init__(self, model: HMA, ranks: Ranks, mode: str) -> None:
        self.model, self.ranks = model, ranks
        self.sharded = mode == "fsdp" and ranks.size > 1
        self._call: nn.Module = model
        self._apart: list[nn.Parameter] = []  # parameters that DDP or FSDP leaves to `average`
        if ranks.size < 2:
            return
        if self.sharded:
            _shard(model, ranks)
            trained = (p for p in model.parameters() if p.requires_grad)
            self._apart = [p for p in trained if not isinstance(p, DTensor)]
        else:
            self._distribute()

    def _distribute(self) -> None:
        """Give the trunk's blocks to DDP; every pass uses all of them, so it searches for no unused ones."""
        model, blocks = self.model, set(self.model.trunk.blocks.parameters())
        whole = model.config.absent_action != "skip"  # else a pass without actions skips parts of the blocks
        trained = {name: p for name, p in model.named_parameters() if p.requires_grad}
        apart = [name for name, p in trained.items() if whole and p not in blocks]
        self._apart = [trained[name] for name in apart]
        if len(apart) == len(trained):
            return
        _DDP._set_params_and_buffers_to_ignore_for_model(model, apart)
        # A gradient of a 1×1 convolution may have other strides than its weights; DDP copies it, and warns.
        warnings.filterwarnings("ignore", "Grad strides do not match bucket view strides")
        device = [model.device] if model.device.type == "cuda" else None
        self._call = _DDP(model, device_ids=device, find_unused_parameters=not whole, broadcast_buffers=False)

    def __call__(self, *given: Any, **named: Any) -> Any:
        """Run the network's forward pass."""
        return self._call(*given, **named)

    def passing(self, last: bool) -> AbstractContextManager[None]:
        """Return a context for a forward and backward pass; the last pass of a step averages gradients."""
        if isinstance(self._call, _DDP):
            return nullcontext() if last else self._call.no_sync()
        if self.sharded:
            self._call.set_requires_gradient_sync(last)  # type: ignore[operator]
        return nullcontext()

    def average(self) -> None:
        """Average, after the last pass, the gradients that neither DDP nor FSDP has averaged.

        A missing gradient counts as zero, unless no rank has it.
        """
        if not self._apart:
            return
        there = torch.tensor([float(p.grad is not None) for p in self._apart], device=self._apart[0].device)
        used = [p for p, count in zip(self._apart, self.ranks.sum(there).tolist()) if count]
        grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in used]
        flat = self.ranks.sum(torch.cat([grad.flatten() for grad in grads])) / self.ranks.size
        for p, grad, part in zip(used, grads, flat.split([p.numel() for p in used])):
            p.grad = grad.copy_(part.view_as(p))

    def clip(self, limit: float) -> float:
        """Scale the gradients to at most this norm over all ranks, and return the norm they had."""
        parameters = [p for p in self.model.parameters() if p.grad is not None]
        if not self.sharded:
            return float(nn.utils.clip_grad_norm_(parameters, limit))
        squares = torch.zeros(2, device=self.model.device)
        for p in parameters:
            assert p.grad is not None
            squares[int(isinstance(p, DTensor))] += local(p.grad).float().square().sum()
        norm = float((squares[0] + self.ranks.sum(squares[1:].clone())[0]).sqrt())
        for p in parameters:
            assert p.grad is not None
            local(p.grad).mul_(min(1.0, limit / (norm + 1e-6)))
        return norm


def _shard(model: HMA, ranks: Ranks) -> None:
    from torch.distributed.device_mesh import init_device_mesh
    from torch.distributed.fsdp import fully_shard

    mesh = init_device_mesh(model.device.type, (ranks.size,))
    kept = set(model.parameters()) - set(model.trunk.blocks.parameters())
    for block in model.trunk.blocks:
        fully_shard(block, mesh=mesh)
    fully_shard(model, mesh=mesh, ignored_params=kept)


def local(tensor: Tensor) -> Tensor:
    """Return the part of a tensor that this rank holds; the tensor itself if it is not sharded."""
    return tensor.to_local() if isinstance(tensor, DTensor) else tensor


def whole(tensor: Tensor) -> Tensor:
    """Return the unsharded tensor; every rank must call it, in the same order."""
    return tensor.full_tensor() if isinstance(tensor, DTensor) else tensor


def like(tensor: Tensor, own: Tensor) -> Tensor:
    """Distribute a tensor, the same on all ranks, as `own` is distributed, on the device of `own`."""
    tensor = tensor.to(own.device)
    return distribute_tensor(tensor, own.device_mesh, own.placements) if isinstance(own, DTensor) else tensor


def gathered(named: Iterable[tuple[str, Tensor]]) -> dict[str, Tensor]:
    """Return unsharded tensors by name."""
    return {name: whole(tensor.detach()) for name, tensor in named}
