"""Commands outside the range seen in training: told once, of each embodiment, by `HMA.generate`."""

import warnings

import numpy as np
import torch

from hma_model.generation import commands
from hma_model.generation.commands import Commands, described
from hma_model.network.model import HMA
from tests.model.robots import make_model, save

NAMES = {"arm": 2, "crane": 3}


def told(model: HMA, actions: torch.Tensor, known: torch.Tensor | None = None) -> list[str]:
    """Return what is warned of when a sample of each robot is generated."""
    prompt = torch.zeros(2, 2, 2, 3, dtype=torch.long)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.generate(prompt, actions, list(NAMES), 2, known=known)
    assert all(one.filename == __file__ for one in caught)
    return [str(one.message) for one in caught]


def test_actions_outside_the_range_are_told_once_of_each_embodiment(tmp_path, monkeypatch) -> None:
    save(tmp_path, NAMES)
    model = HMA.from_pretrained(tmp_path).eval()
    ends = {"arm": np.array([[-1, -1], [1, 1]]), "crane": np.array([[-9, -9, -9], [9, 9, 9]])}
    monkeypatch.setattr(commands, "_seen", lambda model, name: ends[name].astype(np.float32))
    actions = torch.full((2, 4, 6), 0.5)
    assert told(model, actions) == []
    wide = actions.clone()
    wide[0, :, 4:] = 50  # beyond the arm's chunk of 2 x 2 values, as padding may be
    wide[:, 3] = 50  # and after the last frame
    assert told(model, wide) == []
    wide = actions.clone()
    wide[0, 1, 3] = 2
    known = torch.ones(2, 4, dtype=torch.bool)
    known[0, 1] = False
    assert told(model, wide, known) == []
    (said,) = told(model, wide)
    assert said == "arm: an action is outside the range seen in training (actions.1 -1 to 1). Shown only once"
    assert told(model, wide * 20)[0].startswith("crane: ")
    assert told(model, wide * 20) == []


def test_commands_of_unknown_range_have_no_bounds() -> None:
    own = Commands.of(make_model(NAMES), "crane")
    assert own.seen is None and (own.low == -np.inf).all() and own.low.shape == own.high.shape == (3,)


def test_a_robot_whose_rate_nobody_states_has_commands(tmp_path, monkeypatch) -> None:
    save(tmp_path, NAMES)
    model = HMA.from_pretrained(tmp_path)
    robot = described(model, "arm")
    assert robot is not None and Commands.of(model, "arm").rate_hz == robot.rate_hz
    unstated = robot.model_copy(update={"frequency_hz": "unknown"})
    monkeypatch.setattr(commands, "described", lambda model, name: unstated)
    assert Commands.of(model, "arm").rate_hz is None
