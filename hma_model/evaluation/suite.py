"""Evaluate several checkpoints on several shard sets, and keep what is done.

A part is a checkpoint and a shard set. With a folder, each finished part is a file of `parts/`, named by its
fingerprint: the digests of the checkpoint and of the set, and all settings. A part whose file is there is not
computed again, so the same command continues an interrupted one. The same settings and seed give the same
bytes of results.json.

    results.json    the figures of every part, and their means over the sets
    results.md      the table, and what is not measured
    report.html     the same with pictures and curves
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hma_data.arrays import Floats
from hma_data.console import progress, short_paths
from hma_data.errors import OutputError, UsageError
from hma_data.lab.simulator import simulated
from hma_data.loading.views import Cameras
from hma_data.shards.manifest import MANIFEST
from hma_data.shards.preview import tokenizer_of
from hma_data.shards.reader import ShardSet
from hma_data.storage.files import file_sha256, finite, short_sha256
from hma_data.storage.kept import KeptParts
from hma_data.storage.paths import StrPath, as_path, as_text
from hma_data.tokenizers.base import Tokenizer
from hma_model.checkpoint.io import record_locally
from hma_model.evaluation.evaluate import EvaluationSettings, WindowPlan, measure
from hma_model.evaluation.perceptual import NO_NETWORKS, Networks
from hma_model.evaluation.recorded_state import measure_recorded_state
from hma_model.evaluation.simulated import measure_state
from hma_model.evaluation.verdict import follows, verdict
from hma_model.generation.decode import model_for
from hma_model.network.model import HMA

FIGURES_VERSION = 8  # raise it when the same part gives other figures
PARTS, RESULTS = "parts", "results.json"


@dataclass(frozen=True)
class Part:
    """The result of a checkpoint on a shard set.

    Attributes:
        found: the figures.
        by_window: values (N,) of the windows, by the figure's name.
        predicted: the predicted tokens or latents (N, P, …) of the windows, by the kind of rollout.
    """

    checkpoint: str
    data: str
    found: dict[str, Any]
    by_window: dict[str, Floats]
    predicted: dict[str, NDArray[Any]]

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]], label: str, shards: ShardSet) -> "Part":
        """Return a part of the arrays that are kept of it, under the names of this command."""
        found = {"checkpoint": label, "data": str(shards.folder)} | json.loads(str(arrays["found"]))
        by_window, predicted = (
            {key.removeprefix(start): values for key, values in arrays.items() if key.startswith(start)}
            for start in ("by_window.", "predicted.")
        )
        return cls(label, str(shards.folder), found, by_window, predicted)


def evaluate_all(
    checkpoints: Sequence[StrPath],
    data: Sequence[StrPath],
    settings: EvaluationSettings,
    networks: Networks = NO_NETWORKS,
    out: StrPath | None = None,
    device: str = "cpu",
) -> list[Part]:
    """Evaluate each checkpoint on each shard set.

    Args:
        checkpoints: a str or path each, as `HMA.from_pretrained` takes them.
        data: the str or path of each shard set, or its URI; each of another embodiment.
        settings: options.
        networks: what measures LPIPS, FID and FVD.
        out: the folder that keeps finished parts; None keeps nothing.
        device: of the models and the tokenizer.

    Raises:
        CheckpointError: a checkpoint was trained on another tokenizer, or lacks an embodiment.
        UsageError: a split has no window, cameras do not fit, or a set of a checkpoint comes twice.
        OutputError: the folder holds something else.
    """
    kept = None if out is None else KeptParts(_folder(as_path(out)), {})
    sets = [ShardSet(item) for item in data]
    _once([as_text(item) for item in checkpoints], "checkpoint")
    _once([shards.embodiment.id for shards in sets], "embodiment")
    work: list[_Work] = []
    for checkpoint in checkpoints:  # all are checked before the first is measured
        model = model_for(checkpoint, sets, device)
        work += [_Work.of(as_text(checkpoint), model, shards, settings) for shards in sets]
    parts, done = [], 0
    shown = short_paths(list(dict.fromkeys(one.label for one in work)))
    with progress("evaluate", sum(one.frames for one in work)) as update:
        for one in work:
            robot = one.shards.embodiment.id
            about = f"{shown[one.label]}, {robot}"

            def tell(frames: int, what: str = "", done: int = done, about: str = about) -> None:
                update(done + frames, f"{about}: {what}" if what else about)

            measured = partial(_measured, one, settings, networks, tell)
            mark = fingerprint(one.model, one.shards, settings, networks)
            arrays = measured() if kept is None else kept.part(f"{robot}-{mark}", measured)
            part = Part.of(arrays, one.label, one.shards)
            if settings.split == "val":
                record_locally(one.label, one.model.source, robot, judged(part.found))
            parts.append(part)
            done += one.frames
            update(done, about)
    return parts


@dataclass(frozen=True)
class _Work:
    """A checkpoint and a shard set that go together; `frames` are predicted for their rollouts."""

    label: str
    model: HMA
    shards: ShardSet
    cameras: Cameras
    frames: int

    @classmethod
    def of(cls, label: str, model: HMA, shards: ShardSet, settings: EvaluationSettings) -> "_Work":
        plan = WindowPlan.of(model, shards, settings)
        if settings.state and not simulated(shards.embodiment.id) and not shards.embodiment.state:
            fault = "is not one of the toolkit's simulated robots, and its shards have no states"
            remedy = "leave --state out, or name the recorded states in its YAML and convert again"
            raise UsageError(shards.embodiment.id, fault, remedy)
        return cls(label, model, shards, plan.cameras, plan.predicted_frames(settings))


def _once(names: Sequence[str], what: str) -> None:
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UsageError(twice, f"is the {what} of two arguments", "give each once")


def fingerprint(model: HMA, shards: ShardSet, settings: EvaluationSettings, networks: Networks) -> str:
    """Return sixteen hex digits that stand for a part: its checkpoint, set and settings."""
    robot, source = shards.embodiment.id, model.source
    assert source, "the models of a suite are loaded from checkpoints"
    card = source.card(robot)
    facts = {
        "version": FIGURES_VERSION,
        "trunk": source.trunk_sha256,
        "embodiment": card.get("files"),
        "stats": card.get("stats_sha256"),
        "config": model.config.to_json(),
        "set": file_sha256(shards.folder / MANIFEST),
        "settings": asdict(settings),
        "networks": networks.facts,
    }
    return short_sha256(json.dumps(facts, sort_keys=True, default=str))


@lru_cache(maxsize=1)
def _tokenizer(folder: str, device: str) -> Tokenizer:
    return tokenizer_of(ShardSet(folder), device=device)


def _measured(
    work: _Work, settings: EvaluationSettings, networks: Networks, tell: Callable[..., None]
) -> dict[str, NDArray[Any]]:
    """Return the arrays of a part: `by_window.NAME`, `predicted.KIND`, and the figures as JSON."""
    model, shards, robot = work.model, work.shards, work.shards.embodiment.id
    tokenizer = _tokenizer(str(shards.folder), str(model.device))
    tell(0, "losses first")
    measured = measure(model, tokenizer, shards, settings, networks, tell)
    found = measured.found
    if settings.state and not simulated(robot):
        tell(work.frames, "its state, as it was recorded")
        found["state"], measured.by_window["state.error_sd_last"] = measure_recorded_state(
            tokenizer, shards, measured.batches, measured.predicted,
            prompt=found["prompt"], cameras=work.cameras, seed=settings.seed,
        )  # fmt: skip
    elif settings.state:
        tell(work.frames, "its state, in new episodes")
        sampling = dict(settings.sampling)
        found["state"] = measure_state(
            model, tokenizer, robot, frames=found["frames"], prompt=found["prompt"],
            episodes=settings.state, seed=settings.seed, **sampling,
        )  # fmt: skip
    elif simulated(robot) or shards.embodiment.state:
        found["missing"]["state"] = "not measured: --state estimates the robot's state from images"
    else:
        found["missing"]["state"] = (
            "not measured: the shards have no states, and the robot is none of the toolkit's simulated ones"
        )
    if networks.facts:
        found["networks"] = networks.facts
    arrays = {f"by_window.{name}": values.round(6) for name, values in measured.by_window.items()}
    for kind, made in measured.predicted.items():
        values = torch.cat(made).cpu().numpy()
        arrays[f"predicted.{kind}"] = values.astype(
            np.uint32 if model.config.kind == "discrete" else values.dtype
        )
    return arrays | {"found": np.array(json.dumps(finite(found)))}


def judged(found: Mapping[str, Any]) -> dict[str, Any]:
    """Return the verdict on a part for a model card, with the figures behind it."""
    figures = ("episodes", "windows", "psnr_action_gain_last", "psnr_action_gain_last_95")
    return {"verdict": verdict(found), "follows": follows(found)} | {
        name: found.get(name) for name in figures
    }


def _folder(out: Path) -> Path:
    """Return the folder of finished parts in an output, made if necessary."""
    if out.is_dir() and any(out.iterdir()) and not (out / PARTS).is_dir():
        raise OutputError(out, "holds something else than an evaluation", "name a new folder")
    try:
        (out / PARTS).mkdir(parents=True, exist_ok=True)
    except OSError as fault:
        raise OutputError(out, f"cannot be written: {fault.strerror}", "choose another --out") from fault
    return out / PARTS
