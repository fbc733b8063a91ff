"""Define the network's configuration, the training objectives and the action space of each embodiment.

`HMAConfig` describes everything that the embodiments share. `ActionSpace` describes one embodiment as far as
the network depends on it. Both are validated when made. `HMAConfig` converts to JSON and back without loss.

`OBJECTIVES` states what each objective predicts, from what, and what it hides (paper section 3). forward:
predict masked video from past video and actions. passive: the same without actions. policy: predict the
chunk to command from each frame on. inverse: predict the chunk that led from one frame to the next. full:
video and policy together. A new objective is a row of the table; all other code asks a row's attributes.
This module is free of torch; `hma_model.network.objectives` computes the losses.
"""

import dataclasses
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from hma_data.errors import RecipeError, TokenizerError

if TYPE_CHECKING:
    from hma_data.registry.embodiment import Embodiment
    from hma_data.tokenizers.base import TokenizerSpec

CROP_EDGE = 2  # tokens from the cut edge of a square that have no loss, as they lack what lies beyond it
MOST_IDS = 2**62  # of the trunk's tokens: ids are int64


@dataclass(frozen=True)
class Readout:
    """A readout of action chunks from the frames.

    Attributes:
        name: the layer of `ActionHead` that reads.
        lag: chunk k is read from frame k + lag.
        deed: what a model does with it, in words.
    """

    name: str
    lag: int
    deed: str


@dataclass(frozen=True)
class Objective:
    """One training objective.

    Frames and chunks that are not hidden are inputs. Every objective corrupts the visible tokens in the same
    way (`HMAConfig.corrupt_max`), so corruption is no attribute.

    Attributes:
        name: its name in recipes, configurations and metrics.
        predicts_video: whether tokens of the frames after the first are hidden and predicted.
        sees_actions: whether the trunk is conditioned on the chunks that are not hidden.
        readout: the readout that predicts hidden chunks; None if no chunk is hidden or predicted.
    """

    name: str
    predicts_video: bool
    sees_actions: bool
    readout: Readout | None


POLICY = Readout("policy", lag=0, deed="act")  # the chunk to command from the frame on
INVERSE = Readout("inverse", lag=1, deed="infer actions")  # the chunk that led to the frame
READOUTS: Mapping[str, Readout] = {readout.name: readout for readout in (POLICY, INVERSE)}

OBJECTIVES: Mapping[str, Objective] = {
    objective.name: objective
    for objective in (
        Objective("forward", predicts_video=True, sees_actions=True, readout=None),
        Objective("passive", predicts_video=True, sees_actions=False, readout=None),
        Objective("policy", predicts_video=False, sees_actions=True, readout=POLICY),
        Objective("full", predicts_video=True, sees_actions=True, readout=POLICY),
        Objective("inverse", predicts_video=False, sees_actions=True, readout=INVERSE),
    )
}

CONDITIONINGS = ("modulation", "concat", "add", "cross_attention")
_CHOICES = {
    "kind": ("discrete", "continuous"),
    "trunk": ("transformer", "unet"),
    "video_loss": ("diffusion", "regression"),
    "training_pass": ("window", "pairs"),
    "masked_input": ("learned", "previous"),
    "digit_order": ("together", "chain"),
    "position_init": ("random", "sinusoid"),
    "layout": ("ours", "released"),
    "action_alignment": ("previous", "current"),
    "absent_action": ("embedding", "skip", "tokens"),
    "action_loss": ("mse", "diffusion"),
    "diffusion_target": ("noise", "velocity"),
}
_AT_LEAST_ONE = (
    *("layers", "width", "heads", "mlp_ratio", "frames", "channels", "patch", "action_tokens", "base_width"),
    *("merge", "diffusion_depth", "diffusion_width", "diffusion_sample_steps", "views"),
)
_SHARES = ("label_smoothing", "corrupt_max", "history_probability", "whole_share")


@dataclass(frozen=True, kw_only=True)
class HMAConfig:
    """The network's architecture, objectives and mask schedule (paper section 3).

    Raises:
        RecipeError: a value is not allowed; it names the field, the value and the allowed values.
    """

    kind: str = "discrete"  # discrete: VQ tokens, cross-entropy; continuous: latents, diffusion head
    trunk: str = "transformer"  # see `hma_model.network.trunks`
    layers: int = 32  # blocks; U-Net: blocks at each resolution, down and up
    width: int = 256  # values per token
    levels: tuple[int, ...] = (48, 96, 192)  # U-Net: channels at each resolution, the finest first
    heads: int = 8  # attention heads
    mlp_ratio: float = 4.0  # hidden width of the MLP, in widths
    frames: int = 12  # T, the window; in a longer rollout, temporal attention sees this many frames
    grid: tuple[int, int] = (16, 16)  # the tokenizer's (h, w); a continuous model's tokens are patches of it
    views: int = 1  # cameras in a frame, stacked along the height: a frame has views · h rows of tokens

    factored: tuple[int, ...] = (512, 512)  # discrete: values a digit, low digit first
    merge: int = 1  # discrete: the side of a square of stored tokens that becomes one token of the trunk
    channels: int = 4  # continuous: the latents' channels
    patch: int = 2  # continuous: the side of a square of latents that becomes one token of the trunk
    latent_scale: float = 1.0  # continuous: the factor by which stored latents are multiplied

    conditioning: tuple[str, ...] = ("modulation",)  # any of modulation, concat, add, cross_attention
    shared_modulation: bool = False  # False: modulation weights per embodiment (paper); True: in the trunk
    action_tokens: int = 1  # copies of the action embedding appended to a frame's tokens (concat)
    # What conditions a pass without actions. "embedding": a learned embedding for each action; "skip":
    # nothing (released); "tokens": only learned action tokens (released, if actions are predicted too).
    # If only some chunks are hidden, "tokens" hides them in the action tokens, but modulation still sees
    # them (released).
    absent_action: str = "embedding"
    # Octaves of sines and cosines of each action value, added to the stem's input for higher resolution. The
    # longest wave is 8 standard deviations of the value.
    action_waves: int = 0
    action_alignment: str = "previous"  # chunk k conditions frame k+1; "current": frame k (released)

    # "released": learned absolute times, so no rollout is longer than the window; no norm before temporal
    # attention or after the last block; a projection per embodiment after the modulated norm; unnormalized
    # action targets
    layout: str = "ours"
    qkv_bias: bool = False  # biases of queries, keys and values
    mlp_bias: bool = True  # biases of the MLP
    qk_norm: bool = False  # normalize queries and keys, not the inputs of spatial attention and MLP
    mup: bool = False  # attention scale 8 / head_dim, and a readout scaled down as the width grows
    base_width: int = 256  # the width at which muP's multipliers are one

    # How often each objective is drawn.
    objectives: Mapping[str, float] = field(default_factory=lambda: {"forward": 1.0})
    action_loss: str = "mse"
    label_smoothing: float = 0.01  # of the cross-entropy of digits
    # Each sample's corruption is drawn from U(0, corrupt_max): the share of digits replaced at random.
    corrupt_max: float = 0.2
    # continuous: noise on visible frames; its standard deviation is latent_noise × corruption
    latent_noise: float = 0.0
    told_noise: bool = False  # the network is told each frame's corruption; 0 after training
    # Share of samples of which several first frames stay unmasked; later frames are corrupted more.
    history_probability: float = 0.2
    # The frames of a training pass that predicts video. "window": the window's frames, masked (paper).
    # "pairs": the recorded frames, and a masked copy of each but the first, which attends to those before.
    training_pass: str = "window"
    whole_share: float = 0.5  # pairs: the share of fully masked copies
    crop: int = 0  # U-Net: train on squares of frames of this side, in tokens; 0: on whole frames
    # The input embedding of a masked token. "learned": one vector (paper). "previous": that vector plus the
    # embedding of the same position in the previous frame.
    masked_input: str = "learned"
    position_init: str = "random"  # initial embeddings of positions in a frame; "sinusoid": 2-D sinusoids
    # discrete: how a token's digits are predicted. "together": independently of one another (paper).
    # "chain": autoregressively, the low digit first.
    digit_order: str = "together"
    # Predict for each digit the probability that it keeps the previous frame's value; for latents, the kept
    # share of each value.
    copy_previous: bool = False

    # Continuous. "diffusion": the diffusion head; "regression": squared and absolute error of the change
    # since the previous frame, in which moving values weigh up to 1 + motion_weight
    video_loss: str = "diffusion"
    motion_weight: float = 6.0  # see video_loss
    diffusion_target: str = "velocity"  # what the head predicts; in the paper "noise"
    diffusion_depth: int = 3  # layers of the head
    diffusion_width: int = 1024  # width of the head
    diffusion_sample_steps: int = 4  # DDIM steps; the paper uses 100 with the target "noise"
    diffusion_variance: bool = False  # the head has variance outputs, which DDIM ignores (released)

    tokenizer: Mapping[str, Any] = field(default_factory=dict)  # the tokenizer's spec, kept for checkpoints

    def __post_init__(self) -> None:
        if isinstance(self.conditioning, str):
            object.__setattr__(self, "conditioning", self.conditioning.split("+"))
        for name in ("grid", "factored", "conditioning", "levels"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for name in ("objectives", "tokenizer"):
            object.__setattr__(self, name, dict(getattr(self, name)))
        for name, kept, allowed in _rules(self):
            if not kept:
                fault = f"{getattr(self, name)!r} is not allowed"
                raise RecipeError(f"model.{name}", fault, f"give {allowed}")
        if colors := self.tokenizer.get("colors"):
            _require_colors(colors, self.digits)

    @property
    def released(self) -> bool:
        """Return whether the layout is that of the paper's released weights."""
        return self.layout == "released"

    @property
    def discrete(self) -> bool:
        """Return whether frames are VQ tokens; otherwise they are latents."""
        return self.kind == "discrete"

    @property
    def spec(self) -> "TokenizerSpec":
        """Return the spec of the tokenizer."""
        from hma_data.tokenizers.base import TokenizerSpec

        return TokenizerSpec.from_json(dict(self.tokenizer))

    @property
    def token_grid(self) -> tuple[int, int]:
        """Return (views · h, w), the grid of the tokens that the trunk sees in a frame."""
        side = self.merge if self.discrete else self.patch
        return self.views * self.grid[0] // side, self.grid[1] // side

    @property
    def frame_shape(self) -> tuple[int, ...]:
        """Return the shape of a frame: (views · h, w) of tokens, or (c, views · H, W) of latents."""
        grid = (self.views * self.grid[0], self.grid[1])
        return grid if self.discrete else (self.channels, *grid)

    @property
    def crop_shape(self) -> tuple[int, ...]:
        """Return the shape of a frame that is cut to a square of `crop` tokens, as `frame_shape`."""
        side = self.crop * (self.merge if self.discrete else self.patch)
        return (*self.frame_shape[:-2], self.views * side, side)

    @property
    def tokens_per_frame(self) -> int:
        """Return S, the number of tokens a frame, without action tokens."""
        return math.prod(self.token_grid)

    @property
    def appended_tokens(self) -> int:
        """Return the number of action tokens after the tokens of a frame, in a pass with actions."""
        return self.action_tokens if "concat" in self.conditioning else 0

    @property
    def absent_tokens(self) -> int:
        """Return the number of action tokens after the tokens of a frame, in a pass without any actions."""
        if self.absent_action == "embedding":
            return self.appended_tokens
        return self.action_tokens if self.absent_action == "tokens" else 0

    @property
    def trained(self) -> list[Objective]:
        """Return the objectives of the training."""
        return [OBJECTIVES[name] for name, weight in self.objectives.items() if weight]

    @property
    def predicts_video(self) -> bool:
        """Return whether an objective of the training predicts frames."""
        return any(objective.predicts_video for objective in self.trained)

    @property
    def sees_actions(self) -> bool:
        """Return whether an objective of the training sees actions."""
        return any(objective.sees_actions for objective in self.trained)

    @property
    def trained_readouts(self) -> tuple[Readout, ...]:
        """Return the readouts of actions that an objective of the training trains."""
        return tuple(objective.readout for objective in self.trained if objective.readout)

    @property
    def vocab_size(self) -> int:
        """Return the number of ids of a stored token; this number is also the id that means masked."""
        return math.prod(self.factored)

    @property
    def digits(self) -> tuple[int, ...]:
        """Return the values of each digit of a token of the trunk, which are merge² stored tokens."""
        return self.factored * self.merge**2

    @property
    def mask_id(self) -> int:
        """Return the number of ids of a token of the trunk, which is also the id that means masked."""
        return math.prod(self.digits)

    @property
    def whole_frames(self) -> bool:
        """Return whether training masks only whole frames, so that a frame is made in one pass."""
        return self.training_pass == "pairs" and self.whole_share == 1.0

    @property
    def pixels(self) -> bool:
        """Return whether latents are pixels, stored as whole numbers from 0 to 255."""
        return self.tokenizer.get("dtype") == "uint8"

    @property
    def patch_dim(self) -> int:
        """Return the number of values in one patch of latents."""
        return self.channels * self.patch**2

    @property
    def head_dim(self) -> int:
        """Return the width of one attention head."""
        return self.width // self.heads

    @property
    def attention_scale(self) -> float:
        """Return the factor of attention's products."""
        return 8 / self.head_dim if self.mup else self.head_dim**-0.5

    @property
    def readout_scale(self) -> float:
        """Return the factor of the features that are read out; muP scales them down as the width grows."""
        return self.base_width / self.width if self.mup else 1.0

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed, validated again."""
        return dataclasses.replace(self, **changes)

    def to_json(self) -> dict[str, Any]:
        """Return a dictionary that `json.dumps` accepts and `from_json` reads back; one view is left out."""
        return {
            f.name: list(value) if isinstance(value := getattr(self, f.name), tuple) else value
            for f in dataclasses.fields(self)
            if f.name != "views" or self.views > 1
        }

    @classmethod
    def from_json(cls, source: str | Mapping[str, Any], where: str = "model") -> Self:
        """Read the dictionary of `to_json`, or its text; a RecipeError names an unknown field."""
        values = json.loads(source) if isinstance(source, str) else dict(source)
        unknown = sorted(set(values) - {f.name for f in dataclasses.fields(cls)})
        if unknown:
            names = ", ".join(f.name for f in dataclasses.fields(cls))
            raise RecipeError(f"{where}.{unknown[0]}", "is not a field of the model", f"choose from {names}")
        return cls(**values)


def token_words(merge: int) -> str:
    """Return in words what a loss or an accuracy is of: a token, or the square of tokens taken as one."""
    return "token" if merge == 1 else f"square of {merge}×{merge} tokens"


def _rules(config: HMAConfig) -> Iterator[tuple[str, bool, str]]:
    """Yield a field, whether its value keeps a rule, and what is allowed; a rule relies on earlier ones."""
    for name, choices in _CHOICES.items():
        yield name, getattr(config, name) in choices, f"one of {', '.join(choices)}"
    for name in _AT_LEAST_ONE:
        yield name, getattr(config, name) >= 1, "a number of at least 1"
    for name in _SHARES:
        yield name, 0 <= getattr(config, name) <= 1, "a share from 0 to 1"
    for name in ("latent_noise", "motion_weight"):
        yield name, 0 <= getattr(config, name) < math.inf, "a number of at least 0"
    yield "latent_scale", 0 < config.latent_scale < math.inf, "a positive number"
    yield "action_waves", 0 <= config.action_waves <= 16, "a number from 0 to 16"

    grid, discrete = config.grid, config.discrete
    yield "grid", len(grid) == 2 and min(grid) >= 1, "(h, w), both at least 1"
    fits = bool(config.factored) and min(config.factored) >= 2
    yield "factored", fits, "at least one digit of at least two values"
    yield "heads", not config.width % config.heads, f"a divisor of the width, {config.width}"
    even = f"an even width per head, not {config.head_dim}, for rotary time"
    yield "heads", config.released or not config.head_dim % 2, even
    name = "merge" if discrete else "patch"
    divides = not any(side % getattr(config, name) for side in grid)
    yield name, divides, f"a divisor of both sides of the grid, {grid}"
    fewer = "fewer tokens: their ids together must fit 62 bits"
    yield "merge", not discrete or config.mask_id < MOST_IDS, fewer

    known = bool(config.conditioning) and set(config.conditioning) <= set(CONDITIONINGS)
    yield "conditioning", known, f"some of {', '.join(CONDITIONINGS)}"
    known = set(config.objectives) <= set(OBJECTIVES)
    yield "objectives", known, f"weights for some of {', '.join(OBJECTIVES)}"
    weights = list(config.objectives.values())
    fits = bool(weights) and min(weights) >= 0 and 0 < sum(weights) < math.inf
    yield "objectives", fits, "weights of at least 0 that do not all vanish"
    regression = config.video_loss == "regression"
    yield "video_loss", not (regression and discrete), "diffusion, or a continuous tokenizer"
    change = "true: regression predicts the change since the previous frame"
    yield "copy_previous", config.copy_previous or not regression, change
    if config.trunk == "unet":
        yield from _unet_rules(config)
    else:
        yield "crop", config.crop == 0, "0: only a unet is trained on parts of frames"
    yield "layout", not (config.shared_modulation and config.released), "ours, as shared_modulation is on"


def _unet_rules(config: HMAConfig) -> Iterator[tuple[str, bool, str]]:
    for name, value in (
        ("conditioning", ("modulation",)),
        ("shared_modulation", True),
        ("layout", "ours"),
        ("absent_action", "embedding"),
    ):
        yield name, getattr(config, name) == value, f"{value!r}, as the trunk is a unet"
    levels = config.levels
    yield "levels", bool(levels) and min(levels) >= 1, "at least one width, all at least 1"
    side = 2 ** (len(levels) - 1)
    fits = not any(size % side for size in (config.token_grid[0] // config.views, config.token_grid[1]))
    yield "levels", fits, f"fewer: tokens lie on {config.token_grid}, not multiples of {side}"
    most = min(config.token_grid[0] // config.views, config.token_grid[1])
    fits = config.crop == 0 or (2 * CROP_EDGE < config.crop <= most and not config.crop % side)
    yield "crop", fits, f"0, or a multiple of {side} from {2 * CROP_EDGE + 1} to {most}"
    whole = config.whole_frames and not config.trained_readouts
    needs = "0: parts of frames need training_pass pairs, whole_share 1 and no objective that reads actions"
    yield "crop", not config.crop or whole, needs
    local = config.discrete or config.video_loss == "regression"
    yield "crop", not config.crop or local, "0: the diffusion head knows the place of each token of a frame"


def _require_colors(colors: Any, digits: tuple[int, ...]) -> None:
    """Raise TokenizerError unless each digit's values are these colours."""
    from hma_data.tokenizers.shapes import parse_colors

    if {*digits} != {count := len(parse_colors(colors, "tokenizer"))}:
        fault = f"has {count} colours, but digits of {max(digits)} values"
        raise TokenizerError("tokenizer", fault, "take the whole config.json of one checkpoint")


@dataclass(frozen=True)
class ActionSpace:
    """The action space of an embodiment, and the statistics of its actions.

    Attributes:
        id: the embodiment's id.
        action_dim: A, values of one raw action.
        stride: actions in a chunk.
        mean, std: (A,) of the raw actions.
        normalize: (A,) False for dims that pass through unchanged.
        zero_variance: the treatment of dims that never vary. "zero": they become zero; "divide": they are
            divided by std + 1e-10 like any other (released).

    Raises:
        RecipeError: lengths differ from action_dim, or statistics are not finite.
    """

    id: str
    action_dim: int
    stride: int
    mean: tuple[float, ...]
    std: tuple[float, ...]
    normalize: tuple[bool, ...]
    zero_variance: str = "zero"

    def __post_init__(self) -> None:
        for name in ("mean", "std", "normalize"):
            if len(getattr(self, name)) != self.action_dim:
                fault = f"{name} has {len(getattr(self, name))} values where the action has {self.action_dim}"
                raise RecipeError(self.id, fault, "recompute the statistics of this embodiment")
        if not all(map(math.isfinite, (*self.mean, *self.std))) or min(self.std) < 0:
            raise RecipeError(self.id, "action statistics are not finite", "recompute them on clean data")

    @property
    def chunk_dim(self) -> int:
        """Return K = stride * action_dim."""
        return self.stride * self.action_dim

    def stats(self) -> dict[str, Any]:
        """Return the content of `stats.json` of a checkpoint."""
        action = {"mean": list(self.mean), "std": list(self.std), "zero_variance": self.zero_variance}
        return {"action": action}

    def agrees_with(self, other: "ActionSpace") -> bool:
        """Check whether two spaces are equal, up to the rounding of statistics to float32 in a stem."""
        sizes = ("id", "action_dim", "stride", "normalize", "zero_variance")
        return all(getattr(self, name) == getattr(other, name) for name in sizes) and np.allclose(
            [self.mean, self.std], [other.mean, other.std], rtol=1e-6, atol=1e-30
        )

    @classmethod
    def of(cls, embodiment: "Embodiment", stats: Any = None) -> Self:
        """Return the action space of a registry embodiment.

        Args:
            stats: its `Stats`, with mean and std (A,); without them actions pass unchanged.
        """
        dims = embodiment.action_dim
        mean = [0.0] * dims if stats is None else np.asarray(stats.mean, np.float64).tolist()
        std = [1.0] * dims if stats is None else np.asarray(stats.std, np.float64).tolist()
        normalize = np.asarray(embodiment.normalize_mask, bool).tolist()
        rule = getattr(stats, "zero_variance", "zero")
        return cls(embodiment.id, dims, embodiment.stride, tuple(mean), tuple(std), tuple(normalize), rule)
