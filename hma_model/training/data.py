"""Draw the batches of a training step, the same for every number of ranks that divides its passes.

A step consists of a number of passes, each over its own batch. Rank r of W makes the passes r, r + W and so
on. Pass p draws from the mixture as if it were rank p and every pass were a rank. There are `accumulate`
passes where W divides that; the data do not depend on W then, and a run may continue with another such W.
Otherwise there are W passes.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from hma_data.errors import RecipeError, UsageError
from hma_data.loading.dataset import Batch, MixtureDataset
from hma_data.loading.mixture import Mixture
from hma_data.shards.reader import ShardSet
from hma_model.training.parallel import Ranks
from hma_model.training.recipe import Recipe
from hma_model.training.resume import seed_for

MEMORY_MIB = 2048  # of decoded rows; all passes share it, so it does not depend on the number of ranks


def share(recipe: Recipe, ranks: int) -> tuple[int, int]:
    """Return (passes of all ranks together, windows a pass) of a step.

    Raises:
        RecipeError: the windows cannot be shared evenly.
    """
    total = recipe.windows_per_step
    passes = recipe.accumulate if recipe.accumulate % ranks == 0 else ranks
    if total % passes:
        fault = f"{total} windows per step cannot be shared evenly by {ranks} ranks"
        remedy = (
            f"choose batch_size × accumulate as a multiple of {ranks}, such as {-(-total // ranks) * ranks}"
        )
        raise RecipeError("recipe: batch_size", fault, remedy)
    return passes, total // passes


class TrainData:
    """The batches of this rank.

    Args:
        recipe: states mixture, windows and seed.
        sets: shard sets by embodiment.
        ranks: the ranks.

    Attributes:
        passes: passes of a step, of all ranks together.
        own: the numbers of this rank's passes.

    Raises:
        RecipeError: a step needs more windows than there are, or the windows cannot be shared evenly.
        ShardError: a set has no window.
    """

    def __init__(self, recipe: Recipe, sets: Mapping[str, ShardSet], ranks: Ranks) -> None:
        self.passes, size = share(recipe, ranks.size)
        self.own = range(ranks.rank, self.passes, ranks.size)
        self._workers = -(-recipe.workers // len(self.own))
        self._data = [self._dataset(recipe, sets, size, self.own[0])]
        self._batches: list[Iterator[Batch]] = []
        count = sum(self.mixture.counts)
        if recipe.windows_per_step > count:
            fault = f"{recipe.windows_per_step} windows per step are more than the {count} there are"
            raise RecipeError("recipe: batch_size", fault, "lower batch_size or accumulate, or add data")
        self._data += [self._dataset(recipe, sets, size, number) for number in self.own[1:]]

    def _dataset(
        self, recipe: Recipe, sets: Mapping[str, ShardSet], size: int, number: int
    ) -> MixtureDataset:
        given: dict[str, Any] = {key: value or None for key, value in recipe.mixture}
        try:
            return MixtureDataset(
                list(sets.values()),
                size,
                recipe.frames,
                **given,
                samples=recipe.steps * recipe.windows_per_step if recipe.mixture.max_epochs else None,
                short=recipe.short,
                seed=seed_for(recipe.seed, "sampler"),
                rank=number,
                world=self.passes,
                memory_mib=max(MEMORY_MIB // self.passes, 1),
                cameras=recipe.cameras,
            )
        except UsageError as fault:
            remedy = fault.remedy or f"the data has {', '.join(sets)}"
            where = fault.where.replace("mixture ", "mixture.")
            raise RecipeError(f"recipe: {where}", fault.fault, remedy) from fault

    @property
    def mixture(self) -> Mixture:
        """Return the mixture, which states how often each embodiment is drawn."""
        return self._data[0].mixture

    def step(self) -> Iterator[tuple[int, Batch]]:
        """Yield this rank's batches of the next step, each with the number of its pass.

        Raises:
            ShardError: a shard is missing or damaged.
        """
        if not self._batches:
            self._batches = [data.batches(self._workers) for data in self._data]
        for number, batches in zip(self.own, self._batches):
            yield number, next(batches)

    def realised(self) -> list[dict[str, Any]]:
        """Return `Mixture.table`: the samples this rank drew of each embodiment, beside the intended ones."""
        drawn = [[int(row["samples"]) for row in data.realised()] for data in self._data]
        return self.mixture.table([sum(column) for column in zip(*drawn, strict=True)])

    def state(self, ranks: Ranks) -> dict[str, Any]:
        """Return the state of all passes after whole steps; every rank must call it."""
        mine = dict(zip(self.own, (data.state_dict() for data in self._data)))
        known = {number: state for part in ranks.gather(mine) for number, state in part.items()}
        return {"passes": [known[number] for number in range(self.passes)]}

    def load_state(self, state: Mapping[str, Any], force: bool) -> str:
        """Continue from `state`, which any number of ranks may have saved.

        Returns:
            The reason why the sampler restarts: a step has another number of passes, or the mixture is
            another one and `force` accepts it. An empty string if the sampler continues.

        Raises:
            UsageError: the state is of another mixture.
        """
        kept = state["passes"]
        if len(kept) != self.passes:
            return f"its state has {len(kept)} passes per step, this run has {self.passes}"
        try:
            for number, data in zip(self.own, self._data):
                data.load_state_dict(kept[number])
        except UsageError as fault:
            if not force:
                raise
            return str(fault)
        return ""
