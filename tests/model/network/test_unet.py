"""The U-Net trunk: the same frames with and without a carried past, and pixels that stay what they are."""

from functools import partial
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from hma_data.errors import RecipeError, TokenizerError
from hma_data.tokenizers.base import TokenizerSpec
from hma_model import HMA
from hma_model.config import HMAConfig
from hma_model.network import objectives
from hma_model.network.colors import SURE, balanced
from hma_model.network.objectives import surrounded
from hma_model.network.trunks.contract import Conditioning, TimePositions, paired_times
from hma_model.training.crops import cropped
from hma_model.training.scheduled_sampling import forwarded
from tests.model.network_parts import ARM, HAND, small_batch

SPEC = TokenizerSpec.continuous("raw-16", 1, 16, 1, 3, latent_scale=1 / 255, dtype="uint8")
PIXELS: dict[str, Any] = {
    "kind": "continuous", "trunk": "unet", "layers": 1, "levels": (8, 16), "width": 16, "heads": 2,
    "frames": 4, "grid": (16, 16), "channels": 3, "patch": 4, "latent_scale": 1 / 255,
    "shared_modulation": True,
    "training_pass": "pairs", "whole_share": 1.0, "video_loss": "regression", "copy_previous": True,
    "told_noise": True, "latent_noise": 0.1, "corrupt_max": 1.0, "action_waves": 2,
    "tokenizer": SPEC.to_json(),
}  # fmt: skip
COLORS: dict[str, Any] = {
    **PIXELS, "kind": "discrete", "grid": (8, 8), "factored": (5,) * 4, "video_loss": "diffusion",
    "told_noise": False, "corrupt_max": 0.0, "latent_scale": 1.0, "tokenizer": {},
}  # fmt: skip
LATENTS = {**PIXELS, "grid": (8, 8), "channels": 4, "patch": 2, "latent_scale": 0.5, "tokenizer": {}}


def unet(moving: bool = True, **changes: Any) -> HMA:
    """Return a model of two robots; `moving` leaves the state in which every frame repeats the one before."""
    torch.manual_seed(0)
    model = HMA(HMAConfig(**{**PIXELS, **changes}))
    model.add_embodiment(ARM)
    model.add_embodiment(HAND)
    if moving:
        for name, parameter in model.named_parameters():
            if name.endswith(("conv2.weight", "proj.weight")):
                torch.nn.init.normal_(parameter, std=0.1)
    return model.eval()


def stored(model: HMA, batch: int, frames: int, seed: int = 0) -> Tensor:
    draws = torch.Generator().manual_seed(seed)
    shape = batch, frames, *model.config.frame_shape
    if model.config.kind == "discrete":
        return torch.randint(0, model.config.vocab_size, shape, generator=draws)
    if model.config.pixels:
        return torch.randint(0, 256, shape, generator=draws).float()
    return torch.randn(shape, generator=draws)


@pytest.mark.parametrize("changes", [{}, LATENTS, {"views": 2}, {"levels": (8,)}])
@pytest.mark.parametrize("prompt", [1, 3, 6])
def test_a_rollout_makes_the_frames_of_a_model_that_computes_everything_anew(changes, prompt) -> None:
    model = unet(**changes)
    frames, names = stored(model, 2, prompt), ["arm", "hand.v1"]
    actions = torch.randn(2, prompt + 7, 6, generator=torch.Generator().manual_seed(1))
    made, anew = (model.generate(frames, actions, names, 7, cache=cache) for cache in (True, False))
    torch.testing.assert_close(made, anew, rtol=0, atol=2.0 if model.config.pixels else 1e-4)
    assert (made[:, -1] - frames[:, -1]).abs().mean() > 0.05  # it moves


@pytest.mark.parametrize("merge", [1, 2])
def test_a_rollout_of_tokens_makes_the_frames_of_a_model_that_computes_everything_anew(merge: int) -> None:
    model = unet(**{**COLORS, "merge": merge})
    frames = stored(model, 2, 3)
    actions = torch.randn(2, 10, 6, generator=torch.Generator().manual_seed(1))
    make = partial(model.generate, frames, actions, "arm", 7, unmask_steps=1, temperature=0.0)
    made, anew = make(cache=True), make(cache=False)
    assert torch.equal(made, anew)
    assert (made[:, -1] != frames[:, -1]).float().mean() > 0.05  # it moves


def test_a_frame_is_that_of_the_training_pass() -> None:
    model = unet(**LATENTS)
    frames, actions = stored(model, 1, 4), torch.randn(1, 4, 6)
    made = model.generate(frames[:, :3], actions, "arm", 1)
    times = paired_times(model.config, 3, 4, model.device)
    values = model.frame_values(frames)
    passed = torch.cat([values[:, :3], values[:, 1:]], dim=1)
    masked = torch.zeros_like(passed[..., :1], dtype=torch.bool)
    masked[:, 3:] = True
    order = [0, 1, 2, 1, 2, 3]
    chunk = torch.cat([torch.zeros(1, 1, 6), actions[:, :3]], dim=1)[:, order]
    embedding = model.stem("arm")(chunk)
    embedding[:, 0] = model.trunk.absent[0]
    features = model.trunk(model.embed(passed, masked, order), Conditioning(embedding), times)
    conditions = model.latent_readout(features[:, -1:], times.positions[-1:], values[:, 2:3])
    expected = model.latent_readout.sample(conditions.flatten(0, 2)) / model.config.latent_scale
    got = model.frame_values(made) / model.config.latent_scale
    torch.testing.assert_close(got.flatten(0, 2), expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("changes", [LATENTS, COLORS])
def test_a_late_frame_of_a_rollout_is_that_of_a_window_as_in_training(changes: dict[str, Any]) -> None:
    model = unet(**changes)
    past = model.config.frames - 1
    frames, actions = stored(model, 2, 9), torch.randn(2, 9, 6, generator=torch.Generator().manual_seed(1))
    late = model.generate(frames, actions, "arm", 1)
    window = model.generate(frames[:, -past:], actions[:, -past:], "arm", 1)  # nothing leads to its first
    torch.testing.assert_close(late.float(), window.float(), rtol=0, atol=1e-4)


def test_what_is_not_wanted_is_not_computed_and_changes_nothing() -> None:
    model = unet()
    x = torch.randn(2, 6, 16, 16)
    under = Conditioning(torch.randn(2, 6, 16))
    every, last = (paired_times(model.config, 3, 4, model.device) for _ in range(2))
    last.wanted = 3
    features = model.trunk(x, under, every), model.trunk(x, under, last)
    torch.testing.assert_close(features[0][:, 3:], features[1][:, 3:])
    assert not features[1][:, :3].any()


def test_pixels_of_an_untrained_model_stay_for_any_number_of_frames() -> None:
    model = unet(moving=False)
    frames = stored(model, 1, 2)
    made = model.generate(frames, torch.randn(1, 42, 6), "arm", 40)
    assert torch.equal(made, frames[:, -1:].expand_as(made))


def test_what_moves_weighs_more() -> None:
    still, heavy = unet(motion_weight=0.0), unet(motion_weight=6.0)
    batch = small_batch(still.config, ["arm", "hand.v1"])
    batch.latents = stored(still, 2, still.config.frames)
    assert heavy(batch).loss > 1.5 * still(batch).loss
    batch.latents = batch.latents[:, :1].expand_as(batch.latents).clone()
    draws = (torch.Generator().manual_seed(3) for _ in range(2))
    torch.testing.assert_close(
        heavy(batch, generator=next(draws)).loss, still(batch, generator=next(draws)).loss
    )


@pytest.mark.parametrize("changes", [LATENTS, COLORS])
def test_each_pass_makes_one_more_frame_of_the_past_that_of_a_rollout(changes: dict[str, Any]) -> None:
    model = unet(**{**changes, "frames": 6})
    batch, true = small_batch(model.config, ["arm"]), stored(model, 1, 6)
    batch.tokens = true if model.config.kind == "discrete" else None
    batch.latents = true if batch.tokens is None else None
    seen = forwarded(model, batch, 1.0, 3, torch.Generator().manual_seed(0)).context
    assert seen is not None
    first = int((seen != true).flatten(2).any(-1)[0].nonzero()[0])
    rolled = model.generate(true[:, :first], batch.actions, "arm", 3, unmask_steps=1, temperature=0.0)
    torch.testing.assert_close(seen[:, first : first + 3], rolled[:, : 6 - first], rtol=0, atol=1e-4)


SHADES = "ffffff8090a08494a47c8c9cff0000"  # a ground, three shades of an object, another one


def test_a_shade_of_an_object_is_taken_though_the_ground_is_likelier_than_each_shade() -> None:
    readout = unet(**{**COLORS, "tokenizer": {"colors": SHADES}}).token_readout
    shares = torch.tensor(
        [[0.40, 0.20, 0.18, 0.20, 0.02], [0.6, 0.2, 0.1, 0.1, 0.0], [0.1, 0.0, 0.0, 0.0, 0.9]]
    )
    scores = shares.log().clamp(min=-1e9).view(3, 1, 1, 5)  # frames of one pixel
    assert readout.taken(scores).flatten().tolist() == [2, 0, 4]
    assert unet(**COLORS).token_readout.taken(scores).flatten().tolist() == [0, 0, 4]


def test_a_small_object_that_may_lie_here_or_there_keeps_its_pixels_where_they_are_likeliest() -> None:
    readout = unet(**{**COLORS, "tokenizer": {"colors": SHADES}}).token_readout
    shares = torch.full((64, 5), 1e-6)
    shares[:, 0] = 1.0
    shares[20:30, 4] = torch.linspace(0.3, 0.48, 10)  # 3.9 pixels, nowhere likelier than the ground
    shares[20:30, 0] -= shares[20:30, 4]
    taken = readout.taken(shares.log().view(1, 16, 4, 5)).flatten()
    assert taken.unique().tolist() == [0, 4]
    assert (taken == 4).nonzero().flatten().tolist() == [27, 28, 29]


def test_an_object_keeps_of_its_lost_pixels_as_large_a_share_as_the_ground_has_of_the_frame() -> None:
    readout = unet(**{**COLORS, "tokenizer": {"colors": SHADES}}).token_readout
    before = torch.zeros(1, 64, 1, dtype=torch.long)
    before[:, 10:20] = 4
    shares = torch.full((64, 5), 1e-6)
    shares[20:40, 4] = torch.linspace(0.1, 0.2, 20)  # 3 of its 10 pixels are expected
    shares[:, 0] = 1 - shares[:, 4]
    scores = shares.log().view(1, 1, 64, 5)
    kept = (readout.taken(scores, before) == 4).flatten().nonzero().flatten().tolist()
    assert kept == [*range(40 - len(kept), 40)] and 6 <= len(kept) <= 9  # the ground has 54 of 64
    assert (readout.taken(scores, torch.full_like(before, -1)) == 4).sum() <= 3  # no frame is before


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 20.0))
def test_a_colour_has_the_least_expected_distance_or_restores_one_that_would_be_lost(seed, spread) -> None:
    readout = unet(**{**COLORS, "tokenizer": {"colors": SHADES}}).token_readout
    scores = spread * torch.randn(2, 10, 3, 5, generator=torch.Generator().manual_seed(seed))
    given = scores.softmax(-1).flatten(1, 2)
    for shares, taken in zip(given, readout.taken(scores).flatten(1), strict=True):
        unsure = shares.amax(-1) < SURE
        even = balanced(shares[unsure])
        assert torch.allclose(even.sum(-1), torch.ones(int(unsure.sum())), atol=1e-5)
        assert torch.allclose(even.sum(0), shares[unsure].sum(0), atol=1.5)
        medians = (shares @ readout.distances).argmin(-1) == taken
        medians[unsure] |= (even @ readout.distances).argmin(-1) == taken[unsure]
        assert medians.all()


def test_a_graph_of_fixed_sizes_takes_the_same_colours(monkeypatch) -> None:
    readout = unet(**{**COLORS, "tokenizer": {"colors": SHADES}}).token_readout
    scores = 4 * torch.randn(2, 3, 10, 3, 5, generator=torch.Generator().manual_seed(0))
    taken = readout.taken(scores)
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    assert torch.equal(readout.taken(scores), taken)


def test_colours_that_are_not_those_of_the_tokens_are_refused() -> None:
    with pytest.raises(TokenizerError, match="has 2 colours, but digits of 5 values"):
        unet(**{**COLORS, "tokenizer": {"colors": "ffffff000000"}})


def test_of_tokens_that_stay_as_they_were_a_few_stand_for_all(monkeypatch) -> None:
    model = unet(**{**COLORS, "grid": (16, 16), "tokenizer": {"colors": SHADES}}).train()
    batch = small_batch(model.config, ["arm", "hand.v1"])
    batch.tokens = stored(model, 2, 1).expand(2, model.config.frames, -1, -1).clone()
    batch.tokens[:, 2:, 3, 4] = (batch.tokens[:, 2:, 3, 4] + 1) % model.config.vocab_size
    scored: list[int] = []
    loss = model.token_readout.loss
    monkeypatch.setattr(
        model.token_readout, "loss", lambda *given: (scored.append(len(given[0])), loss(*given))[1]
    )

    def passed(seed: int) -> tuple[Tensor, Tensor, Tensor]:
        model.zero_grad()
        output = model(batch, generator=torch.Generator().manual_seed(seed))
        output.loss.backward()
        assert model.token_readout.linear.bias.grad is not None
        return output.loss.detach(), output.per_sample, model.token_readout.linear.bias.grad.clone()

    drawn = [torch.stack(values) for values in zip(*map(passed, range(300)), strict=True)]
    assert max(scored) < 0.2 * 2 * 3 * 256
    monkeypatch.setattr(objectives, "FLAT", 1)
    every = passed(0)
    assert scored[-1] == 2 * 3 * 256
    for values, whole in zip(drawn, every, strict=True):
        error = values.std(0) / 300**0.5
        assert ((values.mean(0) - whole).abs() < 5 * error + 1e-6).all() and (
            error < 0.1 * whole.abs().max()
        ).all()


CROP: dict[str, Any] = {"levels": (8,), "crop": 5}


@pytest.mark.parametrize("base", [{**PIXELS, "grid": (32, 32)}, {**COLORS, "grid": (8, 8)}])
@pytest.mark.parametrize("views", [1, 2])
def test_a_square_shows_what_the_frame_shows_there(base: dict[str, Any], views: int) -> None:
    model = unet(**{**base, **CROP, "views": views})
    batch = small_batch(model.config, ["arm", "hand.v1"])
    true = stored(model, 2, model.config.frames)
    name = "tokens" if model.config.kind == "discrete" else "latents"
    batch.tokens, batch.latents = None, None
    setattr(batch, name, true)
    cut = cropped(model.config, batch, torch.Generator().manual_seed(0))
    assert cut.places is not None and cut.places.shape == (2, 25)
    whole, part = model.frame_values(true), model.frame_values(getattr(cut, name), cut.places)
    for sample in range(2):
        for view in range(views):
            expected = whole[sample, :, cut.places[sample] + 64 * view]
            assert torch.equal(part[sample, :, 25 * view : 25 * (view + 1)], expected)


def test_inside_a_square_the_network_computes_what_it_would_of_the_frame() -> None:
    model = unet(**{**COLORS, "levels": (8,), "crop": 10, "grid": (16, 16)})  # it reaches three places far
    batch = small_batch(model.config, ["arm"])
    batch.tokens = stored(model, 1, 4)
    cut = cropped(model.config, batch, torch.Generator().manual_seed(2))
    assert cut.tokens is not None and cut.places is not None
    under, order = Conditioning(torch.randn(1, 4, 16)), [-1, 0, 1, 2]
    features = []
    for tokens, places in ((batch.tokens, None), (cut.tokens, cut.places)):
        times = model.time_positions(4)
        times.places = places
        values = model.frame_values(tokens, places)
        features.append(model.trunk(model.embed(values, None, order), under, times))
    inner = torch.arange(100).view(10, 10)[3:-3, 3:-3].flatten()
    torch.testing.assert_close(features[1][:, :, inner], features[0][:, :, cut.places[0, inner]])


def test_squares_lie_where_something_moves_and_have_no_loss_at_their_cut_edges() -> None:
    model = unet(**{**COLORS, "crop": 8, "grid": (32, 32)})
    batch = small_batch(model.config, ["arm"] * 200)
    still = stored(model, 1, 1).expand(200, model.config.frames, -1, -1).clone()
    still[:, 2, 20, 11] = (still[:, 2, 20, 11] + 1) % model.config.vocab_size
    batch.tokens = still
    places = cropped(model.config, batch, torch.Generator().manual_seed(0)).places
    assert places is not None
    hit = (places == 20 * 32 + 11).any(1)
    assert 0.8 < hit.float().mean() < 0.95  # the others lie anywhere
    loses = surrounded(model.config, places).view(-1, 8, 8)
    assert loses[hit].flatten(1).float().mean() == 0.25  # four of eight rows and columns
    corner = surrounded(model.config, (torch.arange(8).view(-1, 1) * 32 + torch.arange(8)).view(1, -1))
    assert torch.equal(corner.view(8, 8), (torch.arange(8) < 6).view(-1, 1) & (torch.arange(8) < 6))


def test_a_model_is_trained_on_squares() -> None:
    model = unet(**{**COLORS, "crop": 6}).train()
    batch = small_batch(model.config, ["arm", "hand.v1"])
    batch.tokens = stored(model, 2, model.config.frames)
    cut = cropped(model.config, batch, torch.Generator().manual_seed(0))
    seen = forwarded(model, cut, 1.0, 2, torch.Generator().manual_seed(0))
    assert seen.context is not None and seen.context.shape == cut.tokens.shape  # type: ignore[union-attr]
    output = model(seen, generator=torch.Generator().manual_seed(0))
    output.loss.backward()
    assert torch.isfinite(output.loss) and output.masked.shape == (2, model.config.frames, 6, 6)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"grid": (32, 32), "crop": 7}, "crop"),
        ({"grid": (32, 32), "crop": 4}, "crop"),  # no token of such a square would have a loss
        ({"grid": (32, 32), "crop": 10}, "crop"),
        ({"grid": (32, 32), "crop": -6}, "crop"),
        ({"grid": (32, 32), "crop": 6, "whole_share": 0.5}, "crop"),
        ({"grid": (32, 32), "crop": 6, "objectives": {"full": 1.0}}, "crop"),
        ({"grid": (32, 32), "crop": 6, "trunk": "transformer"}, "crop"),
        ({"grid": (32, 32), "crop": 6, "video_loss": "diffusion"}, "crop"),
        ({"levels": (8, 16, 32, 64)}, "levels"),
        ({"shared_modulation": False}, "shared_modulation"),
        ({"conditioning": ("concat",)}, "conditioning"),
        ({"layout": "released"}, "layout"),
        ({"copy_previous": False}, "copy_previous"),
        ({"motion_weight": -1.0}, "motion_weight"),
    ],
)
def test_a_configuration_that_does_not_fit_is_refused(changes: dict[str, Any], named: str) -> None:
    with pytest.raises(RecipeError, match=f"model.{named}"):
        HMAConfig(**{**PIXELS, **changes})


def test_times_have_no_future() -> None:
    model = unet()
    x, actions = torch.randn(1, 4, 16, 16), torch.randn(1, 4, 16)
    times: TimePositions = model.time_positions(4)
    before = model.trunk(x, Conditioning(actions), times)
    x[:, 3], actions[:, 3] = 9.0, 9.0
    after = model.trunk(x, Conditioning(actions), times)
    torch.testing.assert_close(before[:, :3], after[:, :3])
    assert not torch.allclose(before[:, 3], after[:, 3])
