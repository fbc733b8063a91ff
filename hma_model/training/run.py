"""Hold a run's model, optimizer and data, and carry out its steps, evaluations and checkpoints.

`hma_model.training.loop` is the loop around it. Every rank takes part in gathering weights; only rank 0
writes files.
"""

import math
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hma_data.errors import CheckpointError, RecipeError, TrainingError, UsageError
from hma_data.loading.dataset import Batch, open_sets
from hma_data.shards.reader import ShardSet
from hma_data.shards.stats import Stats
from hma_data.storage.files import read_json, remove_partial, remove_parts, to_json, write_atomic
from hma_data.storage.paths import addressed, is_repository
from hma_model.checkpoint import io as checkpoints
from hma_model.checkpoint.folder import Checkpoint, action_stats, training_checkpoints
from hma_model.config import OBJECTIVES, ActionSpace, HMAConfig
from hma_model.evaluation.losses import digit_frequencies
from hma_model.evaluation.rollout_video import newest_sheets
from hma_model.generation.engine import compiler_fault
from hma_model.network.model import HMA
from hma_model.training import guards, new_stem, optim
from hma_model.training.crops import cropped
from hma_model.training.data import TrainData
from hma_model.training.held_out import HeldOut
from hma_model.training.memory import require_memory
from hma_model.training.parallel import ParallelModel, Ranks, gathered, require_shardable
from hma_model.training.recipe import Recipe
from hma_model.training.resume import (
    OtherVersionError,
    RunState,
    TrainingState,
    data_digests,
    other_actions,
    read_training_state,
    require_network,
    require_version,
    seed_for,
    write_state,
)
from hma_model.training.runtime import ENVIRONMENT, RECIPE, attention_form, choose_precision, environment
from hma_model.training.scheduled_sampling import forwarded
from hma_model.training.start import Start


def sharing(sets: Mapping[str, ShardSet]) -> list[list[str]]:
    """Return the names of the robots of each `stats_key` that several have: they share statistics and stem.

    Raises:
        RecipeError: their actions differ in form.
    """
    found: dict[str, list[str]] = {}
    for name, shards in sets.items():
        if key := shards.embodiment.stats_key:
            found.setdefault(key, []).append(name)
    for key, names in found.items():
        forms = []
        for name in names:
            robot = sets[name].embodiment
            forms.append((robot.action.space, robot.action_dim, robot.stride, list(robot.normalize_mask)))
        if any(form != forms[0] for form in forms):
            fault = (
                f"{', '.join(names)} have stats_key {key}, and differ in action space, width, stride or mask"
            )
            raise RecipeError("recipe: data", fault, "give them different stats_key in their YAMLs")
    return [names for names in found.values() if len(names) > 1]


def pooled_statistics(sets: Mapping[str, ShardSet]) -> dict[str, dict[str, Any]]:
    """Return the statistics of each robot; of the actions, those over all robots that share them."""
    stats = {name: shards.manifest.stats for name, shards in sets.items()}
    for names in sharing(sets):
        pooled = Stats.empty(len(stats[names[0]]["action"]["mean"]))
        for name in names:
            part = stats[name]["action"]
            mean, std, low, high = (np.array(part[key], np.float64) for key in ("mean", "std", "min", "max"))
            pooled.merge(Stats(part["count"], mean, part["count"] * std**2, low, high))
        arrays = {key: getattr(pooled, key).tolist() for key in ("mean", "std", "min", "max")}
        for name in names:
            stats[name] = stats[name] | {"action": {"count": pooled.count, **arrays}}
    return stats


class Run:
    """A training run in an existing folder `out`: its model, optimizer, data and progress."""

    def __init__(self, recipe: Recipe, out: Path, device: torch.device, ranks: Ranks | None = None) -> None:
        if not recipe.data:
            raise RecipeError("recipe: data", "names no shards", "add data=[FOLDER, …]")
        self.out, self.device, self.ranks = out, device, ranks or Ranks()
        try:
            self.sets = open_sets(recipe.data, recipe.cameras)
        except UsageError as wrong:
            raise RecipeError(f"recipe: {wrong.where}", wrong.fault, wrong.remedy) from wrong
        self.start: Start | None = None
        if recipe.start is not None:
            self.ranks.once(lambda: Start.bring(recipe, self.sets, self.out))
            self.start = Start.open(recipe, self.sets, self.out)
        elif recipe.freeze == "trunk":
            fault = "freezes an untrained trunk"
            raise RecipeError("recipe: freeze", fault, "name a trained checkpoint with start=…")
        if self.start and "frames" not in recipe.model_fields_set:
            recipe = recipe.model_copy(update={"frames": self.start.checkpoint.config.frames})
        if recipe.parallel == "fsdp" and self.ranks.size > 1:
            require_shardable(recipe, self._config(recipe))
        self.recipe = recipe = self._with_precision(recipe)
        often = max(recipe.objectives, key=lambda name: recipe.objectives[name])
        self.objective = OBJECTIVES[often]  # whose loss the evaluations compute
        self.train_data = TrainData(recipe, self.sets, self.ranks)
        self.digests = data_digests(self.sets)
        self.stats = pooled_statistics(self.sets)
        if self.start:
            self.digests["the checkpoint it starts from"] = self.start.checkpoint.trunk_sha256[:16]
            self.stats = {name: self.start.stats(shards) for name, shards in self.sets.items()}
        with torch.device("meta"):  # shapes alone
            require_memory(self._network(), recipe, device, self.ranks.size)
        torch.manual_seed(seed_for(recipe.seed, "init"))
        self.model = self._fresh_model()
        self.held_out = HeldOut(recipe, self.sets, self.objective)
        self.step, self.skipped, self.seconds = 0, 0, 0.0  # finished steps, and the time they took
        self.cpu_seconds = 0.0  # of the steps; both are means over the ranks if the run ends by time
        self.evaluation: dict[str, Any] = {}  # the figures of the last one
        self.likes: dict[str, str] = {}  # new robot -> the robot with whose stem it began
        self.notes: list[str] = []  # texts for the user that nobody has shown yet
        self._twin: HMA | None = None

    def _with_precision(self, recipe: Recipe) -> Recipe:
        """Return the recipe with its precision resolved; of a run that is resumed, recipe.json has it."""
        config, written = self._config(recipe), self.out / RECIPE

        def choose() -> tuple[str, str]:
            begun = read_json(written).get("precision") if written.is_file() else None
            return choose_precision(recipe, config, self.device, begun)

        precision, reason = self.ranks.once(choose)
        chosen = recipe.model_copy(update={"precision": precision})
        self.arithmetic = f"precision {precision}: {reason}; {attention_form(chosen, config, self.device)}"
        return chosen

    def _config(self, recipe: Recipe) -> HMAConfig:
        if self.start:
            return self.start.network(recipe)
        return recipe.network(next(iter(self.sets.values())).spec)

    def _network(self) -> HMA:
        model = HMA(self._config(self.recipe))
        for name, shards in self.sets.items():
            space = ActionSpace.of(shards.embodiment, action_stats(self.stats[name], name))
            waves = self.start.waves(shards.embodiment, self.recipe) if self.start else None
            model.add_embodiment(space, waves=waves)
        for names in [] if self.start else sharing(self.sets):
            for name in names[1:]:
                if model.embodiments[name].agrees_with(replace(model.embodiments[names[0]], id=name)):
                    model.share_stem(names[0], name)
        return model

    def _fresh_model(self) -> HMA:
        """Return the model as training begins: with random weights, or with those it starts from."""
        model = self._network()
        if self.start:
            self.start.fill(model)
        model.to(self.device).train()
        model.trunk.checkpointing = self.recipe.checkpointing
        return model

    @property
    def done(self) -> float:
        """Return the share of the run that is done: of its steps or its time, whichever is larger."""
        recipe, shares = self.recipe, [self.step / self.recipe.steps]
        for spent, limit in ((self.seconds, recipe.seconds), (self.cpu_seconds, recipe.cpu_seconds)):
            if limit:
                shares.append(spent / limit)
        return max(shares)

    def note_settings(self) -> None:
        """Note what the user may not expect of the recipe and the data."""
        recipe = self.recipe
        self.notes.insert(0, self.arithmetic)
        if missing := self.held_out.missing:
            self.notes.append(f"no validation windows of {recipe.frames} frames: {', '.join(missing)}")
        if recipe.warmup > recipe.steps:
            steps = f"warmup takes {recipe.warmup} of {recipe.steps} steps"
            self.notes.append(f"the learning rate never reaches lr: {steps}")
        if self.start and not self.step:
            self.notes += self.start.remarks(self.sets)
        if self.ranks.size > 1:
            passes = f"{self.train_data.passes} passes per step over {self.ranks.size} ranks"
            self.notes.append(f"{passes}, {recipe.parallel}")

    @torch.no_grad()
    def begin(self) -> None:
        """Begin with what no step must learn: token frequencies in the readout's bias, or like stems."""
        if self.start:
            self._begin_like(self.start.checkpoint)
            return
        if not self.model.config.discrete:
            return
        drawn = zip(self.train_data.mixture.p, self.sets.values())
        given = self.model.config.factored, self.recipe.cameras
        shares = [[p * d for d in digit_frequencies(shards, *given)] for p, shards in drawn]
        digits = [sum(digit) for digit in zip(*shares)]
        bias = np.log(np.concatenate(digits * self.model.config.merge**2))
        own = self.model.token_readout.linear.bias
        own.copy_(torch.from_numpy(bias).to(own))

    def _begin_like(self, start: Checkpoint) -> None:
        """Give new robots the stems of like ones, where these have a lower loss."""
        cameras, objective = self.recipe.cameras, self.objective.name
        for name, shards in self.sets.items():
            if name in start.embodiments or self.recipe.new_stem == "fresh":
                continue
            choose = partial(new_stem.choose, self.model, name, start, shards, cameras, objective)
            if chosen := self.ranks.once(choose):
                new_stem.copy_stem(self.model, name, start, chosen.like)
                self.likes[name] = chosen.like
                better = f"loss {chosen.loss:.3g} vs {chosen.fresh_loss:.3g} with a fresh stem"
                self.notes.append(f"{name} starts from the stem of {chosen.like}: {better}")

    def prepare(self, kept: TrainingState | None) -> None:
        """Distribute the model over the ranks, and make its optimizer and average, from `kept` if given."""
        if self.recipe.compile and (fault := compiler_fault(self.device)):
            self.notes.append(fault)
        elif self.recipe.compile:
            for block in self.model.trunk.blocks:
                block.compile(dynamic=False)  # symbolic sizes fail for convolutions, and sizes do not vary
        self.parallel_model = ParallelModel(self.model, self.ranks, self.recipe.parallel)
        self.optimizer = optim.make_optimizer(self.model, self.recipe)
        self.average = optim.Average(self.model, self.recipe.ema) if self.recipe.ema else None
        if kept:
            optim.load_optimizer_state(self.optimizer, kept.moments)
            if self.average:
                self.average.load(kept.averages)

    # -- a step

    def advance(self) -> dict[str, Any]:
        """Update the weights once, and return the step's line of metrics.jsonl."""
        recipe, begun, cpu_begun = self.recipe, time.monotonic(), time.process_time()
        lr = optim.set_lr(self.optimizer, optim.lr_scale(self.step, recipe, self.done))
        self.optimizer.zero_grad(set_to_none=True)
        metrics, seen, waited = guards.StepMetrics(list(self.sets), self.device, self.objective.name), [], 0.0
        batches = self.train_data.step()
        for _ in self.train_data.own:
            asked = time.monotonic()
            number, batch = next(batches)
            waited += time.monotonic() - asked
            output = self._pass(number, batch.to(self.device), number == self.train_data.own[-1])
            metrics.add(batch.embodiment, output)
            seen.append((batch, output.per_sample))
        self.parallel_model.average()
        norm = self.parallel_model.clip(recipe.clip)
        loss, by_embodiment, by_objective = metrics.whole(self.ranks, self.train_data.passes)
        self.step += 1
        if not (math.isfinite(loss) and math.isfinite(norm)):
            self._refuse(f"the loss is {loss}, the gradient's norm {norm}", seen)
        else:
            self.optimizer.step()
            if self.average:
                self.average.update(self.step)
        spent, spent_cpu = time.monotonic() - begun, time.process_time() - cpu_begun
        if recipe.ends_by_time:  # all ranks end after the same step
            spent, spent_cpu = (self.ranks.sum(torch.tensor([spent, spent_cpu])) / self.ranks.size).tolist()
        self.seconds += spent
        self.cpu_seconds += spent_cpu
        return {
            "step": self.step,
            "done": round(self.done, 6),
            "loss": loss,
            "loss_by_embodiment": by_embodiment,
            "objectives": list(by_objective),
            "loss_by_objective": by_objective,
            "lr": lr,
            "grad_norm": norm,
            "windows": recipe.windows_per_step,
            "step_seconds": round(spent, 6),
            "data_seconds": round(waited, 6),
            "memory_mib": guards.peak_memory_mib(self.device),
            "skipped": self.skipped,
        }

    def _pass(self, number: int, batch: Batch, last: bool) -> Any:
        """Run a forward and backward pass; the loss of a step is the mean over the passes of all ranks."""
        recipe = self.recipe
        generator = self._generator("masks", number)
        with self.parallel_model.passing(last):
            with self._autocast():
                # not compiled: each number of windows would be compiled anew
                with torch.compiler.set_stance("force_eager") if recipe.compile else nullcontext():
                    if self.model.config.crop and self.done < recipe.whole_from:
                        batch = cropped(self.model.config, batch, self._generator("crops", number))
                    if recipe.self_forward and self.step >= recipe.self_forward_from:  # its own past
                        own = recipe.self_forward, recipe.self_forward_frames
                        batch = forwarded(self.model, batch, *own, self._generator("self_forward", number))
                output = self.parallel_model(batch, generator=generator)
            if not output.loss.requires_grad:
                fault = f"leaves nothing to train with the objective {output.objective}"
                raise RecipeError("recipe: freeze", fault, "use freeze=nothing, or another objective")
            (output.loss / len(self.train_data.own)).backward()
        return output

    def _generator(self, what: str, number: int) -> torch.Generator:
        return torch.Generator().manual_seed(seed_for(self.recipe.seed, what, self.step, number))

    def _autocast(self) -> AbstractContextManager[Any]:
        if self.recipe.precision == "fp32":
            return nullcontext()
        return torch.autocast(self.device.type, torch.bfloat16)

    def _refuse(self, fault: str, seen: list[tuple[Batch, Tensor]]) -> None:
        if self.recipe.nonfinite == "skip":
            self.skipped += 1
            return
        suspected = [item for part in self.ranks.gather(guards.suspects(seen, self.sets)) for item in part]
        names = guards.listed([text for _, text in guards.worst(suspected)])
        remedy = "look at them with hma shards preview, lower lr, or skip such steps with nonfinite=skip"
        raise TrainingError(f"step {self.step}", f"{fault}; windows: {names}", remedy)

    # -- evaluation and checkpoints

    def saved_model(self) -> HMA:
        """Return the model to evaluate and save, or with `ema` its average; every rank must call it."""
        if not self.average and not self.parallel_model.sharded:
            return self.model
        state = self.average.state() if self.average else gathered(self.model.state_dict().items())
        if self.ranks.main:
            self._twin = self._twin or self._network().to(self.device)
            self._twin.load_state_dict(state)
        return self._twin or self.model

    def evaluate(self) -> dict[str, Any]:
        """Measure on held-out windows, see `HeldOut`, and return the line of metrics.jsonl."""
        model = self.saved_model()
        self.evaluation = self.ranks.once(lambda: self._evaluated(model))
        return self.evaluation

    def _evaluated(self, model: HMA) -> dict[str, Any]:
        begun = time.monotonic()
        spare = self.recipe.pictures_share * self.seconds if self.done < 1 else math.inf
        with self._autocast(), torch.compiler.set_stance("force_eager"):
            facts = {"step": self.step, **self.held_out.measure(model)}
            facts["seconds"] = round(time.monotonic() - begun, 3)
            if fault := self.held_out.draw(model, self.out, self.step, spare):
                self.notes.append(fault)
        return facts

    def save(self) -> Path:
        """Write checkpoints/step-N, and delete all but the last few; every rank must call it."""
        model, sampler = self.saved_model(), self.train_data.state(self.ranks)
        moments = optim.optimizer_state(self.optimizer)
        weights = gathered(self.model.state_dict().items()) if self.average else {}
        state = RunState(
            step=self.step,
            recipe=self.recipe.identity(),
            data=self.digests,
            sampler=sampler,
            skipped=self.skipped,
            seconds=self.seconds,
            cpu_seconds=self.cpu_seconds,
            evaluation=self.evaluation,
        )

        def write() -> Path:
            path = self.out / "checkpoints" / f"step-{self.step:08d}"
            sheets = newest_sheets(self.out)
            checkpoints.save(
                model,
                path,
                embodiment_yaml={name: s.embodiment.to_yaml() for name, s in self.sets.items()},
                stats=self.stats,
                cards={name: self._card(name, s) for name, s in self.sets.items()},
                training=lambda folder: write_state(folder, state, moments, weights),
                base=self.start.checkpoint if self.start and self.start.frozen else None,
                samples={name: sheets[name].read_bytes() for name in self.sets if name in sheets},
            )
            there = training_checkpoints(self.out)
            behind = there.index(path) + 1  # those ahead could not be read, or the run would be there
            for old in (*there[behind:], *there[: max(0, behind - self.recipe.keep_last)]):
                checkpoints.remove(old)
            return path

        return self.ranks.once(write)

    def _card(self, name: str, shards: ShardSet) -> dict[str, Any]:
        figures = (("val_loss", "loss"), ("baseline_loss", "baseline"), ("accuracy", "accuracy"))
        found = ((ours, self.evaluation.get(f"{theirs}_by_embodiment")) for ours, theirs in figures)
        metrics = {ours: values.get(name) for ours, values in found if values is not None}
        train = shards.manifest.splits.get("train", {})
        data: dict[str, Any] = {key: train.get(key) for key in ("episodes", "frames")}
        if self.recipe.cameras != "first":
            data["cameras"] = self.recipe.cameras
        if "://" in shards.manifest.source:  # a path is of no use on another machine
            data["source"] = shards.manifest.source
        if "://" in str(shards.folder):
            data["shards"] = str(shards.folder)
        training: dict[str, Any] = {"steps": self.step, "seed": self.recipe.seed}
        if self.start:
            training["from_trunk_sha256"] = self.start.checkpoint.trunk_sha256
            training["trunk"] = "frozen" if self.start.frozen else "tuned"
            if name in self.likes:
                training["stem_from"] = self.likes[name]
            if is_repository(addressed(self.start.source)[0]):
                training["from"] = self.start.source
        return {"data": data, "metrics": metrics, "training": training}

    # -- resuming

    def resume(self, force: bool) -> TrainingState | None:
        """Load the newest readable checkpoint, and return its content for `prepare`; None without any.

        Raises:
            RecipeError: the recipe or the shards differ from those of the run.
            OtherVersionError: the newest checkpoint is of another format version.
            CheckpointError: there are checkpoints, and none can be read.
        """
        self.ranks.once(lambda: remove_parts(self.out))
        self.ranks.once(lambda: remove_partial(self.out / "checkpoints"))
        kept, paths = None, training_checkpoints(self.out)
        for path in reversed(paths):
            try:
                kept = self._load(path, force)
                break
            except OtherVersionError:
                raise
            except CheckpointError as fault:
                if path == paths[0]:
                    remedy = "no checkpoint here can be read: restore one, or train into another folder"
                    raise CheckpointError(fault.where, fault.fault, remedy) from fault
                self.notes.append(f"skipped a damaged checkpoint: {fault}")
        self.ranks.once(self._describe)
        return kept

    def _load(self, path: Path, force: bool) -> TrainingState:
        require_version(path)
        checkpoint = Checkpoint.open(path)
        kept = read_training_state(checkpoint, self.sets)
        state = kept.state
        if not force:
            state.require_same(self.recipe.identity(), self.digests, self.out)
        require_network(checkpoint.config, self.model.config, self.out)
        for name in set(self.sets) & set(checkpoint.embodiments):
            if other := other_actions(checkpoint.embodiment(name), self.sets[name].embodiment):
                remedy = "undo the change in its YAML, or train into another folder"
                raise RecipeError(self.out, f"was started on {other}", remedy)
        notes = self._adopt(checkpoint)
        kept.fill(self.model)
        for name in set(self.sets) & set(checkpoint.embodiments):
            if like := checkpoint.card(name).get("training", {}).get("stem_from"):
                self.likes[name] = like
        self.step, self.skipped, self.seconds = state.step, state.skipped, state.seconds
        self.cpu_seconds = state.cpu_seconds
        self.evaluation = state.evaluation
        self.notes += [*notes, f"resuming from step {state.step}"]
        if fault := self.train_data.load_state(state.sampler, force):
            self.notes.append(f"the sampler restarts: {fault}")
        return kept

    def _adopt(self, checkpoint: Checkpoint) -> list[str]:
        """Keep the statistics that the stems were trained with, if those of the shards have changed."""
        notes = []
        for name, shards in self.sets.items():
            if name not in checkpoint.embodiments:
                notes.append(f"{name} is new in this run and gets a new stem and head")
                continue
            stats = checkpoint.stats(name)
            space = ActionSpace.of(shards.embodiment, action_stats(stats, name))
            if not self.model.embodiments[name].agrees_with(space):
                self.stats[name] = stats
                notes.append(f"{name} keeps the statistics that its stem was trained with")
        if notes:
            self.model = self._fresh_model()
        left = sorted(set(checkpoint.embodiments) - set(self.sets))
        if left and not (self.start and self.start.frozen):
            notes.append(f"the next checkpoints leave out: {', '.join(left)}")
        return notes

    def _describe(self) -> None:
        write_atomic(self.out / RECIPE, to_json(self.recipe.values()))
        facts = {**environment(self.device), "ranks": self.ranks.size}
        write_atomic(self.out / ENVIRONMENT, to_json(facts))
