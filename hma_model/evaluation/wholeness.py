"""Measure what is left of a simulated robot and of loose objects in a model that is driven in closed loop.

Robots and objects are told by their colours, in the truth and in the model alike.

B rollouts, T frames, S pixels a side, P parts, C colours.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hma_data.arrays import Bools, Floats, Images
from hma_data.episodes.images import opencv
from hma_data.lab import truth
from hma_data.lab.truth import TrueEpisode
from hma_data.tokenizers.base import Tokenizer
from hma_model.evaluation.probe import as_seen
from hma_model.evaluation.rollouts import rollout
from hma_model.evaluation.simulated import as_batch
from hma_model.network.model import HMA

NEAR = 60.0  # distance of RGB within which a pixel has an object's colour
FEWEST = 12  # pixels of an object below which it is hidden, and not judged
WHOLE = (0.8, 1.2)  # shares of the true pixels between which a robot or an object is whole
MOST = 0.75  # share of the parts that are whole from which a robot or its objects are intact
SHAPED = 0.7  # overlap with the true shape from which it is whole
TURNS = 36  # angles of the search for the best overlap


@dataclass(frozen=True)
class Found:
    """The rollouts of a robot.

    Attributes:
        true, made: (B, T, S, S, 3) from the prompt's last frame on.
        parts: (B, T, P, 2) true places in px of 128.
        driven: how many of the parts, the first ones, are the robot's own.
    """

    robot: str
    true: Images
    made: Images
    parts: Floats
    driven: int


def continued(
    model: HMA,
    tokenizer: Tokenizer,
    robot: str,
    episodes: Sequence[TrueEpisode],
    prompt: int,
    seed: int,
    *,
    decoded: bool = False,
) -> Found:
    """Continue true episodes of one length in the model, from their first frames under the same actions.

    Args:
        decoded: take the truth as the tokens show it, so that what they lose does not count.
    """
    made = rollout(model, tokenizer, as_batch(model, tokenizer, robot, episodes), prompt=prompt, seed=seed)
    true = made.truth if decoded else np.stack([as_seen(robot, tokenizer, one.pictures) for one in episodes])
    parts, begin = np.stack([one.parts for one in episodes]), prompt - 1
    return Found(robot, true[:, begin:], made.predicted[:, begin:], parts[:, begin:], episodes[0].driven)


def palettes(found: Found) -> tuple[Floats, Floats]:
    """Return the colours of the robot's own parts and of loose objects, (C, 3) each.

    The colour of a part is the median of those at its place in the true frames.
    """
    side, count = found.true.shape[2], found.parts.shape[2]
    places = np.clip((found.parts * side / truth.SIZE).astype(int), 0, side - 1)
    b, t = np.ogrid[: found.true.shape[0], : found.true.shape[1]]
    taken = [found.true[b, t, places[:, :, p, 1], places[:, :, p, 0]].reshape(-1, 3) for p in range(count)]
    colors = [np.median(pixels, axis=0) for pixels in taken]
    spreads = [np.median(np.linalg.norm(pixels - color, axis=-1)) for pixels, color in zip(taken, colors)]
    own, loose = list[Floats](), list[Floats]()
    # places of one object differ a little; one at its edge, whose pixels are blends, has the wider spread
    for part in np.argsort(spreads, kind="stable"):
        color, kept = colors[part], own if part < found.driven else loose
        if all(np.linalg.norm(color - other) >= NEAR for other in kept):
            kept.append(color)
    return np.reshape(own, (-1, 3)), np.reshape(loose, (-1, 3))


def masks_of(images: Images, colors: Floats) -> Bools:
    """Return the pixels (C, …, S, S) that have each of the colours (C, 3) and no other one rather."""
    far = np.stack([np.linalg.norm(images.astype(np.float32) - color, axis=-1) for color in colors])
    return (far < NEAR) & (far == far.min(axis=0))


def shares(true: Bools, made: Bools) -> Floats:
    """Return the pixels in the model as a share of the true ones (C, B); NaN where an object is hidden."""
    areas, kept = true.sum((-1, -2)), made.sum((-1, -2))
    return np.where(areas >= FEWEST, kept / np.maximum(areas, 1), np.nan)


def best_overlap(true: Bools, made: Bools) -> float:
    """Return the overlap of an object with the true one (S, S) after the best shift and turn."""
    if not made.any():
        return 0.0
    cv2 = opencv()
    middle, shift = centre(made), centre(true) - centre(made)
    best = 0.0
    for turn in range(TURNS):
        matrix = cv2.getRotationMatrix2D((float(middle[0]), float(middle[1])), turn * 360 / TURNS, 1.0)
        matrix[:, 2] += shift
        turned = cv2.warpAffine(made.astype(np.float32), matrix, made.shape[::-1]) > 0.5
        best = max(best, overlap(true, turned))
    return best


def overlap(one: Bools, other: Bools) -> float:
    """Return the pixels that two objects share, of those that either has."""
    return float((one & other).sum() / max((one | other).sum(), 1))


def centre(mask: Bools) -> Floats:
    """Return the mean place (x, y) of an object's pixels."""
    return np.array([axis.mean() for axis in np.nonzero(mask)[::-1]])


@dataclass(frozen=True)
class Left:
    """What is left of a robot or of loose objects, by their parts of one colour.

    Attributes:
        share: of the true pixels; 1 keeps them, 0 has melted them.
        whole: share of the parts that keep their pixels; a lost one and a doubled one have a mean share of 1.
        shape: overlap of each with the true one after the best shift and turn.
    """

    share: float
    whole: float
    shape: float

    @property
    def intact(self) -> bool:
        return self.whole >= MOST and self.shape >= SHAPED


def left_at(found: Found, frame: int) -> dict[str, Left]:
    """Return what is left of the robot and of loose objects, where large enough to see."""
    own, loose = palettes(found)
    palette = np.concatenate([own, loose])
    true, made = masks_of(found.true[:, frame], palette), masks_of(found.made[:, frame], palette)
    kept, left = shares(true, made), {}
    for name, colors in (("the robot", range(len(own))), ("loose objects", range(len(own), len(palette)))):
        seen = [(color, b) for color in colors for b in np.flatnonzero(np.isfinite(kept[color]))]
        if seen:
            shape = np.mean([best_overlap(true[one], made[one]) for one in seen])
            own_shares = np.array([kept[one] for one in seen])
            whole = (own_shares >= WHOLE[0]) & (own_shares <= WHOLE[1])
            left[name] = Left(float(own_shares.mean()), float(whole.mean()), float(shape))
    return left


def left_words(left: dict[str, Left]) -> str:
    """Return what is left in words, and what does not stay whole."""
    if not left:
        return "nothing was large enough to judge"
    told = [
        f"{one.share:.0%} of {name} left ({one.whole:.0%} whole, shape overlap {one.shape:.0%})"
        for name, one in left.items()
    ]
    torn = [name for name, one in left.items() if not one.intact]
    verdict = f"damaged: {' and '.join(torn)}" if torn else "intact"
    return f"{', '.join(told)}; {verdict}"
