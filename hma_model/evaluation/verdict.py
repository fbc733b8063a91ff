"""Decide whether a model follows its actions: one rule for every command, page and card.

The measure is the PSNR gain of a rollout's last frame, recorded vs shuffled actions. A model follows its
actions if the mean gain is FOLLOWS_DB or more and its 95 % interval lies above 0. It does not if the interval
ends below FOLLOWS_DB. The interval is over held-out recordings, so one recording gives no verdict. A model
that does not follow is sensitive if shuffled actions raise its loss to SENSITIVE times or more, and the 95 %
interval of the increase lies above 0.
"""

from collections.abc import Mapping
from typing import Any

from hma_data.console import human_count
from hma_model.config import token_words

FOLLOWS_DB = 0.5  # least mean PSNR gain of the last frame
SENSITIVE = 1.2  # least ratio of the losses with shuffled and recorded actions for a sensitive model
FEW_RECORDINGS = 5  # with fewer, the verdict says "only"


def follows(found: Mapping[str, Any]) -> bool:
    """Check whether a result of `evaluate` shows that the model follows its actions."""
    gain, ends = found.get("psnr_action_gain_last"), found.get("psnr_action_gain_last_95")
    if _unjudged(found) or gain is None or not ends:
        return False
    return bool(gain >= FOLLOWS_DB and ends[0] > 0)


def verdict(found: Mapping[str, Any]) -> str:
    """Return a sentence about a result of `evaluate`: whether the model follows its actions."""
    if reason := _unjudged(found):
        return reason
    said = _measured(found)
    if follows(found):
        return f"follows its actions: {said}"
    ends = found.get("psnr_action_gain_last_95")
    if not ends or max(found["psnr_action_gain_last"], ends[1]) >= FOLLOWS_DB:  # the gain may be as large
        return f"may follow its actions (inconclusive): {said}"
    loss, shuffled_loss = found.get("loss"), found.get("shuffled_loss")
    gained = found.get("loss_action_gain_95")
    if loss and gained and shuffled_loss >= SENSITIVE * loss and gained[0] > 0:
        unit = token_words(found.get("merge") or 1)
        nats = f"loss {loss:.2f} nats per {unit}, {shuffled_loss:.2f} with shuffled actions"
        return f"is sensitive to its actions ({nats}), but its rollouts do not follow them yet: {said}"
    return f"does not follow its actions yet: {said}"


def horizon(found: Mapping[str, Any]) -> float | None:
    """Return the seconds from the last given frame to the last predicted one; None if they are not stated."""
    if "seconds_a_frame" not in found:
        return None
    return float((found["frames"] - found["prompt"]) * found["seconds_a_frame"])


def _unjudged(found: Mapping[str, Any]) -> str:
    """Return why there is no verdict; empty if there is one."""
    if not found.get("sees_actions", True):
        return "was trained without actions"
    if 2 * found.get("unmoved_windows", 0) > found.get("windows", 0):
        return "cannot be judged: most recorded images do not change"
    if found["psnr_action_gain_last"] is None or found.get("loss", 0.0) is None:
        return "cannot be judged: its predictions are not finite"
    return ""


def _measured(found: Mapping[str, Any]) -> str:
    """Return the gain with its interval, horizon and episodes in words."""
    seconds, ends = horizon(found), found.get("psnr_action_gain_last_95")
    count = found.get("episodes", 0)
    recordings = found.get("recordings", count)
    after = "" if seconds is None else f", {seconds:.1f} s after the prompt"
    bounds = f"95 % CI {ends[0]:+.1f} to {ends[1]:+.1f}" if ends else "no CI"
    gain = f"last-frame PSNR gain {found['psnr_action_gain_last']:+.1f} dB ({bounds})"
    few = "only " if recordings < FEW_RECORDINGS else ""
    held_out = "held-out " if found.get("split", "val") == "val" else ""
    episodes = f"{few}{human_count(count, f'{held_out}episode')}"
    if recordings < count:
        episodes += f" of {human_count(recordings, 'recording')}"
    return f"{gain}, recorded vs shuffled actions{after}, {episodes}"
