"""Evaluation: losses by their definition, the baseline by hand, and rollouts of models that are known."""

import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats
import torch

from hma_data.errors import UsageError
from hma_data.loading.dataset import Batch, WindowDataset
from hma_data.shards.reader import ShardSet
from hma_model.evaluation import actions, losses, tables
from hma_model.evaluation.actions import gaussian, shuffled, without_actions
from hma_model.evaluation.evaluate import EvaluationSettings, measure
from hma_model.evaluation.intervals import ANY, interval, over_datasets
from hma_model.evaluation.losses import (
    digit_frequencies,
    unconditional_baseline,
    validation_losses,
    windows,
)
from hma_model.evaluation.metrics import masked_scores, teacher_forced
from hma_model.evaluation.rollouts import rollout
from hma_model.evaluation.suite import Part
from hma_model.evaluation.tables import FIGURES, means
from hma_model.evaluation.verdict import follows, verdict
from hma_model.network.model import HMA
from hma_model.network.stem import merge_tokens, to_digits
from tests.model.network.test_copying import CHANGES
from tests.model.network.test_copying import _model as copying
from tests.model.network_parts import seeded, small_batch, small_model
from tests.model.robots import CONFIG, Blocks, make_model
from tests.model.shards import make_shards, state


def evaluate(model: HMA, tokenizer: Any, data: Any, **settings: Any) -> dict[str, Any]:
    return measure(model, tokenizer, data, EvaluationSettings(**settings)).found


class Oracle(HMA):
    """Gives the true continuation for true actions, and zeros for others."""

    truth: list[Batch]

    def generate(self, prompt: Any, actions: Any, embodiment: Any, frames: int, **_: Any) -> torch.Tensor:
        size, first = prompt.shape[:2]
        made = torch.zeros(size, frames, *prompt.shape[2:], dtype=torch.long)
        for batch in self.truth:
            for tokens, true in zip(batch.tokens, batch.actions):
                for place in range(size):
                    same = torch.equal(actions[place], true[: first + frames])
                    if same and torch.equal(prompt[place], tokens[:first]):
                        made[place] = tokens[first : first + frames]
        return made


@pytest.fixture(scope="module")
def data(arm_shards: Path) -> Path:
    return arm_shards


@pytest.fixture
def batch(data: Path) -> Batch:
    return next(windows(data, "val", 4, 5))


@pytest.fixture
def model() -> HMA:
    return make_model({"arm": 2})


WAYS = [
    {"layout": layout, "action_alignment": alignment, "absent_action": absent, "conditioning": conditioning}
    for layout, alignment, absent in (
        ("ours", "previous", "embedding"), ("ours", "current", "tokens"), ("released", "current", "skip"),
        ("released", "previous", "skip"),
    )
    for conditioning in ("modulation", "concat", "add", "cross_attention", "concat+modulation")
]  # fmt: skip


@pytest.mark.parametrize(
    ("make", "changes"), [*((small_model, way) for way in WAYS), *((copying, way) for way in CHANGES)]
)
def test_all_frames_at_once_are_what_each_is_after_its_own_prefix(make, changes):
    model, names = make(**changes), ["arm", "hand.v1", "arm"]
    config, mixed = model.config, small_batch(model.config, names)
    mixed.action_mask = torch.rand(3, 5, generator=seeded(4)) < 0.7
    nats, hits = teacher_forced(model, mixed)
    digits = to_digits(merge_tokens(mixed.tokens, config.merge, config.vocab_size), config.digits)
    for t in range(1, 5):
        part, own = slice(t + 1), mixed.tokens[:, : t + 1]
        seen = own.clone()
        seen[:, t] = config.vocab_size
        known = mixed.action_mask[:, part]
        scores = model.video_logits(seen, mixed.actions[:, part], names, known, own)[:, t].flatten(1, 2)
        expected = -scores.log_softmax(-1).gather(-1, digits[:, t].unsqueeze(-1)).sum((-1, -2)).mean(1)
        assert torch.allclose(nats[:, t - 1], expected, atol=1e-3)
        right = (scores.argmax(-1) == digits[:, t]).all(-1).float().mean(1)
        assert torch.allclose(hits[:, t - 1], right)


def test_of_a_window_longer_than_the_models_a_frame_sees_what_the_models_holds(data, model):
    long = next(windows(data, "val", 10, 3))
    held, last = model.config.frames, 9
    assert held < last
    nats, hits = teacher_forced(model, long)
    part = slice(last + 1 - held, last + 1)
    tail = replace(
        long,
        tokens=long.tokens[:, part],
        actions=long.actions[:, part],
        action_mask=long.action_mask[:, part],
    )
    expected = teacher_forced(model, tail)
    assert nats.shape == (3, 9) and torch.allclose(nats[:, -1], expected[0][:, -1], atol=1e-5)
    assert torch.equal(hits[:, -1], expected[1][:, -1])


def test_validation_leaves_training_mode_and_random_state_as_they_were(model, batch):
    model.train()
    state = torch.get_rng_state()
    validation_losses(model, [batch])
    assert model.training and torch.equal(torch.get_rng_state(), state)


def test_the_baseline_is_the_cross_entropy_of_the_training_digits(data, batch):
    shards = ShardSet(data)
    tokens = np.concatenate([shards.episode_rows(number)["tokens"].ravel() for number in range(5)])
    low, high = (np.bincount(digits, minlength=8) + 1 for digits in (tokens % 8, tokens // 8))
    truth = batch.tokens[:, 1:].numpy()
    expected = -np.log(low / low.sum())[truth % 8] - np.log(high / high.sum())[truth // 8]
    assert unconditional_baseline([shards], [batch], CONFIG).mean() == pytest.approx(expected.mean())


def test_the_baseline_of_each_embodiment_is_its_own(data, tmp_path):
    other = make_shards(tmp_path / "hand", "hand", dims=3, seed=3)
    batches = [next(windows(folder, "val", 4, 5)) for folder in (data, other)]
    sets = ShardSet(data), ShardSet(other)
    both = unconditional_baseline(sets, batches, CONFIG)
    assert both.by_embodiment() == {
        "arm": unconditional_baseline(sets[:1], batches[:1], CONFIG).mean(),
        "hand": unconditional_baseline(sets[1:], batches[1:], CONFIG).mean(),
    }


def test_frequencies_of_a_part_of_the_data_stay_frequencies(data, monkeypatch):
    monkeypatch.setattr(losses, "BASELINE_FRAMES", 1)
    for part in digit_frequencies(ShardSet(data), (8, 8)):
        assert part.sum() == pytest.approx(1) and (part > 0).all()


def test_a_rollout_begins_with_the_prompt_and_repeats_with_its_seed(model, batch):
    options: dict[str, Any] = {"prompt": 2, "temperature": 1.0}
    one, same, other = (rollout(model, Blocks(), batch, seed=seed, **options) for seed in (1, 1, 2))
    assert one.predicted.shape == one.truth.shape == (5, 4, 16, 16, 3)
    assert (one.predicted[:, :2] == one.truth[:, :2]).all()
    assert (one.predicted == same.predicted).all() and (one.predicted != other.predicted).any()


def test_a_rollout_masks_the_chunks_that_are_unknown(model, batch):
    hidden = without_actions(batch)
    values = replace(hidden, actions=torch.zeros_like(batch.actions))
    one, same, seen = (rollout(model, Blocks(), windows, prompt=2) for windows in (hidden, values, batch))
    assert (one.predicted == same.predicted).all() and (one.predicted != seen.predicted).any()


def test_shuffled_chunks_are_known_where_they_were(batch):
    known = torch.rand(batch.action_mask.shape, generator=torch.Generator().manual_seed(0)) < 0.5
    marked = replace(batch, actions=batch.actions.masked_fill(~known.unsqueeze(-1), 0), action_mask=known)
    other = shuffled(marked, begin=2)
    assert torch.equal((other.actions != 0).any(-1), other.action_mask)
    assert torch.equal(other.action_mask[:, :2], known[:, :2]) and not torch.equal(other.action_mask, known)
    assert torch.equal(other.actions[:, :2], marked.actions[:, :2])  # among the prompt


def test_each_picture_is_decoded_once(data, model):
    class Counting(Blocks):
        decoded = 0

        def decode(self, tokens: np.ndarray) -> np.ndarray:
            self.decoded += len(tokens)
            return super().decode(tokens)

    tokenizer = Counting()
    found = evaluate(model, tokenizer, data, windows=5, prompt=1, batch_size=2, draws=3)
    truth, predicted = found["windows"] * 4, found["windows"] * 3
    assert tokenizer.decoded == truth + (1 + 3 + 1) * predicted  # true, three others, none


def test_a_rollout_longer_than_the_window_is_refused(model, batch):
    with pytest.raises(UsageError, match=r"2 \+ 3 frames do not fit windows of 4"):
        rollout(model, Blocks(), batch, frames=3, prompt=2)


def test_shuffled_actions_are_another_windows_of_the_same_embodiment_and_others_in_every_draw(batch):
    mixed = replace(batch, embodiment=["arm", "hand", "arm", "hand", "arm"])
    mixed.actions[:, 0, 0] = torch.arange(5.0)
    other = shuffled(mixed).actions[:, 0, 0].long().tolist()
    assert sorted(other) == [0, 1, 2, 3, 4]
    assert all(a != b and (a - b) % 2 == 0 for a, b in enumerate(other))
    draws = [tuple(shuffled(batch, draw=draw).actions[:, 0, 0].tolist()) for draw in range(5)]
    assert len(set(draws)) > 1 and draws[0] == tuple(shuffled(batch).actions[:, 0, 0].tolist())


def test_figures_of_shuffled_actions_are_means_over_the_draws(data, model, monkeypatch):
    real = actions.partners
    one = []
    for draw in range(3):
        monkeypatch.setattr(actions, "partners", lambda names, seed, draw, only=draw: real(names, seed, only))
        one.append(evaluate(model, Blocks(), data, windows=5, prompt=1, batch_size=2, draws=1))
    monkeypatch.setattr(actions, "partners", real)
    found = evaluate(model, Blocks(), data, windows=5, prompt=1, batch_size=2, draws=3)
    assert found["true"] == one[0]["true"] and found["draws"] == 3
    for key in ("psnr_last", "ssim"):
        assert found["shuffled"][key] == pytest.approx(np.mean([part["shuffled"][key] for part in one]))
    assert found["shuffled_loss"] == pytest.approx(np.mean([part["shuffled_loss"] for part in one]))


def test_a_perfect_model_has_the_highest_psnr_and_loses_it_with_shuffled_or_gaussian_actions(data):
    oracle = Oracle(CONFIG)
    oracle.add_embodiment(make_model({"arm": 2}).embodiments["arm"])
    oracle.truth = list(windows(data, "val", 4, 6, batch_size=3))
    figures = evaluate(oracle.eval(), Blocks(), data, windows=6, batch_size=3, prompt=1, paper=True)
    assert (figures["true"]["psnr"], figures["true"]["ssim"]) == (60.0, pytest.approx(1.0))
    assert figures["shuffled"]["psnr_last"] < 30 and figures["psnr_action_gain_last"] > 30
    assert figures["windows"] == 6 and len(figures["true"]["psnr_by_frame"]) == 3
    assert figures["copy"]["psnr"] < 60
    paper = figures["paper"]  # the last frame after the true past
    assert paper["psnr_last"] == 60.0 and paper["gaussian_psnr_last"] < 30
    assert paper["delta_psnr"] == pytest.approx(60 - paper["gaussian_psnr_last"])
    assert "paper" not in figures["missing"]


GAIN: dict[str, Any] = {
    "psnr_action_gain_last": 2.13, "psnr_action_gain_last_95": [1.2, 6.2], "episodes": 8, "recordings": 8,
    "windows": 24, "unmoved_windows": 0, "split": "val", "frames": 8, "prompt": 2, "seconds_a_frame": 0.1,
    "sees_actions": True, "merge": 1, "loss": 2.0,
}  # fmt: skip
NO_GAIN = GAIN | {"psnr_action_gain_last": 0.1, "psnr_action_gain_last_95": [-0.1, 0.3]}


def test_the_verdict_says_whether_the_model_follows_its_actions() -> None:
    said = (
        "last-frame PSNR gain +2.1 dB (95 % CI +1.2 to +6.2), recorded vs shuffled actions, "
        "0.6 s after the prompt, 8 held-out episodes"
    )
    assert follows(GAIN) and verdict(GAIN) == f"follows its actions: {said}"
    assert not follows(NO_GAIN)
    assert verdict(NO_GAIN).startswith("does not follow its actions yet: last-frame PSNR gain +0.1 dB")
    heard = NO_GAIN | {"shuffled_loss": 4.0, "loss_action_gain_95": [1.0, 3.0]}
    assert verdict(heard).startswith(
        "is sensitive to its actions (loss 2.00 nats per token, 4.00 with shuffled actions), but"
    )
    assert "(loss 2.00 nats per square of 2×2 tokens, 4.00" in verdict(heard | {"merge": 2})
    assert verdict(heard | {"shuffled_loss": 2.1}).startswith("does not follow its actions yet")
    for ends in (None, [-0.1, 4.1]):
        assert verdict(heard | {"loss_action_gain_95": ends}).startswith("does not follow its actions yet")


def test_the_verdict_says_when_the_episodes_are_few() -> None:
    assert verdict(GAIN | {"episodes": 4, "recordings": 4}).endswith(", only 4 held-out episodes")
    assert verdict(GAIN | {"split": "train"}).endswith("the prompt, 8 episodes")
    assert verdict(GAIN | {"recordings": 2}).endswith(", only 8 held-out episodes of 2 recordings")


def test_no_model_follows_without_an_interval_above_zero() -> None:
    wide = GAIN | {"psnr_action_gain_last_95": [-2.59, 8.77], "episodes": 3, "recordings": 3}
    assert not follows(wide) and verdict(wide).startswith("may follow its actions (inconclusive): ")
    assert "(95 % CI -2.6 to +8.8)" in verdict(wide) and verdict(wide).endswith("only 3 held-out episodes")
    one = GAIN | {"psnr_action_gain_last_95": None, "episodes": 1, "recordings": 1}
    assert not follows(one) and verdict(one).startswith("may follow its actions (inconclusive): ")
    for ends in (None, [-3.0, 6.0]):  # the gain may be large, or not
        few = NO_GAIN | {"psnr_action_gain_last_95": ends}
        assert verdict(few).startswith("may follow its actions (inconclusive): ")
    assert "+2.1 dB (no CI)" in verdict(one) and verdict(one).endswith("only 1 held-out episode")


# -- intervals, other commands, words


def test_episodes_of_one_recording_have_no_interval(model, tmp_path):
    data = make_shards(tmp_path, "arm", held_out=3)
    found = evaluate(model, Blocks(), data, windows=6, prompt=1)
    assert found["recordings"] == 3 and found["loss_95"] and found["loss_action_gain_95"]
    state(data, "group", last=["one"] * 3)
    found = evaluate(model, Blocks(), data, windows=6, prompt=1)
    assert (found["episodes"], found["recordings"], found["loss_95"]) == (3, 1, None)
    assert found["true"]["psnr_95"] is found["perplexity_95"] is None
    assert found["true"]["psnr_by_frame_95"][0] == [None, None]
    assert "all windows come from one recording, so no figure has an interval" in " ".join(found["notes"])


def test_episodes_are_resampled_whole():
    rng = np.random.default_rng(0)
    level = np.repeat(rng.normal(0, 1, 20), 10)  # windows of an episode are nearly equal
    values, episodes = level + rng.normal(0, 0.01, 200), np.repeat(np.arange(20), 10)
    apart, whole = interval(values), interval(values, 0, episodes)
    assert (whole[1] - whole[0]) / (apart[1] - apart[0]) == pytest.approx(np.sqrt(10), rel=0.15)
    assert np.allclose(whole, interval(level[::10]), atol=0.01)
    uneven = np.concatenate([np.zeros(30), np.ones(10)])  # a mean of windows, not of episodes
    ends = interval(uneven, 0, np.repeat([0, 1], [30, 10]))
    stretch = (
        scipy.stats.t.ppf(0.975, 1) / 1.959964 * math.sqrt(2)
    )  # 0 and 1 are the ends of the resamples of two
    assert tuple(ends) == pytest.approx((0.25 - 0.25 * stretch, 0.25 + 0.75 * stretch))
    mean, ends = over_datasets([values, values + 4], [episodes, np.zeros(200)], ANY)
    assert mean == pytest.approx(values.mean() + 2) and ends is None  # each set counts once


def test_a_model_that_was_trained_without_actions_is_given_none(data, model):
    blind = make_model({"arm": 2}, config=model.config.replace(objectives={"passive": 1})).eval()
    blind.load_state_dict(model.state_dict())
    found, seeing = (evaluate(one, Blocks(), data, windows=5, prompt=1) for one in (blind, model))
    assert verdict(found) == "was trained without actions"
    assert found["loss"] == pytest.approx(found["shuffled_loss"], abs=1e-5)
    assert found["loss"] != seeing["loss"]
    assert found["true"] == found["none"] == seeing["none"] and found["psnr_action_gain_last"] == 0


def test_no_interval_of_two_episodes_leaves_what_a_figure_can_be(tmp_path, model):
    data = make_shards(tmp_path / "two", "arm", held_out=2)
    found = evaluate(model, Blocks(), data, windows=4, prompt=1)
    assert found["episodes"] == 2
    for kind in ("true", "shuffled", "none", "copy"):
        low, high = np.array([found[kind]["psnr_last_95"], *found[kind]["psnr_by_frame_95"]]).T
        assert low.min() >= 0 and high.max() <= 60
        assert found[kind]["ssim_95"][0] >= -1 and found[kind]["ssim_95"][1] <= 1
    part = Part(
        "one", "two", found, {"true.psnr": np.array([1.0, 59.0]), "recording": np.array([0.0, 1.0])}, {}
    )
    figures = [figure for figure in FIGURES if figure.path == "true.psnr"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tables, "FIGURES", figures)
        (mean,) = means([part])
    assert mean["true.psnr_95"] == [0, 60]


def test_intervals_are_the_middle_of_resampled_means():
    values = np.random.default_rng(0).normal(3, 2, 400)
    low, high = interval(values)
    error = values.std() / 20
    assert (low, high) == pytest.approx(tuple(values.mean() + np.array([-1.96, 1.96]) * error), abs=0.06)
    assert np.allclose(interval(values[:, None].repeat(2, axis=1))[:, 0], interval(values))


def test_intervals_of_few_episodes_hold_the_mean_as_often_as_they_say():
    rng = np.random.default_rng(3)
    for episodes in (2, 3, 6):
        held = 0
        for _ in range(300):
            values = np.repeat(rng.normal(0, 1, episodes), 4)  # windows of one episode are alike
            low, high = interval(values, 0, np.repeat(np.arange(episodes), 4))
            held += low <= 0 <= high
        assert held / 300 > 0.9


def test_gaussian_commands_have_the_embodiments_statistics(batch):
    many = replace(batch, actions=torch.zeros(2000, 4, 4), action_mask=torch.zeros(2000, 4, dtype=torch.bool))
    drawn = gaussian(many, {"mean": [3.0, -1.0], "std": [0.5, 0.0]}, seed=1)
    steps = drawn.actions.unflatten(2, (2, 2))  # of a chunk, then dims
    assert steps.mean(dim=(0, 1, 2)).tolist() == pytest.approx([3, -1], abs=0.02)
    assert steps.std(dim=(0, 1, 2)).tolist() == pytest.approx([0.5, 0], abs=0.02)
    assert drawn.action_mask.all()


def test_a_model_that_always_saw_actions_is_said_to_be_poor_without(data, model):
    assert "not trained without actions" in " ".join(evaluate(model, Blocks(), data, windows=2)["notes"])


def test_masked_scores_are_those_of_the_training_loss(batch):
    plain = make_model({"arm": 2}, config=CONFIG.replace(label_smoothing=0.0, training_pass="pairs"))
    for model in (plain, make_model({"arm": 2}, config=CONFIG.replace(label_smoothing=0.0))):
        nats, hits = masked_scores(model, batch, torch.Generator().manual_seed(3))
        expected = model(batch, "forward", torch.Generator().manual_seed(3)).per_sample
        drawn = expected > 0  # a window in which no token is masked has no scores
        assert torch.allclose(nats[drawn], expected[drawn], atol=1e-5) and drawn.sum() >= 3
        assert torch.equal(nats.isnan(), ~drawn) and ((hits[drawn] >= 0) & (hits[drawn] <= 1)).all()


def test_the_papers_perplexity_is_a_mean_over_batches_of_four(data, model):
    measured = measure(model, Blocks(), data, EvaluationSettings(windows=6, paper=True, draws=1))
    nats = measured.by_window["loss"]
    expected = np.mean([np.exp(nats[:4].mean()), np.exp(nats[4:].mean())])
    assert measured.found["paper"]["perplexity"] == pytest.approx(expected, abs=1e-3)


def test_predictions_that_are_not_finite_are_said_in_words(data, model, monkeypatch):
    def generate(prompt: Any, actions: Any, embodiment: Any, frames: int, **_: Any) -> torch.Tensor:
        return torch.full((len(prompt), frames, *prompt.shape[2:]), math.nan)

    monkeypatch.setattr(model, "generate", generate)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = evaluate(model, Blocks(), data, windows=5)
    assert found["true"]["psnr_last"] is None and found["copy"]["psnr_last"] is not None
    assert "predicted frames are NaN or infinite" in found["notes"][0]
    assert verdict(found) == "cannot be judged: its predictions are not finite"
    tokens = GAIN | {"loss": None}  # a discrete model decodes tokens of NaN all the same
    assert verdict(tokens) == "cannot be judged: its predictions are not finite"


def test_pictures_that_never_change_are_said_in_words(model, data):
    class Dark(Blocks):
        def decode(self, tokens: np.ndarray) -> np.ndarray:
            return np.zeros_like(super().decode(tokens))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = evaluate(model, Dark(), data, windows=5)
    assert found["true"]["psnr_last"] == found["copy"]["psnr_last"] == 60
    assert "the recorded images of 5 of 5 windows never change" in found["notes"][0]


@pytest.mark.parametrize(
    ("count", "sizes"), [(4, [4]), (5, [3, 2]), (6, [4, 2]), (8, [4, 4]), (9, [3, 3, 3]), (1, [1])]
)
def test_no_window_is_alone_in_its_batch(data, count, sizes):
    found = list(windows(data, "val", 4, count, batch_size=4))
    assert [len(batch) for batch in found] == sizes
    frames = [int(frame) for batch in found for frame in batch.frame]
    assert frames == sorted(set(frames)) and len(frames) == count


def test_validation_windows_are_spread_and_all_where_there_are_fewer(data):
    frames = [int(frame) for batch in windows(data, "val", 4, 5, batch_size=2) for frame in batch.frame]
    assert frames == [0, 4, 8, 12, 16]
    every = len(WindowDataset(data, "val", 4))
    assert sum(len(batch) for batch in windows(data, "val", 4, 10_000)) == every
