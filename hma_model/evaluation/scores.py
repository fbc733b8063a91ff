"""Score rollouts of windows beside baselines: PSNR, SSIM and LPIPS of each predicted frame.

B batch, P predicted frames, N windows.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch

from hma_data.loading.dataset import Batch
from hma_model.arrays import Floats
from hma_model.evaluation.actions import shuffled, without_actions
from hma_model.evaluation.intervals import NATURAL, Episodes, horizon_summary
from hma_model.evaluation.metrics import PSNR_LIMIT, PSNR_RANGE, SSIM_RANGE, psnr, ssim
from hma_model.evaluation.perceptual import FeatureCollector
from hma_model.evaluation.rollouts import RolloutImages

ROLLOUT_KINDS = ("true", "shuffled", "none", "copy")


@dataclass(frozen=True)
class Scores:
    """PSNR (B, P) in dB, SSIM (B, P) and LPIPS (B, P) of predicted frames; NaN where one is not finite."""

    psnr: Floats
    ssim: Floats
    lpips: Floats | None

    @classmethod
    def of(cls, pictures: RolloutImages, judge: FeatureCollector | None = None) -> "Scores":
        """Return the scores of rollouts; LPIPS where the judge has a network for it."""
        truth = pictures.truth[:, pictures.prompt :]
        predicted = pictures.predicted[:, pictures.prompt :]

        def known(values: Floats) -> Floats:
            return np.where(pictures.finite, values, np.nan)

        lpips = None
        if judge and judge.networks.lpips:
            lpips = known(judge.networks.lpips_of(truth, predicted))
        signal = psnr(truth, predicted, limit=PSNR_LIMIT)
        return cls(known(signal), known(ssim(truth, predicted)), lpips)

    @classmethod
    def mean(cls, draws: "list[Scores]") -> "Scores":
        """Return the means over draws."""
        return cls._combined(draws, partial(np.mean, axis=0))

    @classmethod
    def join(cls, batches: "list[Scores]") -> "Scores":
        return cls._combined(batches, np.concatenate)

    @classmethod
    def _combined(cls, parts: "list[Scores]", rule: Callable[..., Any]) -> "Scores":
        lpips = None if parts[0].lpips is None else rule([part.lpips for part in parts])
        return cls(rule([part.psnr for part in parts]), rule([part.ssim for part in parts]), lpips)

    def figures(self, seed: int, episodes: Episodes = None) -> dict[str, Any]:
        """Return the means over windows, with their intervals; `episodes` are the windows' own."""
        found = horizon_summary("psnr", self.psnr, seed, 6, episodes, PSNR_RANGE)
        found |= horizon_summary("ssim", self.ssim, seed, 6, episodes, SSIM_RANGE)
        if self.lpips is not None:
            found |= horizon_summary("lpips", self.lpips, seed, episodes=episodes, within=NATURAL)
        return found

    def by_window(self, rollout: str) -> dict[str, Floats]:
        """Return values (N,) of the windows, by the rollout's and the figure's name."""
        found = {
            f"{rollout}.psnr": self.psnr.mean(axis=1),
            f"{rollout}.psnr_last": self.psnr[:, -1],
            f"{rollout}.ssim": self.ssim.mean(axis=1),
        }
        if self.lpips is not None:
            found[f"{rollout}.lpips"] = self.lpips.mean(axis=1)
        return found


@dataclass
class Rolled:
    """The rollouts of batches of windows, scored.

    Attributes:
        first: the number of true frames that a rollout starts from.
        judge: is shown all pictures.
        scores: of each batch, by the kind of rollout.
        predicted: the predicted tokens or latents of each batch, by the kind of rollout; of `shuffled` the
            first draw's.
        still: windows whose true pictures never change after the prompt.
    """

    first: int
    judge: FeatureCollector
    scores: dict[str, list[Scores]] = field(default_factory=lambda: {name: [] for name in ROLLOUT_KINDS})
    predicted: dict[str, list[torch.Tensor]] = field(
        default_factory=lambda: {name: [] for name in ROLLOUT_KINDS if name != "copy"}
    )
    still: int = 0

    def add(self, batch: Batch, roll: Callable[..., RolloutImages], draws: int, seed: int) -> None:
        """Roll a batch out with the true actions, in several draws with shuffled ones, and with none."""
        first = self.first
        true = roll(batch)
        self.judge.add("truth", true.truth[:, first:])
        # where nothing moves, a copy of the prompt is perfect and the actions cannot show
        unchanged = true.truth[:, first:] == true.truth[:, first - 1 : first]
        self.still += int(unchanged.all(axis=(1, 2, 3, 4)).sum())
        copied = true.predicted.copy()
        copied[:, first:] = copied[:, first - 1 : first]
        others = [roll(shuffled(batch, first - 1, seed, draw), truth=true.truth) for draw in range(draws)]
        none = roll(without_actions(batch), truth=true.truth)
        self._keep("true", [true])
        self._keep("copy", [replace(true, predicted=copied, finite=np.ones_like(true.finite))])
        self._keep("shuffled", others)
        self._keep("none", [none])

    def _keep(self, kind: str, draws: list[RolloutImages]) -> None:
        self.judge.add(kind, draws[0].predicted[:, self.first :])
        self.scores[kind].append(Scores.mean([Scores.of(pictures, self.judge) for pictures in draws]))
        if kind in self.predicted:
            self.predicted[kind].append(draws[0].stored)
