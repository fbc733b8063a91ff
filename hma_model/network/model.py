"""Define the world model: one trunk for all embodiments, a stem and a head for each.

    model = HMA(HMAConfig(layers=4, width=128))
    model.add_embodiment(embodiment, stats)
    output = model(batch)                    # masks, corrupts, and computes the loss
    frames = model.generate(prompt, actions, embodiment.id, frames=8)

B batch, T frames, h,w token grid, K = stride * action dim, F digits, V values of a digit, c channels
and H,W grid of latents.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from hma_data.errors import HMAError
from hma_data.storage.paths import StrPath
from hma_model.config import READOUTS
from hma_model.network.conditioning import Groups, align, unknown
from hma_model.network.copying import frames_before
from hma_model.network.network import Network
from hma_model.network.objectives import Output, compute
from hma_model.network.stem import to_digits

if TYPE_CHECKING:
    from hma_data.loading.rows import Batch


class HMA(Network):
    """Heterogeneous masked autoregression over tokens or latents (paper section 3)."""

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
    ) -> Output:
        """Mask, corrupt and predict a batch of windows.

        Args:
            batch: windows of one or several embodiments, on the model's device. Any object with the fields of
                `Batch` will do; it may lack `frame_mask` and `context`.
            objective: forward, passive, policy, full or inverse; by default drawn by its weight.
            generator: the generator of every random draw; the draws take place on its device.

        Returns:
            The losses and, outside training, the logits; see `Output`.
        """
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
        if not self.config.discrete:
            raise HMAError("video_logits", f"is of discrete models; this one is {self.config.kind}")
        groups, times = Groups.of(embodiment, len(tokens)), self.time_positions(tokens.shape[1])
        values = groups.sort(self.frame_values(tokens))
        given = None if true is None else to_digits(groups.sort(self.frame_values(true)), self.config.digits)
        before = frames_before(values, list(range(-1, values.shape[1] - 1)), self.config)
        chunks = None if actions is None else align(self.config, actions, action_mask, values.shape[1])
        conditioning = self.condition(chunks, groups, times.positions)
        features = self.video_features(self.trunk(self.embed(values), conditioning, times))
        scores = self.token_readout(features, given, before)
        return groups.unsort(self.token_readout.split(scores)).unflatten(2, self.config.token_grid)

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
                follows the last chunk, so "inverse" takes it from the policy if that was trained too, else
                it is NaN.
            generator: the generator of the noise of a diffusion head.

        Returns:
            (B, T, K) float32 raw; narrower embodiments of a mixed batch are padded with zeros.

        Raises:
            HMAError: the readout is unknown, or no objective of the training trained it.
        """
        if readout not in READOUTS:
            raise HMAError("readout", f"{readout!r} is unknown", "give one of " + ", ".join(READOUTS))
        self.require_readout(READOUTS[readout])
        groups, count = Groups.of(embodiment, len(frames)), frames.shape[1]
        times = self.time_positions(count)
        given = None
        if actions is not None:
            given = align(self.config, actions, action_mask, count)
        elif self.config.absent_action != "tokens":
            width = self.widest_chunk([name for name, _ in groups.parts])
            given = unknown(groups.batch, count, width, self.device)
        conditioning = self.condition(given, groups, times.positions)
        x = self.embed(groups.sort(self.frame_values(frames)))
        pooled = self.action_features(self.trunk(x, conditioning, times))
        return self.read_chunks(pooled, groups, READOUTS[readout], generator)

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
            precision: "float32"; "bf16" or "int8" for products in these.
            compile: compile the trunk; the first frames then take a minute or more.

        Returns:
            (B, frames, h, w) int64 tokens, or (B, frames, c, H, W) float32 latents as stored.
        """
        from hma_model.generation.commands import warn_outside
        from hma_model.generation.rollout import Rollout

        first = prompt.shape[1]
        used = first + frames - 1
        rollout = Rollout(
            self, embodiment, len(prompt), generator=generator, cache=cache, compile=compile,
            precision=precision, unmask_steps=unmask_steps, temperature=temperature, order=order,
            sample_steps=sample_steps,
        )  # fmt: skip
        chunks: Sequence[Tensor | None] = [None] * (used + 1)
        if actions is not None:
            if actions.shape[1] < used:
                fault = f"there are {actions.shape[1]} chunks for {first} + {frames} frames"
                raise HMAError("actions", fault, f"give {first + frames}")
            chunks = [*actions.unbind(1), None]
        rollout.prompt(prompt, actions, known)
        made = [
            rollout.step(chunks[i], chunks[i + 1], known=None if known is None else known[:, i : i + 2])
            for i in range(first - 1, used)
        ]
        if actions is not None:
            warn_outside(self, actions[:, :used], embodiment, None if known is None else known[:, :used])
        return torch.stack(made, dim=1)
