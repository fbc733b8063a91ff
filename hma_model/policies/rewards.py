"""Judge episodes of any robot by a reward model of lerobot that scores single frames.

A reward model is a success classifier trained with lerobot. It scores images, so it needs no simulator. An
episode counts as a success as soon as one frame is scored above 0.5, as in lerobot's own training loop. How
often that is right is measured on held-out episodes whose outcome was recorded, as the tokenizer shows them.

Nothing is unpickled, and no code of a repository runs: weights and statistics are safetensors files.

N episodes, T frames, S pixels a side, V views side by side.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

from hma_data.arrays import Bools, Floats, Images
from hma_data.errors import HMAError, MissingDependencyError, UsageError
from hma_data.lab import imported
from hma_data.shards.reader import ShardSet
from hma_model.evaluation.agreement import NEEDED, Accuracy, accuracy, by_scene, independent, share_interval
from hma_model.evaluation.state_reader import Tell
from hma_model.generation.decode import cameras_for, trained_shards
from hma_model.policies.lerobot import CONFIG, TASK, hub_repository, loading, network_images
from hma_model.worlds.env import Judge
from hma_model.worlds.prompts import SeenShards, require_fit
from hma_model.worlds.world import World

LIMIT = 0.5  # least reward of a success, as lerobot's
FRAMES_AT_ONCE = 64
SHARDS = "--from SHARDS (lerobot-eval: --env.judge_from)"
WEIGHTS = "model.safetensors"
PREPROCESSOR = "*preprocessor.json"
VIDEO_MODELS = ("sarm", "robometer", "topreward")  # they score a video and its text, not a frame


def names_reward_model(judge: str) -> bool:
    """Check whether the words of a judge are a folder or ORGANISATION/NAME, not a task of the laboratory."""
    return "/" in judge or Path(judge).is_dir()


class RewardModel:
    """A reward model of lerobot that scores frames, with the preprocessor that it was saved with.

    Args:
        source: its folder or hub repository.
        cameras: names of the V views that a world model's image shows.
        task: what the robot is told.
        device: of the network.

    Raises:
        HMAError: it cannot be loaded safely, scores no single frames, or takes other inputs.
    """

    def __init__(self, source: str, cameras: Sequence[str], task: str, device: str = "cpu") -> None:
        self.name = f"judge {source}"
        self._task = task
        self._device = device
        folder = _folder(source, self.name)
        with imported("lerobot"):
            from lerobot.configs.rewards import RewardModelConfig
            from lerobot.processor import PolicyProcessorPipeline
            from lerobot.rewards import get_reward_model_class
        from safetensors.torch import load_model

        remedy = "give a reward model that lerobot has saved, whose encoder needs no code of its own"
        with loading(self.name, remedy):
            kind = json.loads((folder / CONFIG).read_text()).get("type")
            if kind in VIDEO_MODELS:
                another = "give a reward_classifier, or another model that scores single frames"
                raise HMAError(self.name, f"is a {kind}, which scores videos", another)
            config = RewardModelConfig.from_pretrained(folder)
            config.device = device
            with _encoder_without_code() if kind == "reward_classifier" else nullcontext():
                self._model: Any = get_reward_model_class(config.type)(config)
            # not by lerobot's loader, which leaves missing weights random
            missing, _ = load_model(self._model, folder / WEIGHTS, strict=False)
            if missing:
                raise ValueError(f"{WEIGHTS} lacks {min(missing)}")
            self._model.to(device).eval()
            self._before: Any = lambda batch: batch
            for path in sorted(folder.glob(PREPROCESSOR)):
                _require_registered(path, self.name)
                there = {"device_processor": {"device": device}}
                self._before = PolicyProcessorPipeline.from_pretrained(
                    folder, config_filename=path.name, overrides=there
                )
        self._keys = self._places(config, cameras)

    def _places(self, config: Any, cameras: Sequence[str]) -> dict[str, tuple[int, tuple[int, int]]]:
        """Return the view and the height and width of each image that the model takes."""
        keys = list(config.input_features)
        names = [key.rpartition(".")[2] for key in keys]
        if len(keys) == len(cameras) == 1:
            names = list(cameras)
        others = [key for key in keys if not key.startswith("observation.image")]
        if not keys or others or not set(names) <= set(cameras):
            fault = f"takes {', '.join(keys) or 'no camera'}"
            raise HMAError(self.name, fault, f"the world model shows {', '.join(cameras)}")
        self._views = len(cameras)
        shapes = [tuple(config.input_features[key].shape[1:]) for key in keys]
        places = [list(cameras).index(name) for name in names]
        return dict(zip(keys, zip(places, shapes, strict=True), strict=True))

    def rewards(self, images: Images) -> Floats:
        """Return the rewards (N,) of images (N, S, V·S, 3)."""
        views = np.split(images, self._views, axis=2)
        batch: dict[str, Any] = {TASK: [self._task] * len(images)}
        for key, (place, shape) in self._keys.items():
            batch[key] = network_images(views[place], shape).to(self._device)
        with torch.inference_mode():
            found = self._model.compute_reward(self._before(batch))
        return np.asarray(found.float().cpu(), np.float64).reshape(len(images))

    def score(self, images: Images) -> Floats:
        """Return the highest reward (N,) of the frames of episodes (N, T, S, V·S, 3)."""
        flat = images.reshape(-1, *images.shape[2:])
        parts = [self.rewards(flat[i : i + FRAMES_AT_ONCE]) for i in range(0, len(flat), FRAMES_AT_ONCE)]
        return np.concatenate(parts).reshape(images.shape[:2]).max(axis=1)

    def success(self, scores: Floats) -> Bools:
        """Return which scores (N,) are a success."""
        return scores > LIMIT

    def begun(self) -> Judge:
        """Return the judge of one episode: its highest reward so far; it never ends the episode."""
        seen, highest = 0, -np.inf

        def judge(images: Images, actions: Any) -> tuple[float, bool]:
            nonlocal seen, highest
            if len(new := images[seen:]):
                highest = max(highest, float(self.score(new[None])[0]))
                seen = len(images)
            return highest, False

        return judge


@dataclass(frozen=True)
class RewardJudge:
    """A reward model with its accuracy.

    Attributes:
        held_out: its accuracy on recorded episodes that are held out of training.
        hits, alarms: successes, and failures, that it calls a success.
        hits_95, alarms_95: intervals of their shares, over recordings.
    """

    source: str
    model: RewardModel
    held_out: Accuracy
    hits: int
    alarms: int
    hits_95: tuple[float, float]
    alarms_95: tuple[float, float]

    @property
    def sentence(self) -> str:
        """Return in words how often it is right."""
        found = self.held_out
        seen = _of(self.hits, found.successes, self.hits_95)
        false = _of(self.alarms, found.count - found.successes, self.alarms_95)
        return f"judge on held-out recorded episodes: true positives {seen}, false positives {false}"

    def to_json(self) -> dict[str, Any]:
        """Return its figures as plain values."""
        return {
            "model": self.source,
            "held_out": vars(self.held_out),
            "true_positives": self.hits,
            "true_positive_interval": self.hits_95,
            "false_positives": self.alarms,
            "false_positive_interval": self.alarms_95,
        }


def _of(part: int, whole: int, ends: tuple[float, float]) -> str:
    return f"{part} of {whole} ({ends[0]:.0%} to {ends[1]:.0%})"


def measured_judge(
    source: str,
    world: World,
    embodiment: str,
    shards: ShardSet,
    tell: Tell = lambda words: None,
) -> RewardJudge:
    """Load a reward model and measure it on the held-out episodes of a shard set.

    Args:
        source: its folder or hub repository.
        world: whose images it is to judge.
        embodiment: a robot of the world.
        shards: of the robot and the world's tokenizer, with success labels.
        tell: called with how far it is.

    Raises:
        HMAError: it cannot be loaded, too few episodes are labelled, or it is no better than chance.
    """
    require_fit(world.model, embodiment, shards)
    rows = [row for row in shards.episodes.to_pylist() if row["split"] == "val"]
    rows = [row for row in rows if row["success"] is not None]
    true = np.array([row["success"] for row in rows], np.bool_)
    where = f"judge {source}"
    recordings = shards.recordings(row["episode_index"] for row in rows)
    if not len(rows) or accuracy(*by_scene(recordings, true, true)).too_few:
        successes = int(true.sum())
        fault = (
            f"{shards.folder} has {successes} successes and {len(true) - successes} failures among its "
            "held-out episodes with a success label, too few to measure its accuracy"
        )
        remedy = f"give {SHARDS} with {NEEDED} or more of each, of different recordings"
        raise HMAError(where, fault, remedy)
    seen = SeenShards(shards, cameras_for(world.model, shards))
    model = RewardModel(source, seen.cameras, embodiment, str(world.model.device))
    judged = np.empty(len(rows), np.bool_)
    for place, row in enumerate(rows):
        frames, _ = seen.episode(row)
        images = world.shown(frames[:: shards.row_stride])
        judged[place] = model.success(model.score(images[None]))[0]
        tell(f"measuring the judge: episode {place + 1} of {len(rows)}")
    success, said, kept = by_scene(recordings, true, judged)
    found = accuracy(success, said, kept)
    ends = [share_interval(*independent(said, one)) for one in (success, ~success & kept)]
    judge = RewardJudge(source, model, found, int(judged[true].sum()), int(judged[~true].sum()), *ends)
    if not found.better_than_chance:
        fault = f"may be no better than chance: {judge.sentence.partition(': ')[2]}"
        raise HMAError(where, fault, "train it on more episodes, or give another one")
    return judge


def labelled_shards(world: World, embodiment: str, given: Any, judge: str) -> ShardSet:
    """Return the shard set that is given, or that of the run that the world was loaded from.

    Raises:
        UsageError: there is none.
    """
    if given is not None:
        return ShardSet(given)
    if (shards := trained_shards(world.model, embodiment)) is not None:
        return shards
    fault = f"no recorded episodes of {embodiment} measure its accuracy"
    remedy = f"give {SHARDS} whose held-out episodes have {NEEDED} or more labelled successes and failures"
    raise UsageError(f"judge {judge}", fault, remedy)


def _folder(source: str, where: str) -> Path:
    """Return the folder of a reward model, of a repository without any file that could hold code."""
    folder, repository = Path(source), hub_repository(source, where, "reward model")
    if repository is not None:
        names = [name for name in repository.files() if "/" not in name]
        folder = repository.pull([name for name in names if name.endswith((".json", ".safetensors"))])
    for name in (CONFIG, WEIGHTS):
        if not (folder / name).is_file():
            raise HMAError(where, f"has no {name}", "give a reward model that lerobot has saved")
    return folder


def _require_registered(path: Path, where: str) -> None:
    """Refuse a preprocessor whose steps are named by a Python path: loading it would import that."""
    steps = json.loads(path.read_text())["steps"]
    if any("registry_name" not in step for step in steps):
        remedy = "save it again with steps that lerobot registers"
        raise HMAError(where, f"{path.name} names a step by a Python path", remedy)


@contextmanager
def _encoder_without_code() -> Iterator[None]:
    """Let lerobot's classifier make its encoder from a configuration alone.

    It would load weights, pickled ones too, and run the code of their repository. The classifier's own
    safetensors file holds the weights of its encoder.
    """
    try:
        from transformers import AutoConfig, AutoModel
    except ImportError as fault:
        said = f"cannot be imported: {fault}; lerobot's reward_classifier needs it"
        raise MissingDependencyError(
            "transformers", said, "pip install 'lerobot[transformers-dep]'"
        ) from fault

    def make(name: str, **ignored: Any) -> Any:
        return AutoModel.from_config(AutoConfig.from_pretrained(name, trust_remote_code=False))

    with patch.object(AutoModel, "from_pretrained", make):
        yield
