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
    ends = found["psnr_action_gain_last_95"]
    if _unjudged(found) or not ends:
        return False
    return bool(found["psnr_action_gain_last"] >= FOLLOWS_DB and ends[0] > 0)


def verdict(found: Mapping[str, Any]) -> str:
    """Return a sentence about a result of `evaluate`: whether the model follows its actions."""
    if reason := _unjudged(found):
        return reason
    said = _measured(found)
    if follows(found):
        return f"follows its actions: {said}"
    ends = found["psnr_action_gain_last_95"]
    if not ends or max(found["psnr_action_gain_last"], ends[1]) >= FOLLOWS_DB:  # the gain may be as large
        return f"may follow its actions (inconclusive): {said}"
    gained = found.get("loss_action_gain_95")  # of discrete models
    loss, shuffled_loss = found["loss"], found.get("shuffled_loss", 0.0)
    if gained and shuffled_loss >= SENSITIVE * loss and gained[0] > 0:
        unit = token_words(found["merge"])
        nats = f"loss {loss:.2f} nats per {unit}, {shuffled_loss:.2f} with shuffled actions"
        return f"is sensitive to its actions ({nats}), but its rollouts do not follow them yet: {said}"
    return f"does not follow its actions yet: {said}"


def horizon(found: Mapping[str, Any]) -> float:
    """Return the seconds from the last given frame to the last predicted one."""
    return float((found["frames"] - found["prompt"]) * found["seconds_a_frame"])


def _unjudged(found: Mapping[str, Any]) -> str:
    """Return why there is no verdict; empty if there is one."""
    if not found["sees_actions"]:
        return "was trained without actions"
    if 2 * found["unmoved_windows"] > found["windows"]:
        return "cannot be judged: most recorded images do not change"
    if found["psnr_action_gain_last"] is None or found["loss"] is None:
        return "cannot be judged: its predictions are not finite"
    return ""


def _measured(found: Mapping[str, Any]) -> str:
    """Return the gain with its interval, horizon and episodes in words."""
    ends, count, recordings = found["psnr_action_gain_last_95"], found["episodes"], found["recordings"]
    after = f"{horizon(found):.1f} s after the prompt"
    bounds = f"95 % CI {ends[0]:+.1f} to {ends[1]:+.1f}" if ends else "no CI"
    gain = f"last-frame PSNR gain {found['psnr_action_gain_last']:+.1f} dB ({bounds})"
    few = "only " if recordings < FEW_RECORDINGS else ""
    held_out = "held-out " if found["split"] == "val" else ""
    episodes = f"{few}{human_count(count, f'{held_out}episode')}"
    if recordings < count:
        episodes += f" of {human_count(recordings, 'recording')}"
    return f"{gain}, recorded vs shuffled actions, {after}, {episodes}"
