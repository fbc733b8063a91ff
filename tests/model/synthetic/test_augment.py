"""Synthetic episodes: shards that verify and say what they are, replays, resumption, LeRobotDatasets."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.conversion.rewrite import merge, split
from hma_data.errors import HMAError, OutputError, ShardError, UsageError
from hma_data.lab import family, record
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import EpisodeReader, ShardSet
from hma_data.shards.schema import flag_counts, read_footer
from hma_data.shards.verify import verify
from hma_data.sources.base import open_source
from hma_model.evaluation import probe
from hma_model.evaluation.calibration import Meter
from hma_model.policies.acting import Acting
from hma_model.policies.arenas import Scenes, TrueArena
from hma_model.policies.planning import Planning
from hma_model.policies.scripted import Still
from hma_model.simulate import World, load_world
from hma_model.synthetic import augment as augment_module
from hma_model.synthetic.augment import Augmentation, augment
from hma_model.synthetic.recorder import SyntheticEpisode, write_shards
from hma_model.worlds.images import Prompt
from hma_model.worlds.prompts import SeenShards
from tests.conftest import BlockTokenizer
from tests.data import cameras as three
from tests.model.shards import state_pauses
from tests.model.true_world import BlockLatents, latent_model, trained_on

BATCHES = augment_module._chosen
ROBOT, FRAMES, KNOWN = "rails_03", 4, 2


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(augment_module, "BATCH_EPISODES", 2)


@pytest.fixture
def latents() -> World:
    return World(latent_model(ROBOT), BlockLatents())


def asked(**given: Any) -> Augmentation:
    return Augmentation(ROBOT, **{"episodes": 4, "frames": FRAMES, "keep": 1.0} | given)


def episodes(folder: Path) -> list[dict[str, Any]]:
    shards = ShardSet(folder)
    reader = EpisodeReader(shards, shards.columns())
    return [reader.episode(row, shards.manifest.cameras[0]) for row in shards.episodes.to_pylist()]


def test_replayed_episodes_hold_the_recorders_actions_and_say_that_they_are_synthetic(world, tmp_path):
    manifest = augment(tmp_path / "out", asked(), world=world)
    assert verify(tmp_path / "out") == []
    made_by = manifest.plan["made_by"]
    assert made_by["synthetic"] is True and made_by["seed"] == 0 and made_by["checkpoint"] == "in memory"
    for shard in manifest.shards:
        assert read_footer(tmp_path / "out" / shard.path)[0].plan["made_by"] == made_by
    true = TrueArena(Scenes.of(world, ROBOT, 4, 0), 128)
    wanted = [true.recorded()]
    for _ in range(FRAMES * true.scenes.stride - 1):
        true.step(wanted[-1])
        wanted.append(true.recorded())
    actions = np.stack(wanted, axis=1).reshape(4, FRAMES, -1)
    found = episodes(tmp_path / "out")
    assert len(found) == 4
    for number, columns in enumerate(found):
        prompt = true.prompts[number]
        known = len(prompt.frames)
        np.testing.assert_array_equal(columns["action"][known - 1 :], actions[number])
        np.testing.assert_array_equal(columns["action"][: known - 1], prompt.chunks)
        stored = world.tokenizer.encode(prompt.frames)
        np.testing.assert_array_equal(columns["tokens"][:known].reshape(stored.shape), stored)


@pytest.mark.slow
def test_the_plan_names_a_precision_that_changes_tokens(world, monkeypatch, tmp_path) -> None:
    monkeypatch.setattr("hma_model.generation.engine.has_bfloat16", lambda: True)  # slowly, on any processor
    monkeypatch.setattr(world, "precision", "bf16")
    made = augment(tmp_path / "half", asked(episodes=1), world=world)
    assert made.plan["made_by"]["precision"] == "bf16"


@pytest.mark.slow
def test_synthetic_episodes_merge_with_recorded_ones_and_the_whole_says_so(world, tmp_path) -> None:
    recording, robot = record(ROBOT, tmp_path, 2), family.embodiment(ROBOT)
    for frames in ("strided", "all"):
        convert(robot, recording, world.tokenizer, tmp_path / frames, settings=Settings(frames=frames))
    made = augment(tmp_path / "made", asked(episodes=2), world=world)
    whole = merge([tmp_path / "strided", tmp_path / "made"], tmp_path / "whole")
    assert verify(tmp_path / "whole") == [] and robot.state is not None and whole.embodiment.state is None
    assert whole.plan["made_by"]["synthetic"] is True and len(episodes(tmp_path / "whole")) == 4
    flags = ShardSet(tmp_path / "whole").episodes["flags"].to_pylist()
    assert sum("generated_frames" in text for text in flags) == len(episodes(tmp_path / "made")) == 2
    again = merge([tmp_path / "strided", tmp_path / "strided"], tmp_path / "twice")
    assert "synthetic" not in again.plan["made_by"] and again.embodiment.state is not None
    assert made.frame_stride == whole.frame_stride > 1
    with pytest.raises(ShardError, match=r"frame stride is \d+, there it is \d+ .* --frames"):
        merge([tmp_path / "all", tmp_path / "made"], tmp_path / "mixed")


@pytest.mark.slow
def test_perturbed_actions_lie_around_the_recorded_ones(world: World, tmp_path: Path) -> None:
    augment(tmp_path / "one", asked(episodes=2), world=world)
    augment(tmp_path / "other", asked(commands="perturb=0.2", episodes=2), world=world)
    pairs = zip(episodes(tmp_path / "one"), episodes(tmp_path / "other"), strict=True)
    gaps = np.concatenate([(one["action"] - other["action"])[3:] for one, other in pairs])
    assert 0 < np.abs(gaps).mean() < 0.5 * 30
    augment(tmp_path / "still", asked(commands="still", episodes=2), world=world)
    still = episodes(tmp_path / "still")
    assert not any(one["action"].any() for one in still)  # velocities; the recorder's before are left out
    assert {len(one["action"]) for one in still} == {FRAMES}


def test_latents_come_out_the_same_and_other_settings_are_refused(latents, tmp_path) -> None:
    one, other = (augment(tmp_path / name, asked(), world=latents) for name in ("one", "other"))
    assert [shard.sha256 for shard in one.shards] == [shard.sha256 for shard in other.shards]
    with pytest.raises(OutputError, match="holds another shard set"):
        augment(tmp_path / "one", asked(seed=1), world=latents)


def test_the_first_frames_of_latents_are_the_simulators_at_their_own_size(latents, tmp_path) -> None:
    augment(tmp_path / "out", asked(episodes=2), world=latents)
    assert verify(tmp_path / "out") == []
    true, shards = TrueArena(Scenes.of(latents, ROBOT, 2, 0), 64), ShardSet(tmp_path / "out")
    reader = EpisodeReader(shards, shards.columns())
    for row, prompt in zip(shards.episodes.to_pylist(), true.prompts, strict=True):
        stored = reader.episode(row, shards.manifest.cameras[0])["latents"].reshape(-1, 3, 8, 8)
        means = prompt.frames.reshape(-1, 8, 8, 8, 8, 3).astype(np.float32).mean(axis=(2, 4)) / 17
        np.testing.assert_allclose(stored[: len(means)], means.transpose(0, 3, 1, 2), atol=0.06)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["world", "latents"])
@pytest.mark.filterwarnings("ignore:--keep")
def test_the_surest_episodes_are_kept(kind, request, tmp_path, monkeypatch) -> None:
    world, measure = request.getfixturevalue(kind), {"world": "millinats", "latents": "millilatents"}[kind]
    augment(tmp_path / "all", asked(), world=world)
    augment(tmp_path / "half", asked(keep=0.5), world=world)
    unsure = {}
    for name in ("all", "half"):
        rows = ShardSet(tmp_path / name).episodes.to_pylist()
        unsure[name] = sorted(flag_counts(row["flags"])[measure] for row in rows)
    assert unsure["half"] == unsure["all"][:2] and unsure["all"][0] < unsure["all"][-1]
    with pytest.raises(UsageError, match="--keep: is 0"):
        asked(keep=0.0)
    # A map of the stated uncertainty to itself: the limit is between the second and the third.
    meter = Meter(2, 0.5, (0.0, 99.0), (0.0, 99.0), 2.0, 3.0, 0.8, 0.5, 0.1, 0.1, better=True, chooses=True)
    monkeypatch.setattr(World, "meter", lambda self, robot: (meter, ""))
    limit = (unsure["all"][1] + unsure["all"][2]) / 2000
    found = augment(tmp_path / "limited", asked(max_error=limit), world=world)
    assert sum(split["episodes"] for split in found.splits.values()) == 2
    with pytest.raises(HMAError, match="--max-error: leaves no episode: the smallest expected error"):
        augment(tmp_path / "none", asked(max_error=0.0), world=world)
    short = replace(meter, stated=(0.0, 1e-6), error_px=(0.0, 1.0))
    monkeypatch.setattr(World, "meter", lambda self, robot: (short, ""))
    with pytest.raises(HMAError, match="all end more uncertain than the rollouts that were calibrated"):
        augment(tmp_path / "beyond", asked(max_error=99.0), world=world)


def test_a_choice_by_uncertainty_that_nobody_has_calibrated_is_warned_of_or_refused(world, tmp_path) -> None:
    with pytest.warns(UserWarning, match="--keep 0.5: uncertainty is not calibrated: hma benchmark"):
        augment(tmp_path / "out", asked(keep=0.5), world=world)
    with pytest.raises(UsageError, match="--max-error: uncertainty is not calibrated"):
        augment(tmp_path / "other", asked(max_error=2.0), world=world)


@pytest.mark.parametrize(
    "words", ["perturb", "perturb=", "perturb=-1", "replay=0.3", "replay=", "perturb=inf"]
)
def test_noise_without_a_share_is_refused(words: str, world: World, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--commands: .* is unknown . give replay, or perturb=0.3"):
        augment(tmp_path / "out", asked(commands=words), world=world)


@pytest.mark.slow
def test_first_frames_and_actions_come_from_shards(world: World, real: Path, tmp_path: Path) -> None:
    augment(tmp_path / "out", asked(source="real", episodes=2), world=world, shards=real)
    assert verify(tmp_path / "out") == []
    (recorded,), made = episodes(real), ShardSet(tmp_path / "out").episodes.to_pylist()
    assert {row["group"] for row in made} == {"demo_0"}
    stride = world.model.embodiments[ROBOT].stride
    for columns in episodes(tmp_path / "out"):
        tokens, length = recorded["tokens"], len(columns["action"])
        starts = [at for at, frame in enumerate(tokens) if np.array_equal(frame, columns["tokens"][0])]
        rows = [recorded["action"][at : at + length * stride].ravel() for at in starts]
        assert any(np.array_equal(one, columns["action"].ravel()) for one in rows)
    with pytest.raises(UsageError, match="has no episode of 2 \\+ 900 frames"):
        augment(tmp_path / "no", asked(frames=900), world=world, shards=real)


def test_an_episode_is_in_the_split_of_the_recording_with_which_it_begins(world, tmp_path) -> None:
    convert(family.embodiment(ROBOT), record(ROBOT, tmp_path, 2), world.tokenizer, tmp_path / "whole")
    split(tmp_path / "whole", tmp_path / "real", val_fraction=0.5, seed=1)
    augment(tmp_path / "out", asked(source="real", episodes=2), world=world, shards=tmp_path / "real")
    real, made = (ShardSet(tmp_path / name).episodes.to_pylist() for name in ("real", "out"))
    splits = {row["id"]: row["split"] for row in real}
    assert {row["group"]: row["split"] for row in made} == splits and len(set(splits.values())) == 2


@pytest.mark.slow
def test_no_episode_continues_one_that_pauses(world: World, real: Path, tmp_path: Path) -> None:
    stride = world.model.embodiments[ROBOT].stride
    frames, (row,) = episodes(real)[0]["tokens"], ShardSet(real).episodes.to_pylist()
    needed = (KNOWN + FRAMES - 1) * stride
    last = row["length"] - needed - 4
    state_pauses(real, {needed - 1: stride, last: stride})  # the first part is too short
    augment(tmp_path / "out", asked(source="real", episodes=4), world=world, shards=real)
    for columns in episodes(tmp_path / "out"):
        prompt = columns["tokens"][:KNOWN]
        starts = [
            at
            for at in range(len(frames) - stride)
            if np.array_equal(frames[at], prompt[0]) and np.array_equal(frames[at + stride], prompt[1])
        ]
        assert any(needed <= at <= last - needed or last < at for at in starts)
    state_pauses(real, dict.fromkeys(range(0, row["length"], needed), stride))
    with pytest.raises(UsageError, match="has no episode of 2 \\+ 4 frames without a pause"):
        augment(tmp_path / "no", asked(source="real"), world=world, shards=real)


@pytest.fixture
def real(world: World, tmp_path: Path) -> Path:
    recording = record(ROBOT, tmp_path, 1)
    settings = Settings(val_fraction=0)
    convert(family.embodiment(ROBOT), recording, world.tokenizer, tmp_path / "real", settings=settings)
    return tmp_path / "real"


@pytest.mark.slow
def test_episodes_of_the_same_beginning_differ(world, real, tmp_path, monkeypatch) -> None:
    long_enough = augment_module._Maker._long_enough

    def one_beginning(maker: Any, shards: ShardSet) -> list[tuple[dict[str, Any], range]]:
        span = (maker.prompt_frames + maker.settings.frames - 1) * shards.row_stride
        return [(row, part[: span + 1]) for row, part in long_enough(maker, shards)]

    monkeypatch.setattr(augment_module._Maker, "_long_enough", one_beginning)
    augment(tmp_path / "out", asked(source="real", episodes=2), world=world, shards=real)
    made = [columns["tokens"].tobytes() for columns in episodes(tmp_path / "out")]
    assert len(set(made)) == len(made) == 2


@pytest.mark.slow
def test_windows_with_unknown_actions_are_left_out(world, real, tmp_path, monkeypatch) -> None:
    read, unknown = SeenShards.window, [True]

    def gaps(*given: Any) -> Prompt:
        frames, chunks = read(*given)
        chunks = chunks.copy()
        chunks[2, 0] = np.nan if all(unknown) or given[-1][0] % 2 else chunks[2, 0]
        return Prompt(frames, chunks)

    monkeypatch.setattr(SeenShards, "window", gaps)
    with pytest.raises(UsageError, match="has too few windows of 6 frames whose actions are all known"):
        augment(tmp_path / "none", asked(source="real"), world=world, shards=real)
    unknown.append(False)
    augment(tmp_path / "out", asked(source="real"), world=world, shards=real)
    assert verify(tmp_path / "out") == []
    assert all(np.isfinite(columns["action"]).all() for columns in episodes(tmp_path / "out"))
    augment(tmp_path / "still", asked(source="real", commands="still"), world=world, shards=real)


@pytest.mark.slow
def test_a_policy_of_images_acts_after_stored_frames(world: World, real: Path, tmp_path: Path) -> None:
    seen = []

    class Looks:
        def begin(self, arena: Any) -> None:
            seen.extend(prompt.frames for prompt in arena.prompts)

        def act(self, arena: Any) -> Any:
            return arena.held

    maker = augment_module._Maker(world, asked(source="real", commands="still", episodes=2), ShardSet(real))
    maker.policy = Looks()
    maker._make(range(2), lambda done: None)
    stored = maker._recorded(ShardSet(real), range(2)).prompts
    for images, prompt in zip(seen, stored, strict=True):
        assert images.dtype == np.uint8 and np.array_equal(images, world.tokenizer.decode(prompt.frames))


@pytest.mark.slow
def test_other_shards_of_the_same_name_are_not_the_same_job(world: World, real: Path, tmp_path: Path) -> None:
    settings = asked(source="real", episodes=1)
    augment(tmp_path / "out", settings, world=world, shards=real)
    augment(tmp_path / "out", settings, world=world, shards=real)
    recording = record(ROBOT, tmp_path / "again", 2)
    convert(family.embodiment(ROBOT), recording, world.tokenizer, tmp_path / "other" / "real")
    with pytest.raises(OutputError, match="holds another shard set"):
        augment(tmp_path / "out", settings, world=world, shards=tmp_path / "other" / "real")


@pytest.mark.slow
def test_a_policy_that_was_edited_does_not_continue_a_job(world, tmp_path, monkeypatch) -> None:
    def run(value: int, batches: Any = BATCHES) -> None:
        sys.modules.pop("moves", None)
        (tmp_path / "moves.py").write_text(f"act = lambda image: [{value}, 0]")
        monkeypatch.setattr(augment_module, "_chosen", batches)
        augment(tmp_path / "out", asked(commands="moves:act", episodes=1), world=world)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    with pytest.raises(TypeError):
        run(1, None)  # stopped when all episodes are made
    with pytest.raises(OutputError, match="was started with other settings"):
        run(2)
    run(1)
    sys.modules.pop("moves")


@pytest.mark.slow
def test_episodes_of_several_cameras_hold_each_in_its_place(tmp_path, monkeypatch) -> None:
    recording, tokenizer = three.write_hdf5(tmp_path / "three.hdf5"), BlockTokenizer()
    taken = Settings(cameras=("all",))
    convert(three.arm(), recording, tokenizer, tmp_path / "real", settings=taken)
    real = ShardSet(tmp_path / "real")
    world = World(trained_on(["side", "top"], real, tmp_path / "model", frames=4).model, tokenizer)
    settings = Augmentation(real.embodiment.id, "real", episodes=2, frames=2, keep=1.0)
    given: Any = {"world": world, "shards": real.folder, "lerobot": tmp_path / "dataset"}
    augment(tmp_path / "out", settings, **given)
    for wrong in ({"settings": replace(settings, judge="moved")}, {"shards": None}):
        with pytest.raises(UsageError, match="simulator shows one camera, and the model sees 2"):
            augment(tmp_path / "no", **({"settings": settings} | given | {"lerobot": None} | wrong))
    one = World(trained_on("top", real, tmp_path / "one", "policy", 4).model, tokenizer)
    monkeypatch.setattr(augment_module, "read_policy", lambda _, scenes, world: Acting(one, scenes, 1, "it"))
    with pytest.raises(HMAError, match="it: sees 1 views, and the images show 2"):
        augment(tmp_path / "no", replace(settings, commands="hma:it"), **(given | {"lerobot": None}))
    made = ShardSet(tmp_path / "out")
    assert made.manifest.cameras == ["side", "top"] and verify(made.folder) == []
    reader = EpisodeReader(made, made.columns(made.manifest.cameras))
    for row in made.episodes.to_pylist():
        for name, red in (("side", 9), ("top", 1)):
            first = reader.episode(row, name)["tokens"][0]
            assert (first % 16 == red).all()
    robot = Embodiment.load(tmp_path / "dataset" / "embodiment.yaml")
    source, place = open_source("lerobot"), tmp_path / "dataset"
    episode = source.read(place, source.episode_ids(place)[0], robot)
    for name, red in (("side", 9), ("top", 1)):
        assert abs(float(episode.streams[name].frames([0])[..., 0].mean()) - 17 * red) < 6
    back = convert(robot, place, tokenizer, tmp_path / "back", settings=Settings(frames="strided"))
    assert back.manifest.plan["made_by"] == made.manifest.plan["made_by"]
    assert back.manifest.plan["made_by"]["synthetic"] is True and verify(tmp_path / "back") == []
    own = replace(taken, frames="strided")
    convert(three.arm(), recording, tokenizer, tmp_path / "strided", settings=own)
    assert "made_by" not in ShardSet(tmp_path / "strided").manifest.plan


def test_the_camera_that_is_shown_is_the_one_that_is_named(tmp_path: Path) -> None:
    arm, tokenizer = three.arm(), BlockTokenizer()
    images = np.zeros((4, 64, 64, 3), np.uint8)
    made = SyntheticEpisode(
        "one", tokenizer.encode(images), np.zeros((3, arm.chunk_dim), np.float32), {}, "a"
    )
    given: Any = {"made_by": {"synthetic": True}, "cameras": ["wrist"]}
    (tmp_path / "out").mkdir()
    manifest = write_shards(tmp_path / "out", [made], tokenizer.spec, arm, **given)
    assert manifest.cameras == ["wrist"] and verify(tmp_path / "out") == []


@pytest.mark.slow
def test_lerobot_loads_the_dataset(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    monkeypatch.setattr(augment_module, "_stated", lambda *_: None)
    told: list[tuple[float, str]] = []

    def tell(done: float, words: str) -> None:
        told.append((done, words))

    given: Any = {"world": world, "lerobot": tmp_path / "rails", "on_progress": tell}
    augment(tmp_path / "out", asked(episodes=2), **given)
    loaded = LeRobotDataset("lab/rails", root=tmp_path / "rails")
    stride = world.model.embodiments[ROBOT].stride
    columns = episodes(tmp_path / "out")
    assert "observation.state" not in loaded.meta.features
    assert loaded.num_episodes == 2 and len(loaded) == sum(len(one["action"]) for one in columns) * stride
    written = [words for done, words in told if words.startswith("LeRobot") and done == 2 * FRAMES]
    assert written[0].startswith(f"LeRobot: 0 of {len(loaded)} frames, ")
    assert written[-1].startswith(f"LeRobot: {len(loaded)} of {len(loaded)} frames, ")
    first, second = (world.tokenizer.decode(columns[0]["tokens"][at].reshape(1, 8, 8))[0] for at in (0, 1))
    for at, shown in ((0, first), (stride - 1, first), (stride, second)):
        stored = loaded[at]["observation.images.top"].permute(1, 2, 0).numpy() * 255
        assert np.abs(stored - shown).mean() < 4 < np.abs(first.astype(float) - second).mean()
    row = loaded[stride]
    np.testing.assert_allclose(row["action"], columns[0]["action"][1][: len(row["action"])])
    assert "synthetic" in row["task"]
    assert json.loads((tmp_path / "rails/synthetic.json").read_text())["synthetic"] is True
    with pytest.raises(OutputError, match="rails: holds another dataset"):
        augment(tmp_path / "more", asked(), world=world, lerobot=tmp_path / "rails")
    assert not list((tmp_path / "more").glob("*/*.parquet"))


@pytest.mark.slow
def test_a_policy_of_lerobot_trains_on_the_dataset_with_the_state_in_its_images(tmp_path, monkeypatch):
    import torch
    from lerobot.configs.types import FeatureType
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot.utils.feature_utils import dataset_to_policy_features

    monkeypatch.setattr(probe, "EPISODES", 16)
    world = load_world("embedded")
    augment(tmp_path / "out", asked(), world=world, lerobot=tmp_path / "rails")
    robot = Embodiment.load(tmp_path / "rails" / "embodiment.yaml")
    said = robot.provenance["state"]
    assert "estimated from the images, mean error slider_1 " in said and robot.state is not None
    step = {"action": [row / robot.rate_hz for row in range(4)]}
    loaded = LeRobotDataset("lab/rails", root=tmp_path / "rails", delta_timestamps=step)
    assert loaded.meta.features["observation.state"]["names"] == robot.state.names()
    true = TrueArena(Scenes.of(world, ROBOT, 4, 0), 128)
    known, stride = len(true.prompts[0].frames), robot.stride
    begins = loaded.meta.episodes["dataset_from_index"]
    read = np.stack([loaded[begin + (known - 1) * stride]["observation.state"] for begin in begins])
    seen = true.observed()
    assert seen is not None and np.abs(read - seen).mean() < 0.2 * np.abs(seen - seen[::-1]).mean()
    features = dataset_to_policy_features(loaded.meta.features)
    outputs = {key: one for key, one in features.items() if one.type is FeatureType.ACTION}
    config = ACTConfig(
        input_features={key: one for key, one in features.items() if key not in outputs},
        output_features=outputs, chunk_size=4, n_action_steps=4, dim_model=32, n_heads=2, dim_feedforward=32,
        n_encoder_layers=1, n_vae_encoder_layers=1, pretrained_backbone_weights=None, device="cpu",
    )  # fmt: skip
    policy = ACTPolicy(config).train()
    prepare, _ = make_pre_post_processors(config, dataset_stats=loaded.meta.stats)
    batch = prepare(next(iter(torch.utils.data.DataLoader(loaded, batch_size=4))))
    optimizer, losses = torch.optim.AdamW(policy.parameters(), lr=1e-3), []
    for _ in range(6):
        loss, _ = policy(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0]


@pytest.fixture
def one_sided(block_tokenizer: BlockTokenizer, tmp_path: Path) -> tuple[World, ShardSet]:
    """A world and shards of a robot without simulator, one of whose rates was never negative in training."""
    arm = Embodiment.from_values(three.arm().to_dict() | {"id": "a_strangers_arm"}, "a stranger's arm")
    convert(arm, three.write_hdf5(tmp_path / "three.hdf5"), block_tokenizer, tmp_path / "real")
    shards = ShardSet(tmp_path / "real")
    world = World(trained_on("first", shards, tmp_path / "model", frames=4).model, block_tokenizer)
    seen = np.array([[0, -0.5], [1, 0.5]], np.float32)
    world._specs[arm.id] = replace(world.action_spec(arm.id), seen=seen)
    return world, shards


@pytest.mark.parametrize("commands", ["random", "perturb=3"])
def test_actions_stay_in_the_range_seen_in_training(commands, one_sided, tmp_path) -> None:
    world, shards = one_sided
    settings = Augmentation("a_strangers_arm", "real", episodes=4, frames=2, keep=1.0, commands=commands)
    augment(tmp_path / "out", settings, world=world, shards=shards.folder)
    made = ShardSet(tmp_path / "out")
    reader = EpisodeReader(made, made.columns())
    rows = [reader.episode(row, made.manifest.cameras[0])["action"] for row in made.episodes.to_pylist()]
    own = np.concatenate([row[-1:] for row in rows]).reshape(-1, 2)
    assert (own >= [0, -0.5]).all() and (own <= [1, 0.5]).all() and np.ptp(own[:, 0]) > 0.2


def test_no_recording_is_called_scripted(one_sided: tuple[World, ShardSet], tmp_path: Path) -> None:
    world, shards = one_sided
    for commands in ("scripted", "scripted:noise=0.5"):
        settings = Augmentation("a_strangers_arm", "real", commands=commands, frames=2)
        with pytest.raises(UsageError, match=f"'{commands}' needs a policy .* a_strangers_arm has none"):
            augment(tmp_path / "out", settings, world=world, shards=shards.folder)


def test_a_policy_that_plans_gets_the_judge(world, tmp_path, monkeypatch) -> None:
    class Planner(Planning):
        begin, act = Still.begin, Still.act  # type: ignore[assignment]

        def __init__(self) -> None:
            self.cost: Any = SimpleNamespace()

    class Judge:
        def score(self, images: np.ndarray) -> np.ndarray:
            return images[:, 0, 0, 0, 0]

        def success(self, scores: np.ndarray) -> np.ndarray:
            return np.ones(len(scores), np.bool_)

    policy, judge = Planner(), Judge()
    monkeypatch.setattr(augment_module, "read_policy", lambda *given: policy)
    monkeypatch.setattr(augment_module, "train_probe", lambda *given: None)
    monkeypatch.setattr(augment_module, "train_judge", lambda *given, **named: judge)
    with pytest.raises(UsageError, match="'plan:cem' plans for what a judge calls success . add --judge"):
        augment(tmp_path / "out", asked(commands="plan:cem"), world=world)
    augment(tmp_path / "out", asked(commands="plan:cem", judge="moved", episodes=2), world=world)
    assert policy.cost.judge is judge and verify(tmp_path / "out") == []
