"""Reward models of lerobot as judges: their accuracy on labelled episodes, and what is refused."""

import json
import sys
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs.rewards import RewardModelConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.rewards.pretrained import PreTrainedRewardModel
from typer.testing import CliRunner

from hma_data.errors import HMAError, MissingDependencyError, UsageError
from hma_data.shards.reader import ShardSet
from hma_data.tokenizers.base import get_tokenizer
from hma_model.checkpoint.folder import Checkpoint
from hma_model.cli import app
from hma_model.evaluation.agreement import accuracy
from hma_model.lerobot_env.vector import LeRobotVectorEnv
from hma_model.policies.arenas import Scenes
from hma_model.policies.recorded import UNKNOWN, evaluate_recorded, html, recorded_beginnings
from hma_model.policies.report import write_report
from hma_model.policies.rewards import NEEDED, RewardModel, measured_judge
from hma_model.simulate import World, load_world
from hma_model.synthetic.augment import Augmentation, augment
from tests.model.shards import make_shards, state
from tests.model.true_world import trained_on

pytestmark = pytest.mark.slow  # of the import of lerobot, and of transformers, which the encoder needs
ROBOT, CAMERA = "twist_arm", "observation.images.top"
HELD_OUT = 16


@RewardModelConfig.register_subclass("tiny_brightness")
@dataclass
class TinyConfig(RewardModelConfig):
    """The configuration of a model that scores how bright an image is."""


class TinyRewardModel(PreTrainedRewardModel):
    config_class, name = TinyConfig, "tiny_brightness"

    def __init__(self, config: TinyConfig, **others: Any) -> None:
        super().__init__(config)
        self.limit = torch.nn.Parameter(torch.zeros(()))

    def compute_reward(self, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        (image,) = (batch[key] for key in self.config.input_features)
        return (image.mean(dim=(1, 2, 3)) > self.limit).float()


def saved(folder: Path, limit: float, *cameras: str) -> Path:
    keys = cameras or (CAMERA,)
    inputs = {key: PolicyFeature(FeatureType.VISUAL, (3, 64, 64)) for key in keys}
    model = TinyRewardModel(TinyConfig(device="cpu", input_features=inputs))
    torch.nn.init.constant_(model.limit, limit)
    model.save_pretrained(folder)
    return folder


def label(shards: Path, outcomes: list[bool | None]) -> None:
    """Let episodes.parquet state the outcomes of the last episodes."""
    state(shards, "success", last=outcomes)


@pytest.fixture
def shards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Shards without labels; every second episode ends with bright frames."""
    tokenizer, numbers = get_tokenizer("fsq-8"), count()
    dark, bright = tokenizer.encode(
        np.stack([np.full((128, 128, 3), level, np.uint8) for level in (20, 220)])
    )

    def filmed(rng: np.random.Generator, length: int, dims: int, grid: Any) -> tuple[Any, Any]:
        tokens = np.repeat(dark[None], length, axis=0)
        if next(numbers) % 2:
            tokens[-4:] = bright
        return tokens, rng.normal(size=(length, dims)).astype(np.float32)

    monkeypatch.setattr("tests.model.shards.episode", filmed)
    return make_shards(tmp_path / "shards", ROBOT, episodes=20, spec=tokenizer.spec, held_out=HELD_OUT)


@pytest.fixture
def world(shards: Path, tmp_path: Path) -> World:
    trained_on("first", ShardSet(shards), tmp_path / "model", frames=4)
    return load_world(tmp_path / "model")


@pytest.fixture
def judge(shards: Path, tmp_path: Path) -> Path:
    """A reward model that is right about all held-out episodes but the first two: a miss and an alarm."""
    label(shards, [True, False, *(bool(number % 2) for number in range(2, HELD_OUT))])
    return saved(tmp_path / "reward", 0.5)


def test_its_true_and_false_positives_are_those_of_the_held_out_episodes(world, shards, judge) -> None:
    told: list[str] = []
    found = measured_judge(str(judge), world, ROBOT, ShardSet(shards), told.append)
    assert (found.hits, found.alarms, found.held_out.count, found.held_out.successes) == (7, 1, 16, 8)
    said = "true positives 7 of 8 (47% to 100%), false positives 1 of 8 (0% to 53%)"
    assert found.sentence == f"judge on held-out recorded episodes: {said}"
    assert told[-1] == "measuring the judge: episode 16 of 16"
    assert found.to_json()["false_positive_interval"] == pytest.approx((0.003, 0.527), abs=1e-3)


def test_held_out_episodes_of_one_recording_count_as_one(world, shards, judge) -> None:
    state(shards, "group", last=[f"r{number // 6}" for number in range(HELD_OUT)])
    with pytest.raises(HMAError, match=f"with {NEEDED} or more of each, of different recordings"):
        measured_judge(str(judge), world, ROBOT, ShardSet(shards))
    state(shards, "group", last=[f"r{(number + 2) // 3}" for number in range(HELD_OUT)])
    found = measured_judge(str(judge), world, ROBOT, ShardSet(shards))
    assert (found.hits, found.alarms, found.held_out.count) == (7, 1, 16)
    assert found.hits_95[0] < 0.45 and found.alarms_95[1] > 0.55  # of eight recordings 0.47 and 0.53
    scenes = Scenes.of(world, ROBOT, 12, 0, simulator=False)
    assert recorded_beginnings(world, scenes, ShardSet(shards))[1] == 6


def test_policies_are_scored_in_the_model_alone_and_a_stop_continues(
    world: World, shards: Path, judge: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: Any = {"judge": str(judge), "shards": shards, "episodes": 4, "frames": 4}
    found = evaluate_recorded(ROBOT, ["random", "still"], world=world, out=tmp_path / "out", **given)
    assert [row["policy"] for row in found.rows()] == ["random", "still"] and UNKNOWN in found.sentences()
    assert found.policies[0].images.shape == (4, 5, 128, 128, 3)
    with monkeypatch.context() as patch:  # finished policies are not played again
        patch.setattr("hma_model.policies.recorded.run", None)
        again = evaluate_recorded(ROBOT, ["random", "still"], world=world, out=tmp_path / "out", **given)
    assert json.dumps(again.to_json()) == json.dumps(found.to_json())
    page = write_report(found.to_json(), html(found), tmp_path / "out").read_text()
    assert page.count("<img") >= 2 and "true positives 7 of 8" in page
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["report.html", "results.json"]


def test_the_command_line_judges_by_a_reward_model(world: World, shards: Path, judge: Path) -> None:
    words = ["policy-eval", ROBOT, "random", "--checkpoint", str(shards.parent / "model"), "--json"]
    words += ["--episodes", "2", "--frames", "4", "--judge", str(judge)]
    told = CliRunner().invoke(app, [*words, "--from", str(shards)])
    assert told.exit_code == 0, told.output
    assert json.loads(told.stdout)["judge"]["true_positives"] == 7
    assert isinstance(CliRunner().invoke(app, words).exception, UsageError)  # there is no training run


def test_lerobots_evaluation_is_judged_by_it(world, shards, judge, caplog) -> None:
    checkpoint = Checkpoint.open(shards.parent / "model")
    given: Any = {"judge": str(judge), "judge_from": str(shards), "prompt": str(shards), "horizon": 8}
    env = LeRobotVectorEnv(checkpoint, ROBOT, 2, world, state=False, **given)
    assert isinstance(env.judge, RewardModel) and "true positives 7 of 8" in caplog.text
    env.reset(seed=[0, 1])
    images = [[one.image] for one in env.envs]
    seen = np.zeros((8, 2))
    for step in range(8):  # an episode that has ended gives no more rewards
        _, seen[step], _, _, infos = env.step(np.zeros(env.action_space.shape, np.float32))
        for shown, one in zip(images, env.envs, strict=True):
            shown.append(one.image)
    highest = env.judge.score(np.array(images))
    np.testing.assert_allclose(seen.max(axis=0), highest)
    assert (infos["is_success"] == (highest > 0.5)).all()


def test_synthetic_episodes_that_it_calls_failures_are_left_out(world, shards, judge, tmp_path, monkeypatch):
    score = RewardModel.score

    def every_second(model: RewardModel, images: Any) -> Any:
        return score(model, images) if len(images) == 1 else np.array([0.9, 0.1, 0.9, 0.1])

    monkeypatch.setattr(RewardModel, "score", every_second)
    settings = Augmentation(ROBOT, str(shards), episodes=4, frames=4, keep=1.0, judge=str(judge))
    with pytest.warns(UserWarning, match="true positives 7 of 8"):
        made = augment(tmp_path / "made", settings, world=world, shards=shards)
    assert sum(split["episodes"] for split in made.splits.values()) == 2


@pytest.mark.parametrize("policy", ["scripted", "reach:noise=0.5"])
def test_policies_that_need_a_simulator_are_refused(world, shards, judge, policy) -> None:
    with pytest.raises(UsageError, match=f"policy {policy}: reads the state of a simulator"):
        evaluate_recorded(ROBOT, [policy], judge=str(judge), shards=shards, world=world)


def test_a_judge_no_better_than_chance_and_too_few_labels_are_refused(world, shards, judge) -> None:
    label(shards, [bool(number % 2) for number in range(HELD_OUT)])
    always = saved(judge.parent / "always", -1.0)
    said = r"may be no better than chance: true positives 8 of 8 \(63% to 100%\), false positives 8 of 8 \(63"
    with pytest.raises(HMAError, match=said):
        measured_judge(str(always), world, ROBOT, ShardSet(shards))
    label(shards, [True, True, False] + [None] * (HELD_OUT - 3))
    said = f"has 2 successes and 1 failures .* too few .* give --from SHARDS .* with {NEEDED} or more of each"
    with pytest.raises(HMAError, match=said):
        measured_judge(str(judge), world, ROBOT, ShardSet(shards))
    label(shards, [None] * HELD_OUT)
    with pytest.raises(HMAError, match="has 0 successes and 0 failures"):
        measured_judge(str(judge), world, ROBOT, ShardSet(shards))


def test_so_many_labels_are_needed_as_is_said() -> None:
    for each, few in ((NEEDED - 1, True), (NEEDED, False)):
        true = np.arange(2 * each) < each
        assert bool(accuracy(true, true).too_few) == few


def test_what_is_no_safe_reward_model_of_frames_is_refused_in_one_line(tmp_path, monkeypatch) -> None:
    def refused(folder: Path | str, *cameras: str) -> str:
        with pytest.raises(HMAError) as fault:
            RewardModel(str(folder), cameras or ("top",), ROBOT)
        assert "\n" not in str(fault.value)
        return str(fault.value)

    assert "no such folder" in refused(tmp_path / "nope")
    assert "has no config.json" in refused(tmp_path)
    wrist = saved(tmp_path / "wrist", 0, "observation.images.wrist")
    assert "takes observation.images.wrist — the world model shows left, right" in refused(
        wrist, "left", "right"
    )
    assert "takes observation.state" in refused(saved(tmp_path / "state", 0, "observation.state"))
    pickled = saved(tmp_path / "pickled", 0)
    (pickled / "model.safetensors").rename(pickled / "pytorch_model.bin")
    assert "has no model.safetensors" in refused(pickled)
    path = saved(tmp_path / "path", 0)
    (path / "any_preprocessor.json").write_text('{"name": "p", "steps": [{"class": "os.system"}]}')
    assert "any_preprocessor.json names a step by a Python path" in refused(path)
    video = saved(tmp_path / "video", 0)
    (video / "config.json").write_text('{"type": "sarm"}')
    assert "is a sarm, which scores videos" in refused(video)
    (video / "config.json").write_text('{"type": "unheard_of"}')
    assert "cannot be loaded" in refused(video)
    cut = saved(tmp_path / "cut", 0)
    (cut / "model.safetensors").write_bytes(b"\x00" * 20)
    assert "cannot be loaded" in refused(cut)
    monkeypatch.setitem(sys.modules, "transformers", None)
    (cut / "config.json").write_text('{"type": "reward_classifier", "device": "cpu"}')
    with pytest.raises(MissingDependencyError, match="reward_classifier needs it .* pip install 'lerobot"):
        RewardModel(str(cut), ["top"], ROBOT)


def test_lerobots_classifier_runs_no_code_and_gives_its_own_rewards(tmp_path: Path) -> None:
    import transformers
    from lerobot.rewards.classifier.configuration_classifier import RewardClassifierConfig
    from lerobot.rewards.classifier.modeling_classifier import Classifier
    from lerobot.rewards.classifier.processor_classifier import make_classifier_processor

    torch.manual_seed(0)
    sizes: Any = {"embedding_size": 8, "hidden_sizes": [8, 8, 8, 8], "depths": [1, 1, 1, 1]}
    transformers.ResNetModel(transformers.ResNetConfig(**sizes)).save_pretrained(tmp_path / "encoder")
    config = RewardClassifierConfig(
        model_name=str(tmp_path / "encoder"), num_cameras=1, latent_dim=8, hidden_dim=8,
        input_features={CAMERA: PolicyFeature(FeatureType.VISUAL, (3, 128, 128))},
    )  # fmt: skip
    own = Classifier(config).eval()
    own.save_pretrained(tmp_path / "reward")
    stats = {CAMERA: {"mean": torch.full((3, 1, 1), 0.4), "std": torch.full((3, 1, 1), 0.2)}}
    before, _ = make_classifier_processor(config, stats)
    before.save_pretrained(tmp_path / "reward")
    (tmp_path / "encoder" / "model.safetensors").unlink()  # it needs none of these weights
    model = RewardModel(str(tmp_path / "reward"), ["top"], ROBOT)
    images = np.random.default_rng(0).integers(0, 256, (24, 128, 128, 3), np.uint8)
    images[::2] //= 8
    batch = before({CAMERA: torch.from_numpy(images).permute(0, 3, 1, 2) / 255})
    with torch.inference_mode():
        wanted = own.compute_reward(batch).numpy()
    np.testing.assert_array_equal(model.rewards(images), wanted)
    parts: Any = model._model.state_dict()
    assert all(torch.equal(value, parts[name]) for name, value in own.state_dict().items())
    settings = json.loads((tmp_path / "encoder" / "config.json").read_text())
    settings |= {"model_type": "own", "auto_map": {"AutoConfig": "code.Own", "AutoModel": "code.Model"}}
    (tmp_path / "encoder" / "config.json").write_text(json.dumps(settings))
    (tmp_path / "encoder" / "code.py").write_text("raise SystemExit('code of a repository ran')")
    with pytest.raises(HMAError, match="cannot be loaded: ValueError"):
        RewardModel(str(tmp_path / "reward"), ["top"], ROBOT)
