"""Say in a sentence whether a model follows its actions: one rule for every command, page and card."""

from collections.abc import Mapping
from typing import Any

from hma_model.config import token_words

FOLLOWS_DB = 0.5  # gain of the last frame's PSNR from which a model is said to follow its actions
SENSITIVE = 1.2  # and times the loss with shuffled actions from which it is said to be sensitive to them


def verdict(found: Mapping[str, Any]) -> str:
    """Return a sentence about the result of `evaluate`: whether the model follows its actions."""
    if not found.get("sees_actions", True):
        return "was trained without actions"
    if 2 * found.get("unmoved_windows", 0) > found.get("windows", 0):
        return "cannot be judged: most of the true pictures never change"
    gain = found["psnr_action_gain_last"]
    if gain is None or found.get("loss", 0.0) is None:
        return "cannot be judged: its predictions are not finite"
    ends, count = found.get("psnr_action_gain_last_95"), found.get("episodes", 0)
    said = f"{gain:+.1f} dB on the last frame, true less shuffled actions"
    if ends:
        said += f", 95 %: {ends[0]:+.1f} to {ends[1]:+.1f} over {count} episodes"
    elif count == 1:
        said += ", of one episode"
    if gain >= FOLLOWS_DB and ends and ends[0] <= 0:
        return f"may follow its actions: {said}, too few to be sure"
    if gain >= FOLLOWS_DB:
        return f"follows its actions: {said}"
    loss, shuffled_loss = found.get("loss"), found.get("shuffled_loss")
    if loss and shuffled_loss and shuffled_loss >= SENSITIVE * loss:
        unit = token_words(found.get("merge") or 1)
        nats = f"{loss:.2f} nats a {unit}, {shuffled_loss:.2f} with shuffled ones"
        return f"is sensitive to its actions ({nats}), but its rollouts show little of it yet: {said}"
    return f"does not follow its actions yet ({said})"
