"""Finetuning: what is new, what goes on, and what stays byte for byte."""

import json
import shutil
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hma_data.errors import CheckpointError, HubError, RecipeError, UsageError
from hma_data.shards.reader import ShardSet
from hma_data.tokenizers.base import TokenizerSpec
from hma_model.checkpoint import io as checkpoint
from hma_model.checkpoint.folder import action_stats
from hma_model.checkpoint.io import Checkpoint
from hma_model.config import ActionSpace
from hma_model.evaluation.losses import validation_losses, windows
from hma_model.hub import publish as hub
from hma_model.network.stem import Stem
from hma_model.training import new_stem
from hma_model.training.loop import TrainResult, finetune, train
from hma_model.training.recipe import make_recipe
from hma_model.training.run import Run
from tests.conftest import contents as files
from tests.hostile import flip
from tests.hub_state import REPO, ROBOTS
from tests.model.processes import run_command
from tests.model.robots import CONFIG, SPEC, make_model, save
from tests.model.runs import TINY, kill_at, same, weights
from tests.model.shards import make_shards

SHORT = [
    "steps=4", "batch_size=4", "device=cpu", "warmup=1", "eval_every=0", "eval_windows=4",
    "checkpoint_every=2", "report=false", "pictures=0", "track=[]", "lr=3e-3",
]  # fmt: skip


@pytest.fixture
def base(tiny_run: TrainResult) -> TrainResult:
    return tiny_run


@pytest.fixture
def leg(tmp_path) -> Path:
    return make_shards(tmp_path / "leg", "leg", dims=4, seed=2)


def tune(base, leg, out, *changes, freeze=True, **options) -> TrainResult:
    overrides = [*SHORT, *changes]
    return finetune(base, [leg], out=out, freeze_trunk=freeze, overrides=overrides, show=False, **options)


@pytest.fixture(scope="module", params=[True, False], ids=["frozen", "tuned"])
def tuned(tiny_run, request, tmp_path_factory) -> tuple[bool, TrainResult]:
    folder = tmp_path_factory.mktemp("tuned")
    leg, before = make_shards(folder / "leg", "leg", dims=4, seed=2), files(tiny_run.out)
    result = tune(tiny_run.out, leg, folder / "run", freeze=request.param)
    assert files(tiny_run.out) == before
    return request.param, result


def test_a_frozen_trunk_and_the_other_robots_stay_and_a_tuned_one_leaves_them_behind(base, tuned):
    frozen, result = tuned
    opened, source = Checkpoint.open(result.checkpoint), Checkpoint.open(base.checkpoint)
    assert opened.embodiments == (("arm", "hand", "leg") if frozen else ("leg",))
    assert (opened.trunk_sha256 == source.trunk_sha256) == frozen
    before, after = files(base.checkpoint), files(result.checkpoint)
    kept = [name for name in before if name.startswith(("embodiments/", "trunk", "config"))]
    assert len(kept) == 12 and all(before[name] == after.get(name) for name in kept) == frozen
    checkpoint.load(result.checkpoint)


def test_the_new_stem_learns_while_the_trunk_is_frozen(base, leg, tmp_path):
    one, four = (tune(base.out, leg, tmp_path / str(n), f"steps={n}") for n in (1, 4))
    a, b = weights(one.checkpoint), weights(four.checkpoint)
    changed = {name.split(":")[0] for name in a if not torch.equal(a[name], b[name])}
    assert changed == {"embodiments/leg/stem.safetensors", "training/optimizer.safetensors"}
    assert not any(name.startswith("training") and "trunk" in name for name in a)


def test_the_new_robots_statistics_and_card_are_there_and_the_network_is_the_checkpoints(tuned):
    frozen, result = tuned
    opened = Checkpoint.open(result.checkpoint)
    assert opened.embodiment("leg").action_dim == 4
    assert len(opened.stats("leg")["action"]["mean"]) == 4
    card, source = opened.card("leg"), opened.card("leg")["training"]
    assert (source["from_trunk_sha256"] == opened.trunk_sha256) == frozen and card["metrics"]["val_loss"] > 0
    assert source["trunk"] == ("frozen" if frozen else "tuned")
    config = opened.config
    assert (config.width, config.mup, config.frames) == (16, True, TINY["frames"])


@pytest.mark.parametrize(
    ("key", "value"),
    [("told_noise", True), ("digit_order", "chain"), ("copy_previous", True)],
)
def test_what_begins_at_nothing_can_be_turned_on_for_a_tuned_trunk(base, tmp_path, key, value):
    arm, still = make_shards(tmp_path / "arm", "arm"), ["steps=1", "lr=1e-12", "model.corrupt_max=0.2"]
    more = [*still, f"model.{key}={value}"]
    a, b = (tune(base.out, arm, tmp_path / str(len(given)), *given, freeze=False) for given in (still, more))
    assert b.losses == a.losses
    again = tune(b.out, arm, tmp_path / "again", *still, freeze=False)
    for result in (b, again):
        assert getattr(Checkpoint.open(result.checkpoint).config, key) == value
    if key == "copy_previous":  # recipes turn it on, and a frozen trunk stays as it is
        kept = tune(base.out, arm, tmp_path / "frozen", *more)
        assert not Checkpoint.open(kept.checkpoint).config.copy_previous
        return
    with pytest.raises(RecipeError, match=f"model.{key}: is {value!r}, the checkpoint .* has "):
        tune(base.out, arm, tmp_path / "frozen", *more)


@pytest.mark.parametrize("copies", [False, True])
def test_latents_are_copied_only_if_the_trunk_was_trained_so(tmp_path, copies):
    spec = TokenizerSpec("raw", 1, "continuous", 16, (4, 4), channels=2, dtype="float16")
    arm, leg = (make_shards(tmp_path / name, name, spec=spec) for name in ("arm", "leg"))
    small = {"patch": 2, "diffusion_width": 16, "diffusion_depth": 1, "copy_previous": copies}
    recipe = make_recipe({**TINY, "data": [str(arm)], "model": {**TINY["model"], **small}})
    trained = train(recipe, out=tmp_path / "base", show=False)
    result = tune(trained.out, leg, tmp_path / "run", "model.copy_previous=true", freeze=False)
    assert Checkpoint.open(result.checkpoint).config.copy_previous == copies


def test_waves_of_the_commands_belong_to_a_stem(base, leg, tmp_path):
    arm, still = make_shards(tmp_path / "arm", "arm"), ["steps=1", "lr=1e-12"]
    more = [*still, "model.action_waves=3"]
    a, b = (tune(base.out, arm, tmp_path / str(len(given)), *given) for given in (still, more))
    assert b.losses == a.losses  # they begin at zero
    home = tmp_path / "hub" / "team" / "model"
    hub.push(base.checkpoint, home)
    hub.push(tune(home, leg, tmp_path / "run", "model.action_waves=3", "steps=4").checkpoint, home, ["leg"])
    hub.push(tune(home, leg, tmp_path / "next", "steps=1").checkpoint, home, ["leg"])  # it keeps its waves
    pulled = hub.from_pretrained(home)
    waves = {name: pulled.stem(name).waves for name in pulled.embodiments}
    assert waves["arm"] is waves["hand"] is None and waves["leg"] is not None
    assert waves["leg"].weight.abs().max() > 0 and pulled.config.action_waves == 0


def test_a_known_robot_goes_on_with_its_stem_and_statistics(base, tmp_path):
    shards = make_shards(tmp_path / "arm", "arm", seed=9)
    result = tune(base.out, shards, tmp_path / "run", "steps=1", "lr=1e-12")
    a, b = (weights(r.checkpoint) for r in (base, result))
    for name in (n for n in a if n.startswith("embodiments/arm")):
        assert torch.allclose(a[name].float(), b[name].float(), atol=1e-9), name


CODED = TokenizerSpec(**{**SPEC.to_json(), "name": "coded", "weights_sha256": "ab" * 32})


@pytest.mark.parametrize(
    ("name", "shards", "changes", "fault", "said"),
    [
        ("arm", {"dims": 5}, (), CheckpointError, "has arm with action_dim 2, the shards have 5"),
        (
            "arm",
            {"space": "joint_velocity"},
            (),
            CheckpointError,
            r"action\.space joint_position, the shards",
        ),
        ("leg", {"spec": CODED}, (), CheckpointError, "tokenizer 'raw', the data is of 'coded'"),
        ("leg", {}, ("model.width=32",), RecipeError, r"model\.width.*is 32, .* has 16"),
        ("leg", {}, ("digits=64",), RecipeError, r"gives digits of \(64,\), the checkpoint has \(8, 8\)"),
        ("leg", {}, ("model.layers=3",), RecipeError, r"model\.layers"),
        ("leg", {}, ("mixture.weights.lag=2",), RecipeError, r"mixture\.weights"),
        ("leg", {}, ("batch_size=900",), RecipeError, "900 windows per step"),
    ],
)
def test_what_does_not_fit_the_checkpoint_is_refused_and_leaves_no_folder(
    base, tmp_path, name, shards, changes, fault, said
):
    with pytest.raises(fault, match=said):
        tune(base.out, make_shards(tmp_path / name, name, **shards), tmp_path / "new/run", *changes)
    assert not (tmp_path / "new").exists()


def test_a_killed_finetuning_goes_on_bit_for_bit_though_its_source_is_gone(base, leg, tmp_path):
    whole = tune(base.out, leg, tmp_path / "whole", freeze=False)
    source = tmp_path / "hub"
    hub.push(base.checkpoint, source)
    with pytest.raises(KeyboardInterrupt):
        tune(source, leg, tmp_path / "cut", freeze=False, on_progress=kill_at(3))
    kept = source.rename(tmp_path / "elsewhere")
    again = tune(source, leg, tmp_path / "cut", freeze=False)
    assert again.losses == whole.losses and same(whole.checkpoint, again.checkpoint)
    assert kept.is_dir()


def test_what_is_missing_is_said(base, leg, tmp_path):
    with pytest.raises((CheckpointError, HubError), match="nowhere"):
        tune(tmp_path / "nowhere", leg, tmp_path / "run")
    with pytest.raises(UsageError, match="--data"):
        finetune(base.out, [], out=tmp_path / "run")
    with pytest.raises(RecipeError, match="untrained trunk"):
        train(make_recipe({**TINY, "data": [str(leg)], "freeze": "trunk"}), out=tmp_path / "r", show=False)


def test_heads_learn_on_a_frozen_trunk_when_actions_are_the_objective(base, leg, tmp_path):
    objective = "objectives={policy: 1}"
    one, four = (tune(base.out, leg, tmp_path / str(n), objective, f"steps={n}") for n in (1, 4))
    a, b = weights(one.checkpoint), weights(four.checkpoint)
    name = "embodiments/leg/head.safetensors:policy.weight"
    assert not torch.equal(a[name], b[name])


def test_another_source_is_no_way_to_go_on_and_the_same_one_elsewhere_is(base, leg, tmp_path):
    tune(base.out, leg, tmp_path / "run")
    moved = shutil.copytree(base.checkpoint, tmp_path / "moved")
    assert tune(moved, leg, tmp_path / "run").step == 4
    other = tune(base.out, leg, tmp_path / "other", freeze=False)
    with pytest.raises(RecipeError, match=f"was started from .*moved, not from {other.out}"):
        tune(other.out, leg, tmp_path / "run", force=True)


def test_a_run_stopped_before_its_first_checkpoint_begins_from_the_source_now_named(
    base, leg, tmp_path, monkeypatch
):
    other = tune(base.out, leg, tmp_path / "other", freeze=False)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Run, "resume", Mock(side_effect=KeyboardInterrupt))
        tune(base.out, leg, tmp_path / "run")
    tune(other.out, leg, tmp_path / "run")
    assert Checkpoint.open(tmp_path / "run").trunk_sha256 == Checkpoint.open(other.out).trunk_sha256


def test_a_damaged_source_is_named_and_leaves_no_folder(base, leg, tmp_path):
    damaged = shutil.copytree(base.checkpoint, tmp_path / "damaged")
    trunk = damaged / "trunk.safetensors"
    trunk.write_bytes(trunk.read_bytes()[:-5])
    with pytest.raises(CheckpointError, match=rf"{trunk}: is another trunk"):
        tune(damaged, leg, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_path_that_looks_like_a_repository_is_told_to_be_neither(leg, tmp_path, monkeypatch):
    def away(source, revision):
        raise HubError(f"hf://{source}", "is out of reach, and not in the cache", "go online and pull again")

    monkeypatch.setattr(hub, "open_store", away)
    with pytest.raises(HubError, match=r"^runs/base: is not a local folder; as a repository .* path of"):
        tune("runs/base", leg, tmp_path / "run")


# -- the stem of its like


BARELY = ["steps=1", "lr=1e-12", "warmup=1", "eval_every=0", "report=false", "pictures=0", "device=cpu"]


@pytest.fixture(scope="module")
def like_run(tmp_path_factory) -> TrainResult:
    """A run on two robots of two dims, and one of three."""
    folder = tmp_path_factory.mktemp("like_run")
    robots = [("arm", 2, 0), ("cart", 2, 7), ("hand", 3, 1)]
    data = [str(make_shards(folder / name, name, dims=dims, seed=seed)) for name, dims, seed in robots]
    return train(make_recipe({**TINY, "data": data, "steps": 30, "lr": 1e-2}), out=folder / "run", show=False)


@pytest.fixture
def twin(tmp_path) -> Path:
    return make_shards(tmp_path / "twin", "twin", seed=0)


def started(like_run, data, out, *changes, freeze=True) -> TrainResult:
    return finetune(like_run, [data], out=out, freeze_trunk=freeze, overrides=[*BARELY, *changes], show=False)


@given(st.integers(1, 6), st.integers(1, 6), st.integers(0, 3), st.integers(0, 3))
def test_a_command_that_is_held_means_the_same_at_every_stride(steps, own_steps, waves, own_waves):
    torch.manual_seed(0)
    spaces = [ActionSpace("a", 2, n, (1.0, 2.0), (3.0, 4.0), (True, False)) for n in (steps, own_steps)]
    theirs, own = (Stem(CONFIG, space, n) for space, n in zip(spaces, (waves, own_waves)))
    if theirs.waves is not None:
        kept = theirs.waves.weight.detach().view(-1, 2 * steps, 2, waves)
        torch.nn.init.normal_(kept[..., : min(waves, own_waves)])
    fitted = new_stem._fitted(theirs.state_dict(), own.state_dict(), steps, own_steps)
    own.load_state_dict(fitted)
    held = torch.randn(3, 4, 2)
    a, b = (stem(held.repeat(1, 1, n)) for stem, n in ((theirs, steps), (own, own_steps)))
    assert torch.allclose(a, b, atol=1e-5)


def test_the_stem_with_the_lowest_loss_is_taken(like_run, twin, tmp_path):
    opened, shards = Checkpoint.open(like_run.checkpoint), ShardSet(twin)
    model = checkpoint.load(like_run.checkpoint)
    model.add_embodiment(shards.embodiment, action_stats(shards.manifest.stats, "twin"))
    before = {name: value.clone() for name, value in model.state_dict().items()}
    chosen = new_stem.choose(model, "twin", opened, shards, "first", "forward")
    assert all(torch.equal(before[name], value) for name, value in model.state_dict().items())
    given: dict = {"batch_size": new_stem.WINDOWS}

    def loss() -> float:
        found = windows(shards, "train", new_stem.FRAMES, new_stem.WINDOWS, **given)
        return validation_losses(model, found)[0].mean()

    losses = {"": loss()}
    for name in ("arm", "cart"):
        new_stem.copy_stem(model, "twin", opened, name)
        losses[name] = loss()
    assert chosen is not None and chosen.fresh_loss == losses[""]
    assert (chosen.loss, chosen.like) == min((value, name) for name, value in losses.items())


def test_a_new_robot_begins_with_it_and_the_card_says_so(like_run, twin, tmp_path):
    home = tmp_path / "hub" / "team" / "model"
    hub.push(like_run.checkpoint, home)
    like, fresh = (started(home, twin, tmp_path / way, f"new_stem={way}") for way in ("like", "fresh"))
    cards = [Checkpoint.open(run.checkpoint).card("twin")["training"] for run in (like, fresh)]
    source = cards[0]["stem_from"]
    assert source in ("arm", "cart") and "stem_from" not in cards[1]
    found = weights(like.checkpoint)
    for name in ("input.weight", "output.weight", "norm.weight"):
        parts = (found[f"embodiments/{one}/stem.safetensors:{name}"] for one in ("twin", source))
        assert torch.allclose(*parts, atol=1e-6), name
    again = started(home, twin, tmp_path / "like", "new_stem=like", "steps=1")
    assert Checkpoint.open(again.checkpoint).card("twin")["training"]["stem_from"] == source


def test_a_damaged_like_robot_is_named_with_the_way_without_it(like_run, twin, tmp_path):
    damaged = shutil.copytree(like_run.checkpoint, tmp_path / "damaged one")
    stem = damaged / "embodiments/arm/stem.safetensors"
    flip(-9)(stem)
    with pytest.raises(CheckpointError, match=r"embodiments/arm/stem\.safetensors: .*new_stem=fresh"):
        started(damaged, twin, tmp_path / "run", freeze=False)
    assert started(damaged, twin, tmp_path / "run", "new_stem=fresh", freeze=False).step == 1


def test_a_new_stem_has_the_waves_of_its_like(like_run, twin, tmp_path):
    arm = make_shards(tmp_path / "arm", "arm")
    waved = started(like_run.out, arm, tmp_path / "waved", "model.action_waves=3", "steps=2", "lr=1e-2")
    like, fresh = (started(waved.out, twin, tmp_path / way, f"new_stem={way}") for way in ("like", "fresh"))
    key = "embodiments/twin/stem.safetensors:waves.weight"
    assert weights(like.checkpoint)[key].shape[1] == 2 * 3 * 4 and key not in weights(fresh.checkpoint)


def test_only_robots_with_as_many_dims_are_tried_the_nearest_rate_first():
    cards: dict = {
        "slow": {"action_dim": 2, "effective_hz": 1.0}, "near": {"action_dim": 2, "effective_hz": 9.0},
        "wide": {"action_dim": 3, "effective_hz": 10.0}, "none": {},
        "odd": {"action_dim": 2, "effective_hz": "x"},
    }  # fmt: skip

    class Robot:
        action_dim, effective_hz = 2, 10.0

    assert new_stem.candidates(cards, Robot()) == ["near", "slow", "odd"]  # type: ignore[arg-type]


# -- a trunk on a hub


pytest_plugins = ["tests.hub_fixtures"]


PARTS = {"stem.safetensors", "head.safetensors", "embodiment.yaml", "stats.json", "card.json"}
ARM, CARDS = {f"embodiments/arm/{part}" for part in PARTS}, {f"embodiments/{n}/card.json" for n in ROBOTS}


@pytest.mark.parametrize(
    ("name", "dims", "freeze", "parts"),
    [
        ("leg", 4, True, CARDS),
        ("leg", 4, False, CARDS),
        ("twin", 2, False, CARDS | ARM),  # may be like it
        ("arm", 2, True, ARM),  # is known
    ],
)
def test_the_trunk_is_fetched_with_what_concerns_the_robot(published, tmp_path, name, dims, freeze, parts):
    result = tune(
        REPO, make_shards(tmp_path / name, name, dims=dims, seed=5), tmp_path / "run", freeze=freeze
    )
    served = set(published.served())
    assert {"config.json", "trunk.safetensors"} <= served
    assert {one for one in served if one.startswith("embodiments/")} == parts
    assert name in Checkpoint.open(result.checkpoint).embodiments


@pytest.mark.parametrize("form", ["{}@{}", "hf://{}@{}"])
def test_a_revision_is_the_one_that_is_fetched(published, leg, tmp_path, form):
    first = published.model(REPO).commits[-1].id
    save(tmp_path / "other", {"arm": 2}, model=make_model({"arm": 2}, seed=5))
    other = checkpoint.Checkpoint.open(tmp_path / "other")
    published.model(REPO).commit(dict.fromkeys(published.model(REPO).files), "empty it")
    hub.push(tmp_path / "other", REPO)
    old = tune(form.format(REPO, first), leg, tmp_path / "run0")
    new = tune(REPO, leg, tmp_path / "run1")
    trunks = [Checkpoint.open(result.checkpoint).trunk_sha256 for result in (old, new)]
    assert trunks[1] == other.trunk_sha256 != trunks[0]
    with pytest.raises(RecipeError, match=f"was started from {REPO}, not from .*{REPO}@{first}"):
        tune(form.format(REPO, first), leg, tmp_path / "run1")


def test_a_revision_that_is_not_there_is_said_and_leaves_no_folder(published, leg, tmp_path):
    with pytest.raises(HubError, match=rf"^{REPO}@.*: has no such revision"):
        tune(f"{REPO}@none", leg, tmp_path / "new/run")
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_the_command_finetunes_from_a_repository_and_the_run_goes_on_without_it(published, leg, tmp_path):
    cache = {"HF_ENDPOINT": published.url, "HF_HUB_CACHE": str(tmp_path / "c"), "HF_HUB_DISABLE_XET": "1"}
    data, out = [str(leg), str(make_shards(tmp_path / "foot", "foot", dims=1, seed=5))], tmp_path / "run"
    words = ["finetune", "--from", REPO, "--data", *data, "--freeze-trunk", "--out", str(out), "--json"]
    done = run_command(tmp_path, *words, *SHORT, env=cache)
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["step"] == 4 and "trunk frozen" in done.stderr and "new stem and head: " in done.stderr
    assert Checkpoint.open(facts["checkpoint"]).embodiments == ("foot", "leg")
    asked = len(published.log)
    again = finetune(REPO, data, out=out, freeze_trunk=True, overrides=SHORT, show=False)
    assert again.step == 4 and len(published.log) == asked
