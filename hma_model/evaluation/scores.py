"""Score rollouts of windows beside baselines: PSNR, SSIM and LPIPS of each predicted frame.

B batch, P predicted frames, N windows.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch

from hma_data.arrays import Floats
from hma_data.loading.dataset import Batch
from hma_model.evaluation.actions import shuffled, without_actions
from hma_model.evaluation.intervals import NATURAL, Episodes, horizon_summary
from hma_model.evaluation.metrics import PSNR_LIMIT, PSNR_RANGE, SSIM_RANGE, psnr, ssim
from hma_model.evaluation.perceptual import NO_NETWORKS, FeatureCollector, Networks
from hma_model.evaluation.rollouts import RolloutImages

ROLLOUT_KINDS = ("true", "shuffled", "none", "copy")
RANGES = {"psnr": PSNR_RANGE, "ssim": SSIM_RANGE, "lpips": NATURAL}

Scores = dict[str, Floats]  # by the names of RANGES, (B, P); NaN where a frame is not finite


def scores_of(pictures: RolloutImages, networks: Networks = NO_NETWORKS) -> Scores:
    """Return the scores of rollouts; LPIPS if there is a network for it."""
    truth = pictures.truth[:, pictures.prompt :]
    predicted = pictures.predicted[:, pictures.prompt :]
    found = {"psnr": psnr(truth, predicted, limit=PSNR_LIMIT), "ssim": ssim(truth, predicted)}
    if networks.lpips:
        found["lpips"] = networks.lpips_of(truth, predicted)
    return {name: np.where(pictures.finite, values, np.nan) for name, values in found.items()}


def combined(parts: Sequence[Scores], rule: Callable[..., Any] = np.concatenate) -> Scores:
    """Return the scores of several batches as those of one; with another rule, such as a mean of draws."""
    return {name: rule([part[name] for part in parts]) for name in parts[0]}


def figures_of(scores: Scores, seed: int, episodes: Episodes) -> dict[str, Any]:
    """Return the means over windows, with their intervals; `episodes` are the windows' own."""
    found: dict[str, Any] = {}
    for name, values in scores.items():
        found |= horizon_summary(name, values, seed, 6, episodes, RANGES[name])
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
    scores: dict[str, list[Scores]] = field(default_factory=partial(defaultdict, list))
    predicted: dict[str, list[torch.Tensor]] = field(default_factory=partial(defaultdict, list))
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
        scores = [scores_of(pictures, self.judge.networks) for pictures in draws]
        self.scores[kind].append(combined(scores, partial(np.mean, axis=0)))
        if kind != "copy":
            self.predicted[kind].append(draws[0].stored)
