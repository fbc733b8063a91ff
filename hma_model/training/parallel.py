"""Training on several ranks under torchrun: who takes part, what they share, how the network is spread.

    torchrun --nproc-per-node 8 --no-python hma train discrete_base data=[…] --out runs/base

A recipe states the whole step; ranks share its passes, so that any number of them trains the same way. DDP
keeps the network whole on every rank. FSDP2 shards the trunk's blocks; stems, heads, embeddings and readouts
stay whole, because the ranks of one step may use different ones.
"""

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING, Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from hma_data.errors import HMAError, OutputError, RecipeError, TrainingError
from hma_model.training.rank_errors import PREFIX, read_error, write_error

if TYPE_CHECKING:
    from hma_model.network.model import HMA

PATIENCE = timedelta(hours=2)  # rank 0 evaluates and writes while the others wait


@dataclass(frozen=True)
class World:
    """The ranks of a run.

    Attributes:
        rank: of this process, from 0.
        size: how many there are.
        local_rank: among those of this machine.
    """

    rank: int = 0
    size: int = 1
    local_rank: int = 0

    @property
    def main(self) -> bool:
        """Whether this rank writes and speaks."""
        return self.rank == 0

    def sum(self, values: Tensor) -> Tensor:
        """The sum over ranks, in place."""
        if self.size > 1:
            dist.all_reduce(values)
        return values

    def gather[T](self, value: T) -> list[T]:
        """Every rank's value, in their order."""
        if self.size == 1:
            return [value]
        found: list[Any] = [None] * self.size
        dist.all_gather_object(found, value)
        return found

    def once[T](self, action: Callable[[], T]) -> T:
        """What `action` gives on rank 0, to all ranks; an error is raised on all of them."""
        if self.size == 1:
            return action()
        outcome: list[Any] = [None, None]
        own: Exception | None = None
        if self.main:
            try:
                outcome[0] = action()
            except Exception as fault:  # whatever it is, the others must not wait for a rank that has ended
                own, outcome[1] = fault, _told(fault)
        dist.broadcast_object_list(outcome, src=0)
        if own is not None:
            raise own
        if outcome[1] is not None:
            raise outcome[1]
        return outcome[0]


def _told(fault: Exception) -> HMAError:
    """An error as the other ranks raise it."""
    if isinstance(fault, HMAError):
        return fault
    if isinstance(fault, OSError):
        return OutputError(fault.filename or "rank 0", f"cannot be written: {fault.strerror or fault}")
    return TrainingError("rank 0", f"{type(fault).__name__}: {fault}", "see what it has said itself")


@contextmanager
def join(device: torch.device) -> Iterator[World]:
    """The ranks that torchrun has started, or this process alone.

    Args:
        device: what the run trains on; it decides how ranks talk.

    Raises:
        RecipeError: the ranks cannot find each other.
        TrainingError: another rank has ended, and why where it has said so.
    """
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1 and not dist.is_initialized():
        yield World()
        return
    ours = not dist.is_initialized()
    store = _met(device) if ours else None
    world = World(dist.get_rank(), dist.get_world_size(), local_rank())
    try:
        yield world
    except Exception as fault:
        error = _explained(fault, world, store)
        write_error(store, world.rank, error)  # before the group goes, by which the others find out
        if error is fault:
            raise
        raise error from fault
    finally:
        waits = device.type == "cuda" and sys.exc_info()[0] is not None  # NCCL, for a rank that is gone
        if ours and dist.is_initialized() and not waits:
            dist.destroy_process_group()


def _met(device: torch.device) -> dist.Store:
    """Meet the other ranks; returns the store they have met by."""
    backend = "cpu:gloo,cuda:nccl" if device.type == "cuda" else "gloo"
    try:
        store, rank, size = next(dist.rendezvous("env://", timeout=PATIENCE))
        store.set_timeout(PATIENCE)
        own = dist.PrefixStore("group", store)
        dist.init_process_group(backend, store=own, rank=rank, world_size=size, timeout=PATIENCE)
    except (RuntimeError, ValueError) as fault:
        text = f"cannot find each other: {str(fault).splitlines()[0]}"
        raise RecipeError("ranks", text, "start them with torchrun") from fault
    return dist.PrefixStore(PREFIX, store)


def _explained(fault: Exception, world: World, store: dist.Store | None) -> Exception:
    """Return the error to raise for a fault: where this rank has lost the others, what has ended them."""
    if isinstance(fault, HMAError) or not isinstance(fault, RuntimeError):
        return fault
    said = (str(fault).splitlines() or [""])[0][:200]
    if not isinstance(fault, dist.DistError) and "gloo" not in str(fault):
        return TrainingError(f"rank {world.rank}", f"{type(fault).__name__}: {said}", "--debug shows where")
    return read_error(store) or TrainingError(
        f"rank {world.rank}",
        f"has lost the others: {said}",
        "see what ended another rank; the same command goes on from the last checkpoint",
    )


def local_rank() -> int:
    """This process among those of its machine."""
    return int(os.environ.get("LOCAL_RANK", "0"))


# -- how the network is spread


class _DDP(nn.parallel.DistributedDataParallel):
    """DDP that frees its reducer before the last Python reference to its process group.

    To free a group is to wait for its threads, and these take the GIL to free the tensors of their last
    collectives. A Python reference frees the group without the GIL; the reducer would free it with the GIL,
    and the process would hang. It is the last owner where an error, or somebody's variable, keeps the network
    past `destroy_process_group()`.
    """

    def __del__(self) -> None:
        group = self.__dict__.get("process_group")
        for owner in ("logger", "reducer"):
            self.__dict__.pop(owner, None)
        del group


class Spread:
    """A network as the ranks of a run hold it.

    Args:
        model: on its device, the same on every rank; sharded in place by fsdp.
        world: the ranks.
        mode: ddp or fsdp; without meaning for one rank.
    """

    def __init__(self, model: "HMA", world: World, mode: str) -> None:
        self.model, self.world = model, world
        self.sharded = mode == "fsdp" and world.size > 1
        self._call: nn.Module = model
        if self.sharded:
            _shard(model, world)
        elif world.size > 1:
            device = [model.device] if model.device.type == "cuda" else None
            self._call = _DDP(model, device_ids=device, find_unused_parameters=True, broadcast_buffers=False)

    def __call__(self, *given: Any, **named: Any) -> Any:
        """The network's forward pass."""
        return self._call(*given, **named)

    def passing(self, last: bool) -> AbstractContextManager[None]:
        """Around a forward and backward pass; gradients are averaged in the step's last one."""
        if isinstance(self._call, nn.parallel.DistributedDataParallel):
            return nullcontext() if last else self._call.no_sync()
        if self.sharded:
            self._call.set_requires_gradient_sync(last)  # type: ignore[operator]
        return nullcontext()

    def average(self) -> None:
        """After the last pass: average the gradients that neither DDP nor FSDP has averaged."""
        if self.sharded:
            _average(
                [p for p in self.model.parameters() if p.requires_grad and not is_sharded(p)], self.world
            )

    def clip(self, limit: float) -> float:
        """Scale the gradients to at most this norm, over all ranks; returns the norm they had."""
        parameters = [p for p in self.model.parameters() if p.grad is not None]
        if not self.sharded:
            return float(nn.utils.clip_grad_norm_(parameters, limit))
        squares = torch.zeros(2, device=self.model.device)
        for p in parameters:
            assert p.grad is not None
            squares[int(is_sharded(p))] += local(p.grad).float().square().sum()
        norm = float((squares[0] + self.world.sum(squares[1:].clone())[0]).sqrt())
        for p in parameters:
            assert p.grad is not None
            local(p.grad).mul_(min(1.0, limit / (norm + 1e-6)))
        return norm


def _shard(model: "HMA", world: World) -> None:
    from torch.distributed.device_mesh import init_device_mesh
    from torch.distributed.fsdp import fully_shard

    mesh = init_device_mesh(model.device.type, (world.size,))
    whole = {id(p) for block in model.trunk.blocks for p in block.parameters()}
    kept = {p for p in model.parameters() if id(p) not in whole}
    for block in model.trunk.blocks:
        fully_shard(block, mesh=mesh)
    fully_shard(model, mesh=mesh, ignored_params=kept)


def _average(parameters: list[nn.Parameter], world: World) -> None:
    """A gradient that only some ranks have is zero on the others; one that none has stays away."""
    there = torch.tensor([float(p.grad is not None) for p in parameters], device=parameters[0].device)
    used = [p for p, count in zip(parameters, world.sum(there).tolist()) if count]
    for p in used:
        if p.grad is None:
            p.grad = torch.zeros_like(p)
    flat = world.sum(torch.cat([p.grad.flatten() for p in used if p.grad is not None])) / world.size
    for p, part in zip(used, flat.split([p.numel() for p in used])):
        assert p.grad is not None
        p.grad.copy_(part.view_as(p))


def is_sharded(tensor: Tensor) -> bool:
    """Whether each rank holds a part of the tensor."""
    from torch.distributed.tensor import DTensor

    return isinstance(tensor, DTensor)


def local(tensor: Tensor) -> Tensor:
    """The part of a tensor that this rank holds; all of one that is whole."""
    return tensor.to_local() if is_sharded(tensor) else tensor  # type: ignore[attr-defined]


def whole(tensor: Tensor) -> Tensor:
    """All of a tensor; every rank must ask in the same order."""
    return tensor.full_tensor() if is_sharded(tensor) else tensor  # type: ignore[attr-defined]


def like(tensor: Tensor, own: Tensor) -> Tensor:
    """A whole tensor, the same on all ranks, spread as `own` is and on its device."""
    if not is_sharded(own):
        return tensor.to(own.device)
    from torch.distributed.tensor import distribute_tensor

    return distribute_tensor(tensor.to(own.device), own.device_mesh, own.placements)  # type: ignore[attr-defined]


def gathered(named: Iterable[tuple[str, Tensor]]) -> dict[str, Tensor]:
    """Whole tensors by name."""
    return {name: whole(tensor.detach()) for name, tensor in named}
