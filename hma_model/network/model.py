"""Define the world model: one trunk for all embodiments, a stem and a head for each.

    model = HMA(HMAConfig(layers=4, width=128))
    model.add_embodiment(embodiment, stats)
    output = model(batch)                    # masks, corrupts, and computes the loss
    frames = model.generate(prompt, actions, embodiment.id, frames=8)

B batch, T frames, h,w token grid, S = h*w, N = S + action tokens, D width, K = stride * action dim,
F digits, V values of a digit, c channels and H,W grid of latents, p patch side.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from hma_data.errors import CheckpointError, HMAError
from hma_data.storage.paths import StrPath
from hma_model.checkpoint.folder import Checkpoint
from hma_model.config import POLICY, READOUTS, ActionSpace, HMAConfig, Readout
from hma_model.network.conditioning import Groups, align, condition, unknown
from hma_model.network.copying import frames_before
from hma_model.network.head import ActionHead, Generators, LatentReadout, TokenReadout
from hma_model.network.states import check_fit, module_key
from hma_model.network.stem import (
    LatentEmbedding,
    Stem,
    TokenEmbedding,
    merge_tokens,
    patches_before,
    patchify,
    space_of_stem,
    to_digits,
    waves_of_stem,
)
from hma_model.network.trunk import Conditioning, TimePositions, Trunk, window_times

if TYPE_CHECKING:
    from hma_data.loading.rows import Batch
    from hma_model.network.objectives import Output


class HMA(nn.Module):
    """Heterogeneous masked autoregression over tokens or latents (paper section 3).

    Attributes:
        config: the architecture.
        source: the checkpoint that the model was loaded from; None for a model made in memory.
        embodiments: the action space of each embodiment present, by id.
        trunk, readout: the modules that all embodiments share.
        stems, heads: the modules of each embodiment; `stem(id)` and `head(id)` find them.
    """

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        self.config = config
        self.source: Checkpoint | None = None
        self.embodiments: dict[str, ActionSpace] = {}
        self.trunk = Trunk(config)
        continuous = config.kind == "continuous"
        self.readout: nn.Module = LatentReadout(config) if continuous else TokenReadout(config)
        self.stems = nn.ModuleDict()
        self.heads = nn.ModuleDict()

    @property
    def device(self) -> torch.device:
        """Return the device of the trunk."""
        return self.trunk.position.device

    @property
    def token_readout(self) -> TokenReadout:
        """Return the readout of a discrete model."""
        assert isinstance(self.readout, TokenReadout)
        return self.readout

    @property
    def latent_readout(self) -> LatentReadout:
        """Return the readout of a continuous model."""
        assert isinstance(self.readout, LatentReadout)
        return self.readout

    # -- embodiments ------------------------------------------------------------------------------------

    def add_embodiment(self, embodiment: Any, stats: Any = None, waves: int | None = None) -> None:
        """Add an embodiment with a freshly initialised stem and head.

        Args:
            embodiment: a registry `Embodiment`, or an `ActionSpace`.
            stats: its `Stats`; without them actions are not normalised.
            waves: octaves of waves of its commands; by default the configuration's.

        Raises:
            CheckpointError: the model has the id with another action space. With the same, nothing happens.
        """
        space = embodiment if isinstance(embodiment, ActionSpace) else ActionSpace.of(embodiment, stats)
        known = self.embodiments.get(space.id)
        if known is not None:
            if known.agrees_with(space):
                return
            fault = f"has {known.action_dim} dims, stride {known.stride}, or other statistics in the model"
            raise CheckpointError(space.id, fault, "use another id, or the statistics it was trained with")
        like = self.trunk.position
        self.stems[module_key(space.id)] = Stem(self.config, space, waves).to(like.device, like.dtype)
        self.heads[module_key(space.id)] = ActionHead(self.config, space).to(like.device, like.dtype)
        self.embodiments[space.id] = space

    def stem(self, embodiment: str) -> Stem:
        """Return the stem of an embodiment."""
        return self._of(self.stems, embodiment)  # type: ignore[return-value]

    def head(self, embodiment: str) -> ActionHead:
        """Return the action head of an embodiment."""
        return self._of(self.heads, embodiment)  # type: ignore[return-value]

    def _of(self, modules: nn.ModuleDict, embodiment: str) -> nn.Module:
        if embodiment not in self.embodiments:
            there = ", ".join(self.embodiments) or "none"
            fault = f"the model has no such embodiment; it has {there}"
            raise HMAError(embodiment, fault, "add or load the embodiment first")
        return modules[module_key(embodiment)]

    # -- states -----------------------------------------------------------------------------------------

    def trunk_state(self) -> dict[str, Tensor]:
        """Return the tensors that the embodiments share; names are relative to the model."""
        return self._shared().state_dict()

    def _shared(self) -> nn.ModuleDict:
        return nn.ModuleDict({"trunk": self.trunk, "readout": self.readout})

    def stem_state(self, embodiment: str) -> dict[str, Tensor]:
        """Return the tensors of an embodiment's action stem, statistics and modulation."""
        return self.stem(embodiment).state_dict()

    def head_state(self, embodiment: str) -> dict[str, Tensor]:
        """Return the tensors of an embodiment's action head."""
        return self.head(embodiment).state_dict()

    def load_trunk(self, state: Mapping[str, Tensor], where: object = "trunk") -> None:
        """Load a result of `trunk_state`; a CheckpointError names `where` and keys that do not fit."""
        check_fit(where, state, self.trunk_state())
        self._shared().load_state_dict(state)

    def load_embodiment(
        self, embodiment: str, stem: Mapping[str, Tensor], head: Mapping[str, Tensor]
    ) -> None:
        """Load results of `stem_state` and `head_state`; add the embodiment if the model lacks it."""
        self.add_embodiment(space_of_stem(embodiment, stem), waves=waves_of_stem(stem))
        check_fit(f"{embodiment}: stem", stem, self.stem_state(embodiment))
        check_fit(f"{embodiment}: head", head, self.head_state(embodiment))
        self.stem(embodiment).load_state_dict(stem)
        self.head(embodiment).load_state_dict(head)

    @classmethod
    def from_pretrained(
        cls,
        source: StrPath,
        embodiments: Sequence[str] | None = None,
        revision: str | None = None,
        device: str | torch.device = "cpu",
    ) -> "HMA":
        """Load the trunk and the chosen embodiments, by default all.

        Args:
            source: str or path of a checkpoint or training run, a URI, or a hub repository.
            embodiments: ids; None for all.
            revision: branch, tag or commit of a repository.
        """
        from hma_model.hub import publish as hub  # needs the network's client, which most uses do not

        return hub.from_pretrained(source, embodiments=embodiments, revision=revision, device=device)

    def push_to_hub(self, repo: StrPath, embodiments: Sequence[str] | None = None) -> str:
        """Publish the model, or only some of its embodiments, to a repository or folder (str or path)."""
        from hma_model.hub import publish as hub

        return hub.push_model(self, repo, embodiments=embodiments)

    # -- the network ------------------------------------------------------------------------------------

    def forward(
        self, batch: "Batch", objective: str | None = None, generator: torch.Generator | None = None
    ) -> "Output":
        """Mask, corrupt and predict a batch of windows.

        Args:
            batch: windows of one or several embodiments, on the model's device. Any object with the fields of
                `Batch` will do; it may lack `frame_mask` and `context`.
            objective: forward, passive, policy, full or inverse; by default drawn by its weight.
            generator: the generator of every random draw; the draws take place on its device.

        Returns:
            The losses and, outside training, the logits; see `Output`.
        """
        from hma_model.network.objectives import compute

        return compute(self, batch, objective, generator)

    def video_logits(
        self,
        tokens: Tensor,
        actions: Tensor | None,
        embodiment: str | Sequence[str],
        action_mask: Tensor | None = None,
        true: Tensor | None = None,
    ) -> Tensor:
        """Compute the scores of every token of a window.

        Args:
            tokens: (B, T, h, w) int64; the vocabulary's size means masked.
            actions: (B, T, K) raw chunks; None for no actions.
            embodiment: one id for all, or one a sample.
            action_mask: (B, T) bool, True where a chunk is known; by default all are.
            true: (B, T, h, w) int64 tokens whose digits a chain's later digits are given; by default those
                are the likeliest.

        Returns:
            (B, T, h, w, F, V) float32, low digit first; with `merge`, of the trunk's tokens and their digits.
        """
        self._require("discrete", "video_logits")
        groups, times = Groups.of(embodiment, len(tokens)), self.time_positions(tokens.shape[1])
        conditioning = self.condition(actions, action_mask, groups, times)
        return self.logits_under(conditioning, tokens, groups, times, true)

    def logits_under(
        self,
        conditioning: Conditioning,
        tokens: Tensor,
        groups: Groups,
        times: TimePositions,
        true: Tensor | None = None,
        frame: Tensor | None = None,
    ) -> Tensor:
        """Compute `video_logits` under a conditioning that `condition` has computed.

        With `frame` (B,) int64, only that frame of each window is scored, and T is 1.
        """
        values = groups.sort(self.frame_values(tokens))
        x = self.embed_tokens(values)
        given = None if true is None else to_digits(groups.sort(self.frame_values(true)), self.config.digits)
        before = None
        if self.config.copy_previous:
            before = frames_before(values, list(range(-1, values.shape[1] - 1)), self.config)
        features = self.video_features(self.trunk(x, conditioning, times))
        if frame is not None:
            at = torch.arange(len(frame), device=frame.device).unsqueeze(1), groups.sort(frame).unsqueeze(1)
            features = features[at]
            given = None if given is None else given[at]
            before = None if before is None else before[at]
        scores = self.token_readout(features, given, before)
        return groups.unsort(self.token_readout.split(scores)).unflatten(2, self.config.token_grid)

    def video_conditions(
        self,
        latents: Tensor,
        mask: Tensor,
        actions: Tensor | None,
        embodiment: str | Sequence[str],
        action_mask: Tensor | None = None,
    ) -> Tensor:
        """Compute the conditions under which `LatentReadout.sample` draws.

        Args:
            latents: (B, T, c, H, W), already multiplied by the configuration's `latent_scale`.
            mask: (B, T, H, W) bool, True for latent pixels the model may not see.
            actions, embodiment, action_mask: as in `video_logits`.

        Returns:
            (B, T, H/p, W/p, D); with `copy_previous` (B, T, H/p, W/p, D + c*p*p).
        """
        self._require("continuous", "video_conditions")
        groups, times = Groups.of(embodiment, len(latents)), self.time_positions(latents.shape[1])
        conditioning = self.condition(actions, action_mask, groups, times)
        return self.conditions_under(conditioning, latents, mask, groups, times)

    def conditions_under(
        self,
        conditioning: Conditioning,
        latents: Tensor,
        mask: Tensor,
        groups: Groups,
        times: TimePositions,
    ) -> Tensor:
        """Compute `video_conditions` under a conditioning that `condition` has computed."""
        patches, pixels = patchify(latents, self.config.patch), patchify(mask.unsqueeze(2), self.config.patch)
        x = self.embed_patches(groups.sort(patches), groups.sort(pixels))
        before = None
        if self.config.copy_previous:
            order = range(-1, patches.shape[1] - 1)
            before = patches_before(groups.sort(patches), groups.sort(pixels), order, self.config.patch)
        conditions = self.latent_readout(
            self.video_features(self.trunk(x, conditioning, times)), times.positions, before
        )
        return groups.unsort(conditions).unflatten(2, self.config.token_grid)

    @torch.no_grad()
    def predict_actions(
        self,
        frames: Tensor,
        embodiment: str | Sequence[str],
        actions: Tensor | None = None,
        action_mask: Tensor | None = None,
        readout: str = "policy",
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Predict action chunks from video.

        Args:
            frames: tokens (B, T, h, w) int64, or latents (B, T, c, H, W) as stored.
            embodiment: one id for all, or one a sample.
            actions: (B, T, K) raw chunks that are known; none by default.
            action_mask: (B, T) bool, True where a chunk is known; by default all are.
            readout: "policy": chunk k from frames up to k; "inverse": chunk k from frames up to k+1. No frame
                follows the last chunk, so "inverse" takes it from the policy.
            generator: the generator of the noise of a diffusion head.

        Returns:
            (B, T, K) float32 raw; narrower embodiments of a mixed batch are padded with zeros.

        Raises:
            HMAError: the readout is unknown.
        """
        if readout not in READOUTS:
            raise HMAError("readout", f"{readout!r} is unknown", "give one of " + ", ".join(READOUTS))
        groups, count = Groups.of(embodiment, len(frames)), frames.shape[1]
        times = self.time_positions(count)
        given = None
        if actions is not None:
            given = align(self.config, actions, action_mask, count)
        elif self.config.absent_action != "tokens":
            given = unknown(self, groups, count)
        conditioning = condition(self, given, groups, times.positions)
        values = groups.sort(self.frame_values(frames))
        if self.config.kind == "discrete":
            x = self.embed_tokens(values)
        else:
            x = self.embed_patches(values, torch.zeros_like(values[..., :1], dtype=torch.bool))
        pooled = self.action_features(self.trunk(x, conditioning, times))
        return self.read_chunks(pooled, groups, READOUTS[readout], generator)

    def read_chunks(self, pooled: Tensor, groups: Groups, readout: Readout, generator: Generators) -> Tensor:
        """Read chunks (B, T, K) in the batch's order off action features (B, T, D) sorted by embodiment.

        A list of generators has one for each sample, in the batch's order.
        """
        if isinstance(generator, Sequence) and groups.order is not None:
            generator = [generator[sample] for sample in groups.order]
        chunks = [
            self._predict(
                pooled[span], name, readout, generator[span] if isinstance(generator, Sequence) else generator
            )
            for name, span in groups.spans()
        ]
        widest = max(chunk.shape[-1] for chunk in chunks)
        padded = [torch.nn.functional.pad(chunk, (0, widest - chunk.shape[-1])) for chunk in chunks]
        return groups.unsort(torch.cat(padded))

    def _predict(self, pooled: Tensor, embodiment: str, readout: Readout, generator: Generators) -> Tensor:
        head = self.head(embodiment)
        chunks = head.predict(pooled.flatten(0, 1), POLICY, generator).unflatten(0, pooled.shape[:2])
        if lag := readout.lag:
            after = head.predict(pooled[:, lag:].flatten(0, 1), readout, generator)
            chunks = torch.cat([after.unflatten(0, (len(pooled), -1)), chunks[:, -lag:]], dim=1)
        return chunks if self.config.action_target == "raw" else self.stem(embodiment).normalizer.undo(chunks)

    @torch.no_grad()
    def generate(
        self,
        prompt: Tensor,
        actions: Tensor | None,
        embodiment: str | Sequence[str],
        frames: int,
        unmask_steps: int = 2,
        temperature: float | None = None,
        generator: torch.Generator | None = None,
        order: str = "random",
        cache: bool = True,
        sample_steps: int | None = None,
        known: Tensor | None = None,
        noise_level: float = 0.0,
        precision: str = "float32",
        compile: bool = False,
    ) -> Tensor:
        """Continue a prompt, frame by frame.

        Args:
            prompt: tokens (B, P, h, w) int64, or latents (B, P, c, H, W) as stored.
            actions: (B, P + frames, K) raw; chunk k holds the commands from frame k to k+1. None for none.
            embodiment: one id for all, or one a sample.
            frames: how many to add.
            unmask_steps: passes a frame.
            temperature: 0 takes the likeliest token, else it divides the logits (continuous: share of noise);
                by default 0.5 for tokens, 0 for latents.
            generator: of every random draw.
            order: the order in which tokens are unmasked, "random" or "confidence".
            cache: keep keys and values of past frames; False recomputes everything, with the same result.
            sample_steps: sampling steps of the diffusion head.
            known: (B, P + frames) bool, False where a chunk is unknown, as `action_mask` in training; by
                default all are known.
            noise_level: how corrupted the model is to take its own frames for, 0 to 1. For models trained
                with `told_noise`.
            precision: "float32"; "bf16" or "int8" for products in these.
            compile: compile the trunk; the first frames then take a minute or more.

        Returns:
            (B, frames, h, w) int64 tokens, or (B, frames, c, H, W) float32 latents as stored.
        """
        from hma_model.generation.commands import warn_outside
        from hma_model.generation.rollout import generate

        made = generate(
            self, prompt, actions, embodiment, frames, mask=known, unmask_steps=unmask_steps,
            temperature=temperature, generator=generator, order=order, cache=cache, sample_steps=sample_steps,
            noise_level=noise_level, precision=precision, compile=compile,
        )  # fmt: skip
        if actions is not None:
            used = prompt.shape[1] + frames - 1
            warn_outside(self, actions[:, :used], embodiment, None if known is None else known[:, :used])
        return made

    # -- parts that training and decoding share -----------------------------------------------------------

    def condition(
        self, actions: Tensor | None, known: Tensor | None, groups: Groups, times: TimePositions
    ) -> Conditioning:
        """Return the trunk's conditioning by chunks (B, T, K), of which some are known (B, T)."""
        frames = len(times.positions)
        given = None if actions is None else align(self.config, actions, known, frames)
        return condition(self, given, groups, times.positions)

    def time_positions(self, frames: int) -> TimePositions:
        """Return the times of a window of this many frames."""
        if frames > self.config.frames and self.config.time_position == "learned":
            fault = f"{frames} frames where the learned positions end at {self.config.frames}"
            raise HMAError("window", fault, "give a shorter window")
        return window_times(self.config, frames, self.device)

    def frame_values(self, frames: Tensor) -> Tensor:
        """Return the trunk's token ids (B, T, S), or the scaled patches (B, T, S, c*p*p), of stored frames.

        Args:
            frames: tokens (B, T, h, w) int64, or latents (B, T, c, H, W).

        Raises:
            HMAError: the frames have another shape.
        """
        config, shape = self.config, tuple(frames.shape[2:])
        if shape != config.frame_shape:
            fault = f"a frame has the shape {shape}, but the model takes {config.frame_shape}"
            raise HMAError("frames", fault, "use the model's tokenizer")
        if config.kind == "discrete":
            return merge_tokens(frames.long(), config.merge, config.vocab_size)
        return patchify(frames.float() * config.latent_scale, config.patch)

    def embed_tokens(self, tokens: Tensor, previous: Sequence[int] | None = None) -> Tensor:
        """Embed ids (B, T, S) as (B, T, S, D).

        Args:
            tokens: the configuration's `mask_id` means masked.
            previous: (T,) for each frame the index of the frame before it, or -1; by default the frames
                follow one another.
        """
        embed = self.trunk.embed
        assert isinstance(embed, TokenEmbedding)
        return embed(tokens, range(-1, tokens.shape[1] - 1) if previous is None else previous)

    def embed_patches(self, patches: Tensor, masked: Tensor, previous: Sequence[int] | None = None) -> Tensor:
        """Embed scaled patches (B, T, S, c*p*p) with masks of pixels (B, T, S, p*p or 1) as (B, T, S, D).

        `previous` is that of `embed_tokens`.
        """
        embed = self.trunk.embed
        assert isinstance(embed, LatentEmbedding)
        order = range(-1, patches.shape[1] - 1) if previous is None else previous
        return embed(patches, masked, order)

    def video_features(self, features: Tensor) -> Tensor:
        """Return the features (B, T, S, D) of (B, T, N, D) without the action tokens."""
        return features[:, :, : self.config.tokens_per_frame]

    def action_features(self, features: Tensor) -> Tensor:
        """Return the mean (B, T, D) of the action tokens in (B, T, N, D), or of the frame's if none."""
        own = self.config.tokens_per_frame
        if features.shape[2] > own:
            return features[:, :, own:].mean(2)
        if self.config.absent_action == "tokens":  # the released code takes as many of the last tokens
            return features[:, :, -self.config.action_tokens :].mean(2)
        return features.mean(2)

    def _require(self, kind: str, name: str) -> None:
        if self.config.kind != kind:
            raise HMAError(name, f"is of {kind} models; this one is {self.config.kind}")
