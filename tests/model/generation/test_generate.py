"""Rollouts: the cache against computing all again, what decoding promises, how unsure a model is."""

import math
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from hma_data.errors import HMAError
from hma_model.config import CONDITIONINGS
from hma_model.generation import commands
from hma_model.generation.commands import Commands, described
from hma_model.generation.passes import Passes
from hma_model.generation.rollout import Rollout
from hma_model.network.draws import randn
from hma_model.network.model import HMA
from hma_model.network.trunks.contract import window_times
from tests.model.network_parts import ARM, seeded, small_batch, small_model
from tests.model.robots import make_model, save
from tests.model.true_world import tiny_model

COMBINATIONS = [*((name,) for name in CONDITIONINGS), CONDITIONINGS[:2], CONDITIONINGS]
LAYOUTS = {
    "rotary": {},
    "learned": {"layout": "released"},
    "released": {
        "layout": "released", "conditioning": ("concat", "modulation"), "action_tokens": 3,
        "absent_action": "skip", "action_alignment": "current",
    },
    "tokens": {"layout": "released", "absent_action": "tokens", "action_tokens": 2},
    "qk norm": {"layout": "released", "qk_norm": True, "conditioning": ("concat",)},
    "cross": {"conditioning": ("add", "cross_attention")},
    "previous": {"masked_input": "previous"},
    "merged": {"merge": 2, "masked_input": "previous"},
    "chain": {"digit_order": "chain", "factored": (4, 2, 2)},
    "copies": {"digit_order": "chain", "factored": (4, 2, 2), "copy_previous": True},
}  # fmt: skip


def _rollout(
    model: HMA, cache: bool, prompt: int, frames: int, actions: bool = True, **how: object
) -> torch.Tensor:
    batch = small_batch(model.config, ["arm", "hand.v1", "arm"], frames=prompt + frames)
    known = batch.tokens if model.config.kind == "discrete" else batch.latents
    chunks = batch.actions if actions else None
    return model.generate(
        known[:, :prompt], chunks, batch.embodiment, frames, generator=seeded(), cache=cache, **how
    )  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("layout", "prompt", "actions"),
    [(layout, prompt, True) for layout in LAYOUTS for prompt in (1, 7)]  # below and above the window of five
    + [(layout, 3, False) for layout in ("rotary", "released", "tokens", "cross")],
)
def test_the_cache_changes_nothing(layout: str, prompt: int, actions: bool) -> None:
    model = small_model(**LAYOUTS[layout])
    how = {"unmask_steps": 3, "temperature": 0.5}
    cached, plain = (_rollout(model, cache, prompt, 7, actions, **how) for cache in (True, False))
    assert torch.equal(cached, plain)


@pytest.mark.parametrize("layout", ["rotary", "released", "previous", "copying"])
def test_the_cache_changes_no_latents(layout: str) -> None:
    own = {"copy_previous": True} if layout == "copying" else LAYOUTS[layout]
    model = small_model(kind="continuous", **own)
    for parameter in model.latent_readout.diffusion.parameters():
        parameter.data *= 0.1  # the noisiest level divides by almost nothing, which would enlarge rounding
    cached, plain = (_rollout(model, cache, 2, 6, unmask_steps=3, temperature=0.5) for cache in (True, False))
    assert (cached - plain).abs().max() < 1e-4


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
@pytest.mark.parametrize("conditioning", COMBINATIONS, ids="+".join)
def test_every_pass_of_a_cached_rollout_has_the_features_of_full_recomputation(
    kind: str, conditioning: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    model = small_model(kind=kind, conditioning=conditioning, action_tokens=2)
    seen: list[list[torch.Tensor]] = []
    plain = Passes.features

    def features(self: Passes, frame: Any, shared: Any, first: bool) -> tuple[torch.Tensor, torch.Tensor]:
        found = plain(self, frame, shared, first)
        seen[-1].append(found[0])
        if not self.state.caching:  # it has all frames; here without slots, as a window in training
            rows, count = [0, 1, 2], self.state.times[0]
            times = window_times(model.config, count + 1, "cpu")
            past = self.state.past(rows, times.positions[:-1].unsqueeze(0))
            masked = torch.zeros(3, count + 1, past.shape[2], 1, dtype=torch.bool)
            masked[:, -1] = frame.masked.unsqueeze(-1)
            x = model.embed(torch.cat([past, frame.values.unsqueeze(1)], dim=1), masked)
            conditioned = self._condition(rows, times.positions.unsqueeze(0))
            seen[-1][-1] = model.trunk(x, conditioned, times)[:, -1]
        return found

    monkeypatch.setattr(Passes, "features", features)
    if kind == "continuous":
        for parameter in model.latent_readout.diffusion.parameters():
            parameter.data *= 0.1
    for cache in (True, False):
        seen.append([])
        _rollout(model, cache, 2, 5, unmask_steps=3)
    assert len(seen[0]) == len(seen[1]) == 15
    assert max((a - b).abs().max() for a, b in zip(*seen)) < 1e-4


@pytest.mark.parametrize("unmask_steps", [1, 2, 5, 40])
def test_every_token_is_unmasked(unmask_steps: int) -> None:
    made = _rollout(small_model(), True, 2, 3, unmask_steps=unmask_steps)
    assert made.shape == (3, 3, 4, 4) and made.min() >= 0 and made.max() < 24


def test_temperature_flattens_what_is_drawn() -> None:
    model = small_model()
    batch = small_batch(model.config, ["arm"], frames=2)
    prompt, actions = batch.tokens[:, :1].expand(64, -1, -1, -1), batch.actions.expand(64, -1, -1)

    def kinds(temperature: float) -> float:
        made = model.generate(prompt, actions, "arm", 1, 1, temperature, seeded())
        return sum(made[:, 0, y, x].unique().numel() for y in range(4) for x in range(4)) / 16

    assert kinds(0.0) == 1
    assert 1 < kinds(0.2) < kinds(5.0)


def test_actions_steer_the_frames_after_them() -> None:
    model = small_model()
    batch = small_batch(model.config, ["arm"], frames=6)
    first = model.generate(batch.tokens[:, :2], batch.actions, "arm", 4, temperature=0, generator=seeded(1))
    batch.actions[:, 3:] += 3
    second = model.generate(batch.tokens[:, :2], batch.actions, "arm", 4, temperature=0, generator=seeded(1))
    assert torch.equal(first[:, :2], second[:, :2]) and not torch.equal(first[:, 2:], second[:, 2:])


def test_a_prompt_begins_a_rollout_anew() -> None:
    model = small_model()
    batch = small_batch(model.config, ["arm"], frames=6)
    rollout = Rollout(model, "arm")
    frames = []
    for _ in range(2):
        rollout.prompt(batch.tokens[:, :2], batch.actions)
        torch.manual_seed(0)
        frames.append([rollout.step(batch.actions[:, k]) for k in (1, 2)])
    assert all(torch.equal(a, b) for a, b in zip(*frames))


@pytest.mark.parametrize("layout", ["rotary", "released"])
def test_unknown_chunks_are_masked_as_in_training(layout: str) -> None:
    model = small_model(**LAYOUTS[layout])
    batch = small_batch(model.config, ["arm", "hand.v1"], frames=4)
    known = torch.tensor([[True, False, True, True], [False, True, False, True]])
    robots = batch.embodiment
    how = {"unmask_steps": 1, "temperature": 0}
    made = model.generate(batch.tokens[:, :3], batch.actions, robots, 1, known=known, **how)
    window = torch.cat([batch.tokens[:, :3], torch.full((2, 1, 4, 4), 24)], dim=1)
    with torch.no_grad():
        masked, plain = (model.video_logits(window, batch.actions, robots, m)[:, 3] for m in (known, None))
    low, high = masked[..., 0, :6].argmax(-1), masked[..., 1, :4].argmax(-1)
    assert torch.equal(made[:, 0], low + 6 * high)
    assert (masked - plain).abs().max() > 1e-3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"unmask_steps": 0}, "unmask_steps"),
        ({"temperature": -0.1}, "temperature: .* give a number of at least 0"),
        ({"temperature": math.inf}, "temperature"),
        ({"temperature": math.nan}, "temperature"),
        ({"order": "spiral"}, "order"),
    ],
)
def test_wrong_decoding_is_refused(change: dict, message: str) -> None:
    with pytest.raises(HMAError, match=message):
        _rollout(small_model(), True, 2, 1, **change)


def test_too_few_actions_are_refused() -> None:
    model = small_model()
    batch = small_batch(model.config, ["arm"])
    with pytest.raises(HMAError, match="5 chunks for 3 \\+ 4 frames"):
        model.generate(batch.tokens[:, :3], batch.actions, "arm", 4)


def test_a_prompt_of_another_shape_is_refused() -> None:
    with pytest.raises(HMAError, match="a frame has the shape"):
        small_model().generate(torch.zeros(1, 2, 4, 3, dtype=torch.long), None, ARM.id, 1)


ROBOT = "rails_03"


def measuring(model: HMA, robot: str, rows: int = 1, **options: Any) -> Rollout:
    rollout = Rollout(model, robot, rows, **options)
    rollout.decoding = replace(rollout.decoding, measure=True)
    return rollout


def latents(rows: int, model: HMA) -> Tensor:
    shape = (rows, 2, model.config.channels, *model.config.grid)
    return torch.randn(shape, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("options", [{}, {"order": "confidence", "unmask_steps": 3}])
def test_the_entropy_is_measured_and_changes_nothing(options: dict[str, Any]) -> None:
    model = tiny_model(ROBOT)
    prompt = torch.randint(0, 8**6, (2, 2, 8, 8), generator=torch.Generator().manual_seed(0))
    width = model.embodiments[ROBOT].chunk_dim
    frames, entropies = [], []
    for made in (Rollout, measuring):
        rollout = made(model, ROBOT, 2, **options)  # type: ignore[operator]
        rollout.prompt(prompt, torch.zeros(2, 1, width), seeds=[1, 2])
        frames.append(rollout.step(torch.ones(2, width)))
        entropies.append(rollout.uncertainty[:2])
    assert torch.equal(*frames)
    assert (entropies[0] == 0).all()
    assert (entropies[1] > 0).all() and (entropies[1] <= 6 * math.log(8) * model.config.merge**2 + 1e-3).all()


def test_a_model_that_knows_nothing_has_the_entropy_of_the_vocabulary() -> None:
    model = tiny_model(ROBOT)
    for weight in model.readout.parameters():
        torch.nn.init.zeros_(weight)
    rollout = measuring(model, ROBOT)
    rollout.prompt(torch.zeros(1, 1, 8, 8, dtype=torch.int64), None)
    rollout.step(torch.zeros(1, model.embodiments[ROBOT].chunk_dim))
    assert rollout.uncertainty.item() == pytest.approx(6 * math.log(8) * model.config.merge**2, rel=1e-4)


@pytest.mark.parametrize("options", [{}, {"temperature": 1.0, "unmask_steps": 3}])
def test_the_spread_of_latents_is_measured_and_changes_nothing(options: dict[str, Any]) -> None:
    model = small_model(kind="continuous")
    frames, spreads = [], []
    for made in (Rollout, measuring, measuring):
        rollout = made(model, "arm", 2, **options)  # type: ignore[operator]
        rollout.prompt(latents(2, model), torch.zeros(2, 1, ARM.chunk_dim), seeds=[1, 2])
        frames.append(torch.stack([rollout.step(torch.ones(2, ARM.chunk_dim)) for _ in range(3)]))
        spreads.append(rollout.uncertainty[:2])
    assert torch.equal(frames[0], frames[1]) and torch.equal(frames[0], frames[2])
    assert (spreads[0] == 0).all() and (spreads[1] > 0).all() and torch.equal(spreads[1], spreads[2])


def test_a_row_has_the_spread_that_it_has_alone() -> None:
    model, found = small_model(kind="continuous"), []
    prompt = latents(3, model)
    for rows in ([0, 1, 2], [1]):
        rollout = measuring(model, "arm", len(rows))
        rollout.prompt(prompt[rows], torch.zeros(len(rows), 1, ARM.chunk_dim), seeds=rows)
        rollout.step(torch.ones(len(rows), ARM.chunk_dim))
        found.append(rollout.uncertainty[rows.index(1)])
    torch.testing.assert_close(*found)


def test_the_spread_is_the_standard_deviation_of_the_draws_in_the_tokenizers_units(monkeypatch) -> None:
    model = small_model(kind="continuous", latent_scale=0.5, grid=(32, 32))

    def draw(conditions: Tensor, steps: Any, temperature: Any, generators: Any) -> Tensor:
        return 3 + 0.2 * randn((len(conditions), model.config.patch_dim), generators, conditions.device)

    monkeypatch.setattr(model.readout, "sample", draw)
    rollout = measuring(model, "arm")
    rollout.prompt(latents(1, model), torch.zeros(1, 1, ARM.chunk_dim), seeds=[0])
    made = rollout.step(torch.ones(1, ARM.chunk_dim))
    assert made.std().item() == pytest.approx(0.4, rel=0.05)
    assert rollout.uncertainty.item() == pytest.approx(0.4, rel=0.05)


# -- the range of commands


NAMES = {"arm": 2, "crane": 3}


def told(model: HMA, actions: torch.Tensor, known: torch.Tensor | None = None) -> list[str]:
    """Return what is warned of when a sample of each robot is generated."""
    prompt = torch.zeros(2, 2, 2, 3, dtype=torch.long)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.generate(prompt, actions, list(NAMES), 2, known=known)
    assert all(one.filename == __file__ for one in caught)
    return [str(one.message) for one in caught]


def test_actions_outside_the_range_are_told_once_of_each_embodiment(tmp_path, monkeypatch) -> None:
    save(tmp_path, NAMES)
    model = HMA.from_pretrained(tmp_path).eval()
    ends = {"arm": np.array([[-1, -1], [1, 1]]), "crane": np.array([[-9, -9, -9], [9, 9, 9]])}
    monkeypatch.setattr(commands, "_seen", lambda model, name: ends[name].astype(np.float32))
    actions = torch.full((2, 4, 6), 0.5)
    assert told(model, actions) == []
    wide = actions.clone()
    wide[0, :, 4:] = 50  # beyond the arm's chunk of 2 x 2 values, as padding may be
    wide[:, 3] = 50  # and after the last frame
    assert told(model, wide) == []
    wide = actions.clone()
    wide[0, 1, 3] = 2
    known = torch.ones(2, 4, dtype=torch.bool)
    known[0, 1] = False
    assert told(model, wide, known) == []
    (said,) = told(model, wide)
    assert said == "arm: an action is outside the range seen in training (actions.1 -1 to 1). Shown only once"
    assert told(model, wide * 20)[0].startswith("crane: ")
    assert told(model, wide * 20) == []


def test_commands_of_unknown_range_have_no_bounds() -> None:
    own = Commands.of(make_model(NAMES), "crane")
    assert own.seen is None and (own.low == -np.inf).all() and own.low.shape == own.high.shape == (3,)


def test_a_robot_whose_rate_nobody_states_has_commands(tmp_path, monkeypatch) -> None:
    save(tmp_path, NAMES)
    model = HMA.from_pretrained(tmp_path)
    robot = described(model, "arm")
    assert robot is not None and Commands.of(model, "arm").rate_hz == robot.rate_hz
    unstated = robot.model_copy(update={"frequency_hz": "unknown"})
    monkeypatch.setattr(commands, "described", lambda model, name: unstated)
    assert Commands.of(model, "arm").rate_hz is None
