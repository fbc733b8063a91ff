"""Hold the modules of a model, and compute with them what training, scoring and generation share.

One trunk and one readout serve all embodiments; each embodiment has a stem and a head of its own.

B batch, T frames, h,w token grid, S = h*w, N = S + action tokens, D width, K = stride * action dim,
c channels and H,W grid of latents, p patch side.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from hma_data.errors import CheckpointError, HMAError
from hma_model.checkpoint.folder import Checkpoint
from hma_model.config import OBJECTIVES, POLICY, ActionSpace, HMAConfig, Readout
from hma_model.network.conditioning import ActionConditioning, Groups, condition
from hma_model.network.head import (
    ActionHead,
    Generators,
    LatentReadout,
    RegressionReadout,
    TokenReadout,
)
from hma_model.network.states import check_fit, module_key
from hma_model.network.stem import Stem, merge_tokens, patchify, space_of_stem, waves_of_stem
from hma_model.network.trunks.contract import Conditioning, TimePositions, Trunk, window_times
from hma_model.network.trunks.transformer import Transformer
from hma_model.network.trunks.unet import UNet

# by `HMAConfig.trunk`
TRUNKS: dict[str, Callable[[HMAConfig], Trunk]] = {"transformer": Transformer, "unet": UNet}


class Network(nn.Module):
    """The modules of a model.

    Attributes:
        config: the architecture.
        embodiments: the action space of each embodiment present, by id.
        source: the checkpoint that the model was loaded from; None for a model made in memory.
        trunk, readout: the modules that all embodiments share.
        stems, heads: the modules of each embodiment; `stem(id)` and `head(id)` find them.
    """

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        self.config = config
        self.embodiments: dict[str, ActionSpace] = {}
        self.source: Checkpoint | None = None
        self.trunk: Trunk = TRUNKS[config.trunk](config)
        if config.discrete:
            self.readout: nn.Module = TokenReadout(config)
        else:
            diffuses = config.video_loss == "diffusion"
            self.readout = LatentReadout(config) if diffuses else RegressionReadout(config)
        self.stems = nn.ModuleDict()
        self.heads = nn.ModuleDict()

    @property
    def name(self) -> str:
        """Return the checkpoint that the model was loaded from, as an error names it."""
        return self.source.name if self.source else "the model"

    @property
    def device(self) -> torch.device:
        """Return the device of the trunk."""
        return self.trunk.absent.device

    @property
    def dtype(self) -> torch.dtype:
        """Return the type of the trunk's weights."""
        return self.trunk.absent.dtype

    @property
    def token_readout(self) -> TokenReadout:
        """Return the readout of a discrete model."""
        assert isinstance(self.readout, TokenReadout)
        return self.readout

    @property
    def latent_readout(self) -> LatentReadout | RegressionReadout:
        """Return the readout of a continuous model."""
        assert isinstance(self.readout, LatentReadout | RegressionReadout)
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
        key = module_key(space.id)
        self.stems[key] = Stem(self.config, space, waves).to(self.device, self.dtype)
        self.heads[key] = ActionHead(self.config, space).to(self.device, self.dtype)
        self.embodiments[space.id] = space

    def share_stem(self, embodiment: str, other: str) -> None:
        """Let another embodiment with the same actions and statistics use the stem of an embodiment."""
        self.stems[module_key(other)] = self.stem(embodiment)

    def stem(self, embodiment: str) -> Stem:
        """Return the stem of an embodiment."""
        return self._of(self.stems, embodiment)  # type: ignore[return-value]

    def head(self, embodiment: str) -> ActionHead:
        """Return the action head of an embodiment."""
        return self._of(self.heads, embodiment)  # type: ignore[return-value]

    def widest_chunk(self, embodiments: Sequence[str]) -> int:
        """Return the largest K of these embodiments."""
        return max(self.stem(name).input.in_features for name in set(embodiments))

    def _of(self, modules: nn.ModuleDict, embodiment: str) -> nn.Module:
        if embodiment not in self.embodiments:
            there = ", ".join(self.embodiments) or "none"
            remedy = "choose one of them, or add yours: hma finetune SHARDS --from CHECKPOINT --out RUN"
            raise HMAError(embodiment, f"is not in the model, which has: {there}", remedy)
        return modules[module_key(embodiment)]

    # -- states -----------------------------------------------------------------------------------------

    def trunk_state(self) -> dict[str, Tensor]:
        """Return the tensors that the embodiments share; names are relative to the model."""
        return self._shared().state_dict()

    def _shared(self) -> nn.ModuleDict:
        return nn.ModuleDict({"trunk": self.get_submodule("trunk"), "readout": self.readout})

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

    # -- frames and actions in ----------------------------------------------------------------------------

    def condition(
        self,
        given: ActionConditioning | None,
        groups: Groups,
        positions: Tensor,
        unsort: bool = False,
    ) -> Conditioning:
        """Return the trunk's conditioning; the function of this name explains the arguments."""
        return condition(self.trunk, self.stem, given, groups, positions, unsort)

    def time_positions(self, frames: int) -> TimePositions:
        """Return the times of a window of this many frames."""
        if frames > self.config.frames and self.config.released:
            fault = f"{frames} frames where the learned positions end at {self.config.frames}"
            raise HMAError("window", fault, "give a shorter window")
        return window_times(self.config, frames, self.device)

    def frame_values(self, frames: Tensor, places: Tensor | None = None) -> Tensor:
        """Return the trunk's token ids (B, T, S), or the scaled patches (B, T, S, c*p*p), of stored frames.

        Args:
            frames: tokens (B, T, h, w) int64, or latents (B, T, c, H, W).
            places: those of squares of frames, as `Batch.places`; None for whole frames.

        Raises:
            HMAError: the frames have another shape.
        """
        config, shape = self.config, tuple(frames.shape[2:])
        wanted = config.frame_shape if places is None else config.crop_shape
        if shape != wanted:
            fault = f"a frame has the shape {shape}, but the model takes {wanted}"
            raise HMAError("frames", fault, "use the model's tokenizer")
        if config.discrete:
            return merge_tokens(frames.long(), config.merge, config.vocab_size)
        return patchify(frames.float() * config.latent_scale, config.patch)

    def embed(
        self,
        frames: Tensor,
        masked: Tensor | None = None,
        previous: Sequence[int] | None = None,
        corruption: Tensor | None = None,
    ) -> Tensor:
        """Embed frames as (B, T, S, D).

        Args:
            frames: what `frame_values` returns: ids, of which the configuration's `mask_id` means masked, or
                scaled patches.
            masked: (B, T, S, p*p or 1) bool, the masked pixels of patches; by default none is.
            previous: (T,) for each frame the index of the frame before it, or -1; by default the frames
                follow one another.
            corruption: (B, T) the corruption of each frame that the model is told; by default nothing is.
        """
        if masked is None and not self.config.discrete:
            masked = torch.zeros_like(frames[..., :1], dtype=torch.bool)
        order = range(-1, frames.shape[1] - 1) if previous is None else previous
        return self.trunk.embed_frames(frames, masked, order, corruption)

    # -- features out -------------------------------------------------------------------------------------

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

    def require_readout(self, readout: Readout, where: object = None) -> None:
        """Raise HMAError unless an objective of the training trained a readout: else it returns noise."""
        if readout in self.config.trained_readouts:
            return
        objectives = ", ".join(objective.name for objective in self.config.trained)
        wanted = [f"{{{name}: 1.0}}" for name, one in OBJECTIVES.items() if one.readout == readout]
        fault = f"was not trained to {readout.deed}, but for {objectives}"
        raise HMAError(where or self.name, fault, f"train one with objectives={' or '.join(wanted)}")

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
        if readout != POLICY and POLICY not in self.config.trained_readouts:
            chunks = torch.full_like(chunks, torch.nan)  # rather than numbers that nothing trained
        if lag := readout.lag:
            after = head.predict(pooled[:, lag:].flatten(0, 1), readout, generator)
            chunks = torch.cat([after.unflatten(0, (len(pooled), -1)), chunks[:, -lag:]], dim=1)
        return chunks if self.config.released else self.stem(embodiment).normalizer.undo(chunks)
