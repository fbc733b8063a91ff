"""Define the training objectives: what each predicts, from what, and what it hides (paper section 3).

forward: predict masked video from past video and actions. passive: the same without actions. policy: predict
the chunk to command from each frame on. inverse: predict the chunk that led from one frame to the next. full:
video and policy together.

A new objective is a row of `OBJECTIVES`; all other code asks a row's attributes and compares no names.
This module is free of torch; `hma_model.network.objectives` computes the losses.
"""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Readout:
    """A readout of action chunks from the frames.

    Attributes:
        name: the layer of `ActionHead` that reads.
        lag: chunk k is read from frame k + lag.
    """

    name: str
    lag: int


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


POLICY = Readout("policy", lag=0)  # the chunk to command from the frame on
INVERSE = Readout("inverse", lag=1)  # the chunk that led to the frame
READOUTS: Mapping[str, Readout] = {readout.name: readout for readout in (POLICY, INVERSE)}

OBJECTIVES: Mapping[str, Objective] = {  # paper section 3
    objective.name: objective
    for objective in (
        Objective("forward", predicts_video=True, sees_actions=True, readout=None),
        Objective("passive", predicts_video=True, sees_actions=False, readout=None),
        Objective("policy", predicts_video=False, sees_actions=True, readout=POLICY),
        Objective("full", predicts_video=True, sees_actions=True, readout=POLICY),
        Objective("inverse", predicts_video=False, sees_actions=True, readout=INVERSE),
    )
}
