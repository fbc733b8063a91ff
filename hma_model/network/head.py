"""Read the trunk's features out as video tokens, patches of latents and action chunks.

B batch, T frames, S tokens of a frame, D width, F digits, V values of a digit, K = stride * action dim,
M rows, C values of a sample, W width of the diffusion head.
"""

import math
from collections.abc import Callable
from functools import cache, partial
from itertools import accumulate
from operator import mul

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hma_model.config import ActionSpace, HMAConfig, Readout
from hma_model.network.colors import chosen, color_distances
from hma_model.network.copying import CopyGain, Copying, PatchCopy
from hma_model.network.cross_entropy import cross_entropy, has_kernel
from hma_model.network.draws import Generators, randn, uniform
from hma_model.network.linear import Linear
from hma_model.network.trunks.contract import rows_at

ABSOLUTE_SHARE = 0.2  # of the absolute error beside the squared one: edges stay sharper
MOTION_SLOPE = 3.0  # a change of a third of a unit has most of the weight of motion
_LEVEL_VALUES = 256  # sinusoids that describe a noise level
TRAINING_LEVELS = 1000  # of noise
CLIP = 10.0  # a step's estimate of the clean sample is clipped to ± this

# Chooses from the scores (B, f, k, V) of f digits, from the given one on, these digits (B, f, k).
type Choose = Callable[[Tensor, int], Tensor]


def scaled(features: Tensor, multiplier: float) -> Tensor:
    """Return features times a number, without an operation if it is 1."""
    return features if multiplier == 1 else features * multiplier


class DigitChain(nn.Module):
    """The gain of a digit's scores from the digits before it: an MLP of features and embedded digits.

    The output begins at zero, so it can be added to a trained readout.
    """

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        width, digits = config.width, config.digits
        self.multiplier = config.readout_scale
        self.input = Linear(width, width, bias=False)
        nn.init.normal_(self.input.weight, std=width**-0.5)
        self.place = nn.Parameter(torch.randn(len(digits), width) * 0.5)
        self.digits = nn.ParameterList(torch.randn(values, width) * 0.5 for values in digits[:-1])
        self.output = nn.ParameterList(torch.zeros(values, width) for values in digits)

    def decide(self, features: Tensor, alone: Tensor, choose: Choose) -> Tensor:
        """Choose as `TokenReadout.decide`, from the scores `alone` (B, k, sum of V) and what they gain."""
        # The sum includes the place of the digit at hand; so each digit adds the step to the next place too.
        steps = self.place.diff(dim=0).unbind()
        tables, weights = [table + step for table, step in zip(self.digits, steps)], list(self.output)
        parts = alone.unsqueeze(1).split([len(weight) for weight in weights], dim=-1)
        so_far = (self.input(features) + self.place[0]).unsqueeze(1)
        digits: list[Tensor] = []
        for index, (part, weight) in enumerate(zip(parts, weights)):
            if index:
                so_far = so_far + F.embedding(digits[-1], tables[index - 1])
            digits.append(choose(part + F.linear(self._hidden(so_far), weight), index))
        return torch.cat(digits, dim=1)

    def forward(self, features: Tensor, digits: Tensor) -> Tensor:
        """Return the gains (..., sum of V) of all digits, given the true digits (..., F) before each."""
        table = torch.cat([self.input.weight.new_zeros(0, self.input.out_features), *self.digits])
        starts = torch.tensor([0, *accumulate(len(weight) for weight in self.digits)][:-1])
        embedded = F.embedding(digits[..., :-1] + starts[: len(self.digits)].to(digits.device), table)
        before = accumulate([self.input(features), *embedded.unbind(-2)], torch.add)
        hidden = self._hidden(torch.stack(list(before), dim=-2) + self.place)
        if len({len(weight) for weight in self.output}) > 1:
            return torch.cat([F.linear(x, w) for x, w in zip(hidden.unbind(-2), self.output)], dim=-1)
        return torch.einsum("...fd,fvd->...fv", hidden, torch.stack(list(self.output))).flatten(-2)

    def _hidden(self, so_far: Tensor) -> Tensor:
        return scaled(F.gelu(so_far), self.multiplier)


class TokenReadout(nn.Module):
    """The readout of the discrete model: scores of every digit's values, and their cross-entropy.

    With `digit_order == "chain"`, a digit's scores also depend on the digits before it; with `copy_previous`,
    the scores of what the frame before has at the same place gain.
    """

    worth: Tensor
    distances: Tensor | None  # (V, V) between the colours of a palette

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        self.factored, self.smoothing = config.digits, config.label_smoothing
        self.multiplier = config.readout_scale
        self.linear = Linear(config.width, sum(config.digits))
        worth = torch.tensor([1, *accumulate(config.digits[:-1], mul)])
        self.register_buffer("worth", worth, persistent=False)  # on the device, where code is compiled
        self.register_buffer("distances", color_distances(config), persistent=False)
        nn.init.normal_(self.linear.weight, std=0.02)
        nn.init.zeros_(self.linear.bias)
        self.chain = DigitChain(config) if config.digit_order == "chain" else None
        self.copy = CopyGain(config) if config.copy_previous else None

    def forward(self, features: Tensor, digits: Tensor | None = None, before: Tensor | None = None) -> Tensor:
        """Map features (..., D) to scores (..., sum of V) float32, digit after digit, low digit first.

        Args:
            digits: (..., F) those that a chain's later digits are given; by default the likeliest.
            before: (..., F) those of the frame before, or -1; by default no frame is before.
        """
        if self.chain is None or digits is not None:
            scores, given = self._alone(features), None
            if self.chain is not None and digits is not None:
                scores, given = scores + self.chain(features, digits).float(), digits
            if self.copy is None or before is None:
                return scores
            return self.copy(scores, features, given, before)
        made: list[Tensor] = []

        def likeliest(scores: Tensor, first: int) -> Tensor:
            made.append(scores)
            return self.taken(scores)

        before = None if before is None else before.flatten(0, -2).unsqueeze(0)
        self.decide(features.flatten(0, -2).unsqueeze(0), likeliest, before)
        return torch.cat(made, dim=-1).view(*features.shape[:-1], -1)

    def decide(self, features: Tensor, choose: Choose, before: Tensor | None = None) -> Tensor:
        """Return the digits (B, F, k) chosen for features (B, k, D): at once, or in a chain one by one.

        `before` (B, k, F) are those of the frame before, or -1; by default no frame is before.
        """
        if self.copy is not None and before is not None:
            choose = partial(Copying(self.copy, features, before).chosen, choose)
        alone = self._alone(features)
        if self.chain is None:
            return choose(self.split(alone).transpose(1, 2), 0)
        return self.chain.decide(features, alone, choose)

    def _alone(self, features: Tensor) -> Tensor:
        return self.linear(scaled(features, self.multiplier)).float()

    def taken(self, scores: Tensor, before: Tensor | None = None) -> Tensor:
        """Return the values (..., F, k) of a frame's scores (..., F, k, V): the likeliest, or its colours.

        `before` (..., k, F) are those of the frame before, or -1; by default no frame is before.
        """
        if self.distances is None:
            return scores.argmax(-1)
        before = None if before is None else before.flatten(-2)
        return chosen(scores.softmax(-1).flatten(-3, -2), self.distances, before).view(scores.shape[:-1])

    def ids(self, digits: Tensor) -> Tensor:
        """Return the ids (...) of digits (..., F)."""
        return (digits * self.worth).sum(-1)

    def split(self, scores: Tensor) -> Tensor:
        """Split scores (..., sum of V) into (..., F, max V); pad shorter digits with the lowest number."""
        widest = max(self.factored)
        if min(self.factored) == widest:
            return scores.unflatten(-1, (-1, widest))
        lowest = torch.finfo(scores.dtype).min
        parts = scores.split(list(self.factored), dim=-1)
        padded = [F.pad(part, (0, widest - part.shape[-1]), value=lowest) for part in parts]
        return torch.stack(padded, dim=-2)

    def loss(self, features: Tensor, digits: Tensor, before: Tensor | None = None) -> Tensor:
        """Return the cross-entropy (M,), summed over digits, of features (M, D) and digits (M, F).

        `before` (M, F) are the digits of the frame before, or -1.
        """
        if len(set(self.factored)) == 1:
            if self.chain is None and not self.smoothing and has_kernel(self.linear, features):
                return self._kernel_loss(features, digits, before)
            scores = self.split(self(features, digits, before)).flatten(0, 1)
            losses = F.cross_entropy(
                scores, digits.flatten(), reduction="none", label_smoothing=self.smoothing
            )
            return losses.view(digits.shape).sum(1)
        parts = self(features, digits, before).split(list(self.factored), dim=-1)
        each = [
            F.cross_entropy(part, digits[:, i], reduction="none", label_smoothing=self.smoothing)
            for i, part in enumerate(parts)
        ]
        return torch.stack(each).sum(0)

    def thins(self, features: Tensor) -> bool:
        """Check whether the loss of tokens is a matter of cost: colours, scored on a CPU."""
        return self.distances is not None and has_kernel(self.linear, features)

    def _kernel_loss(self, features: Tensor, digits: Tensor, before: Tensor | None) -> Tensor:
        gains = None
        if self.copy is not None and before is not None:
            gains, before = self.copy.gains(features, before)[..., 0], before.clamp(min=0)
        return cross_entropy(scaled(features, self.multiplier), self.linear, gains, before, digits)


class LatentReadout(nn.Module):
    """The readout of the continuous model: conditions for the diffusion head, and the head itself.

    With `copy_previous` the head draws only what a patch has more than it keeps of the frame before.
    """

    draws = True

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        self.proj = Linear(config.width, config.width)
        self.norm = nn.LayerNorm(config.width, eps=1e-6)
        times = config.frames if config.released else 1
        self.position = nn.Parameter(torch.zeros(times, config.tokens_per_frame, config.width))
        self.diffusion = DiffusionHead(config, config.patch_dim)
        nn.init.normal_(self.proj.weight, std=config.width**-0.5)
        nn.init.zeros_(self.proj.bias)
        self.copy = PatchCopy(config) if config.copy_previous else None

    def forward(self, features: Tensor, positions: Tensor, before: Tensor | None = None) -> Tensor:
        """Map features (B, T, S, D) of frames at the times (T,) to conditions (B, T, S, D).

        With `copy_previous`, what is kept of the patches `before` (B, T, S, C) follows: (B, T, S, D + C). By
        default nothing is.
        """
        conditions = self.norm(self.proj(features)) + rows_at(self.position, positions)
        if self.copy is None:
            return conditions
        if before is None:
            before = features.new_zeros(*features.shape[:-1], self.diffusion.values)
        return torch.cat([conditions, self.copy(features, before)], dim=-1)

    def loss(
        self,
        patches: Tensor,
        conditions: Tensor,
        generator: torch.Generator | None = None,
        before: Tensor | None = None,
    ) -> Tensor:
        """Return the diffusion head's loss (M,) float32 of patches (M, C) under conditions (M, …)."""
        conditions, kept = self._parts(conditions)
        return self.diffusion.loss(patches if kept is None else patches - kept, conditions, generator)

    def sample(
        self,
        conditions: Tensor,
        steps: int | None = None,
        temperature: float = 0.0,
        generator: Generators = None,
    ) -> Tensor:
        """Draw patches (M, C) float32 under conditions (M, …), as `DiffusionHead.sample`."""
        conditions, kept = self._parts(conditions)
        drawn = self.diffusion.sample(conditions, steps, temperature, generator)
        return drawn if kept is None else drawn + kept

    def _parts(self, conditions: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return the conditions (M, D) of the head, and what is kept (M, C)."""
        if self.copy is None:
            return conditions, None
        own, kept = conditions.split([self.diffusion.condition.in_features, self.diffusion.values], dim=-1)
        return own.to(self.position.dtype), kept.float()


class RegressionReadout(nn.Module):
    """The readout of a continuous model that predicts each value's change since the frame before.

    It draws nothing. Pixels are rounded to whole numbers as they are stored, so that what does not move stays
    exactly what it was, for any number of frames.
    """

    draws = False  # so how sure it is cannot be measured

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        self.width, self.channels, self.motion = config.width, config.channels, config.motion_weight
        self.scale = config.latent_scale if config.pixels else 0.0
        self.unit = 0.5 if config.pixels else 1.0  # so that errors of pixels are as large as those of latents
        self.proj = Linear(config.width, config.patch_dim)
        nn.init.zeros_(self.proj.weight)
        nn.init.zeros_(self.proj.bias)

    def forward(self, features: Tensor, positions: Tensor, before: Tensor | None = None) -> Tensor:
        """Return features (B, T, S, D), followed by the patches `before` (B, T, S, C)."""
        assert before is not None  # `HMAConfig` wants `copy_previous`
        return torch.cat([features.float(), before.float()], dim=-1)

    def loss(
        self,
        patches: Tensor,
        conditions: Tensor,
        generator: torch.Generator | None = None,
        before: Tensor | None = None,
    ) -> Tensor:
        """Return the weighted error (M,) float32 of patches (M, C) under conditions (M, D + C).

        `before` (M, C) are the true patches of the frame before: what differs from them moves.
        """
        error = (self._predict(conditions) - patches.float()) / self.unit
        errors = error.square() + ABSOLUTE_SHARE * error.abs()
        if before is not None and self.motion:
            change = ((patches - before).float() / self.unit).unflatten(-1, (self.channels, -1))
            moves = torch.tanh(MOTION_SLOPE * change.abs().amax(-2, keepdim=True))
            errors = errors * (1 + self.motion * moves).expand_as(change).flatten(-2)
        return errors.mean(-1)

    @torch.no_grad()
    def sample(
        self,
        conditions: Tensor,
        steps: int | None = None,
        temperature: float = 0.0,
        generator: Generators = None,
    ) -> Tensor:
        """Return the predicted patches (M, C) float32 under conditions (M, D + C)."""
        made = self._predict(conditions)
        if self.scale:
            return (made / self.scale).round().clamp(0, 255) * self.scale
        return made

    def _predict(self, conditions: Tensor) -> Tensor:
        features, before = conditions.split([self.width, self.proj.out_features], dim=-1)
        return before + self.unit * self.proj(features.to(self.proj.weight.dtype)).float()


class ActionHead(nn.Module):
    """The head that predicts action chunks of one embodiment from a frame's pooled features.

    `policy` predicts the chunk to command from the frame on; `inverse` predicts the chunk that led to it.
    """

    def __init__(self, config: HMAConfig, space: ActionSpace) -> None:
        super().__init__()
        self.diffusion: DiffusionHead | None = None
        outputs = space.chunk_dim
        if config.action_loss == "diffusion":
            self.diffusion = DiffusionHead(config, space.chunk_dim)
            outputs = config.width
        self.multiplier = config.readout_scale
        self.policy = Linear(config.width, outputs)
        self.inverse = Linear(config.width, outputs)
        for linear in (self.policy, self.inverse):
            nn.init.normal_(linear.weight, std=config.width**-0.5 if self.diffusion else 0.02)
            nn.init.zeros_(linear.bias)

    def forward(self, features: Tensor, readout: Readout) -> Tensor:
        """Map features (M, D) to chunks (M, K), or to the conditions (M, D) of a diffusion head."""
        linear: nn.Linear = getattr(self, readout.name)
        return linear(scaled(features, self.multiplier))

    def loss(
        self, features: Tensor, target: Tensor, readout: Readout, generator: torch.Generator | None = None
    ) -> Tensor:
        """Return the loss (M,) float32 of features (M, D) and target chunks (M, K)."""
        predicted = self(features, readout)
        if self.diffusion is not None:
            return self.diffusion.loss(target, predicted, generator)
        return F.mse_loss(predicted.float(), target.float(), reduction="none").mean(-1)

    def predict(self, features: Tensor, readout: Readout, generator: Generators = None) -> Tensor:
        """Predict chunks (M, K) float32 from features (M, D)."""
        predicted = self(features, readout)
        if self.diffusion is not None:
            return self.diffusion.sample(predicted, generator=generator)
        return predicted.float()


def cosine_levels(steps: int) -> Tensor:
    """Return (steps,) float64, the signal's share of variance at each noise level, alpha-bar (2102.09672)."""
    time = torch.arange(steps + 1, dtype=torch.float64, device="cpu") / steps
    share = ((time + 0.008) / 1.008 * math.pi / 2).cos() ** 2
    noise = (1 - share[1:] / share[:-1]).clamp(max=0.999)
    return (1 - noise).cumprod(0)


@cache
def sampling_levels(total: int, count: int) -> tuple[int, ...]:
    """Return the noise levels of so many sampling steps, out of `total` levels, the noisiest first."""
    return tuple(torch.linspace(total - 1, 0, count).round().long().tolist())


class _Block(nn.Module):
    """A residual MLP whose input is shifted and scaled, and whose output is gated."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width, eps=1e-6)
        self.fc1 = Linear(width, width)
        self.fc2 = Linear(width, width)
        self.modulation = Linear(width, 3 * width)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        shift, scale, gate = self.modulation(condition).chunk(3, dim=-1)
        hidden = torch.addcmul(shift, self.norm(x), 1 + scale)
        return x + gate * self.fc2(F.silu(self.fc1(hidden)))


class DiffusionHead(nn.Module):
    """A predictor of samples of `values` numbers by diffusion conditioned on the features.

    A small MLP, modulated by the noise level and the condition, predicts the noise (paper section 3, with the
    layers of arXiv 2406.11838) or the velocity (arXiv 2202.00512), which determines the sample even at full
    noise. Training draws a level of a cosine schedule; sampling is DDIM with any number of steps (arXiv
    2010.02502).
    """

    levels: Tensor

    def __init__(self, config: HMAConfig, values: int) -> None:
        super().__init__()
        width = config.diffusion_width
        self.values = values
        self.velocity = config.diffusion_target == "velocity"
        self.sample_steps = config.diffusion_sample_steps
        self.input = Linear(values, width)
        self.condition = Linear(config.width, width)
        self.level_in = Linear(_LEVEL_VALUES, width)
        self.level_out = Linear(width, width)
        self.blocks = nn.ModuleList(_Block(width) for _ in range(config.diffusion_depth))
        self.modulation = Linear(width, 2 * width)
        self.output = Linear(width, values * (2 if config.diffusion_variance else 1))
        # as a list too, so that sampling does not wait for a GPU
        self.alpha_bars: list[float] = cosine_levels(TRAINING_LEVELS).float().tolist()
        self.register_buffer("levels", torch.tensor(self.alpha_bars), persistent=False)
        for name, module in self.named_modules():
            if isinstance(module, nn.Linear):
                nn.init.xavier_uniform_(module.weight)
                nn.init.zeros_(module.bias)
                if name.endswith(("modulation", "output")):  # so each block starts as the identity
                    nn.init.zeros_(module.weight)

    def forward(self, noisy: Tensor, level: Tensor, condition: Tensor) -> Tensor:
        """Predict the target (M, C) float32 from samples (M, C), levels (M,) int64 and conditions (M, D)."""
        return self._predict(noisy, self._level(level), self.condition(condition))

    def loss(self, target: Tensor, condition: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return the squared error (M,) float32 of the prediction for samples (M, C), conditions (M, D)."""
        target = target.float()
        draw = uniform((len(target),), generator, target.device)
        level = (draw * len(self.levels)).long().clamp(max=len(self.levels) - 1)
        noise = randn(target.shape, generator, target.device)
        alpha_bar = self.levels.float()[level].unsqueeze(-1)
        signal, spread = alpha_bar.sqrt(), (1 - alpha_bar).sqrt()
        predicted = self(signal * target + spread * noise, level, condition)
        goal = signal * noise - spread * target if self.velocity else noise
        return F.mse_loss(predicted, goal, reduction="none").mean(-1)

    @torch.no_grad()
    def sample(
        self,
        condition: Tensor,
        steps: int | None = None,
        temperature: float = 0.0,
        generator: Generators = None,
    ) -> Tensor:
        """Draw samples by DDIM.

        Args:
            condition: (M, D).
            steps: evaluations of the network, by default the configuration's, at most its training steps.
            temperature: share of fresh noise in a step; 0 is deterministic given the first noise.
            generator: of the first noise and the fresh noise.

        Returns:
            (M, C) float32.
        """
        total = len(self.alpha_bars)
        count = min(steps or self.sample_steps, total)
        levels = sampling_levels(total, count)
        alpha_bars = [*(self.alpha_bars[level] for level in levels), 1.0]
        embedded_levels = self._level(torch.tensor(levels, device=condition.device))
        embedded = self.condition(condition)
        x = randn((len(condition), self.values), generator, condition.device)
        for index in range(count):
            predicted = self._predict(x, embedded_levels[index], embedded)
            x = self._step(x, predicted, alpha_bars[index], alpha_bars[index + 1], temperature, generator)
        return x

    def _step(
        self,
        x: Tensor,
        predicted: Tensor,
        alpha_bar: float,
        after: float,
        eta: float,
        generator: Generators,
    ) -> Tensor:
        """Make one DDIM step from a level of signal share `alpha_bar` to one where it is `after`."""
        signal, spread = math.sqrt(alpha_bar), math.sqrt(1 - alpha_bar)
        clean = signal * x - spread * predicted if self.velocity else (x - spread * predicted) / signal
        clean = clean.clamp(-CLIP, CLIP)
        if after == 1.0:
            return clean
        noise = (x - signal * clean) / spread  # consistent with the clipped estimate
        fresh = eta * math.sqrt((1 - after) / (1 - alpha_bar) * (1 - alpha_bar / after))
        x = math.sqrt(after) * clean + math.sqrt(1 - after - fresh**2) * noise
        return x + fresh * randn(x.shape, generator, x.device) if fresh else x

    def _predict(self, noisy: Tensor, level: Tensor, condition: Tensor) -> Tensor:
        condition = F.silu(level + condition)
        x = self.input(noisy.to(self.input.weight.dtype))
        for block in self.blocks:
            x = block(x, condition)
        shift, scale = self.modulation(condition).chunk(2, dim=-1)
        x = torch.addcmul(shift, F.layer_norm(x, x.shape[-1:], eps=1e-6), 1 + scale)
        return self.output(x)[..., : self.values].float()

    def _level(self, level: Tensor) -> Tensor:
        """Embed noise levels (M,) as (M, W)."""
        half = _LEVEL_VALUES // 2
        rates = torch.exp(torch.arange(half, device=level.device) * (-math.log(10000) / half))
        angles = level.float().unsqueeze(-1) * rates
        waves = torch.cat([angles.cos(), angles.sin()], dim=-1).to(self.level_in.weight.dtype)
        return self.level_out(F.silu(self.level_in(waves)))
