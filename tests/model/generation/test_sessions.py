"""Rows of a rollout as sessions of their own: each generates what it generates alone."""

from itertools import count
from typing import Any

import pytest
import torch

from hma_data.errors import HMAError
from hma_model.generation.rollout import Rollout
from hma_model.network.model import HMA
from hma_model.network.trunks.contract import Carried
from tests.model.generation.test_generate import LAYOUTS
from tests.model.network_parts import ARM, HAND, small_model

WIDEST = max(ARM.chunk_dim, HAND.chunk_dim)


class Session:
    def __init__(self, model: HMA, number: int, name: str, prompt: int) -> None:
        drawn, config = torch.Generator().manual_seed(number), model.config
        self.name, self.seed, self.made, self.at = name, number, [], count()
        if config.kind == "discrete":
            shape = (1, prompt, *config.frame_shape)
            self.frames = torch.randint(0, config.vocab_size, shape, generator=drawn)
        else:
            self.frames = torch.randn(1, prompt, *config.frame_shape, generator=drawn)
        self.before = torch.randn(1, prompt, WIDEST, generator=drawn)
        self.known_before = torch.rand(1, prompt, generator=drawn) < 0.7
        self.chunks = torch.randn(40, 1, WIDEST, generator=drawn)
        self.known = torch.rand(40, 1, generator=drawn) < 0.7

    def begin(self, rollout: Rollout, row: int) -> None:
        rollout.reset([row], self.frames, self.before, self.known_before, [self.seed], [self.name])


def advance(rollout: Rollout, sessions: dict[int, Session]) -> None:
    at = [next(session.at) for session in sessions.values()]
    chunks = torch.cat([s.chunks[i] for s, i in zip(sessions.values(), at)])
    known = torch.cat([s.known[i] for s, i in zip(sessions.values(), at)])
    made = rollout.step(chunks, known=known, rows=list(sessions))
    for session, frame in zip(sessions.values(), made):
        session.made.append(frame)


def alone(model: HMA, session: Session, how: dict[str, Any]) -> list[torch.Tensor]:
    rollout = Rollout(model, session.name, **how)
    session.begin(rollout, 0)
    steps = zip(session.chunks, session.known)
    return [rollout.step(chunk, known=known)[0] for _, (chunk, known) in zip(session.made, steps)]


def play(model: HMA, rollout: Rollout) -> list[Session]:
    """Let sessions of two robots begin, end and pause at different times; return them all."""
    first, late, long = (
        Session(model, 1, "arm", 2),
        Session(model, 2, "hand.v1", 1),
        Session(model, 3, "hand.v1", 7),
    )
    first.begin(rollout, 0)
    for _ in range(2):
        advance(rollout, {0: first})
    late.begin(rollout, 2)
    advance(rollout, {2: late, 0: first})  # not in the order of the rows
    long.begin(rollout, 1)
    for _ in range(4):
        advance(rollout, {0: first, 1: long, 2: late})
    again = Session(model, 4, "hand.v1", 3)  # another robot in the row
    again.begin(rollout, 0)
    advance(rollout, {1: long, 2: late})
    for _ in range(3):
        advance(rollout, {0: again, 1: long, 2: late})
    return [first, late, long, again]


@pytest.mark.parametrize(
    ("layout", "order", "cache"),
    [(layout, "random", True) for layout in LAYOUTS]
    + [("rotary", "confidence", True), ("rotary", "random", False), ("learned", "random", False)],
)
def test_a_row_gets_the_tokens_that_it_gets_alone(layout: str, order: str, cache: bool) -> None:
    model = small_model(**LAYOUTS[layout])
    how = {"unmask_steps": 3, "temperature": 0.7, "order": order, "cache": cache}
    for session in play(model, Rollout(model, "arm", 3, **how)):
        assert torch.equal(torch.stack(session.made), torch.stack(alone(model, session, how)))


@pytest.mark.parametrize("layout", ["rotary", "released"])
def test_a_row_gets_the_latents_that_it_gets_alone(layout: str) -> None:
    model = small_model(kind="continuous", **LAYOUTS[layout])
    for parameter in model.latent_readout.diffusion.parameters():
        parameter.data *= 0.1  # the noisiest level divides by almost nothing, which would enlarge rounding
    how = {"unmask_steps": 2, "temperature": 0.5}
    for session in play(model, Rollout(model, "arm", 3, **how)):
        torch.testing.assert_close(torch.stack(session.made), torch.stack(alone(model, session, how)))


@pytest.mark.parametrize("layout", ["rotary", "learned", "chain"])
def test_compiled_code_computes_idle_rows_without_a_trace(layout: str) -> None:
    model, how = small_model(**LAYOUTS[layout]), {"temperature": 0.7}
    rollout = Rollout(model, "arm", 3, **how)
    shapes = set()

    def trunk(x: torch.Tensor, *rest: Any) -> torch.Tensor:
        shapes.add(x.shape[:2])
        return model.trunk(x, *rest)

    rollout.engine.compiled = trunk
    for session in play(model, rollout):
        assert torch.equal(torch.stack(session.made), torch.stack(alone(model, session, how)))
    assert shapes == {(3, 1), (3, 2)}


@pytest.mark.parametrize("layout", ["released", "cross", "merged"])
def test_a_snapshot_goes_on_in_any_row_of_any_rollout(layout: str) -> None:
    model = small_model(**LAYOUTS[layout])
    rollout, other = Rollout(model, "arm", 2, temperature=0.7), Rollout(model, "hand.v1", 3, temperature=0.7)
    sessions = {0: Session(model, 1, "arm", 3), 1: Session(model, 2, "hand.v1", 2)}
    for row, session in sessions.items():
        session.begin(rollout, row)
    for _ in range(4):
        advance(rollout, sessions)
    kept = rollout.snapshot([1])
    chunks = torch.randn(4, 1, WIDEST, generator=torch.Generator().manual_seed(7))
    made = [rollout.step(chunk, rows=[1]) for chunk in chunks]
    Session(model, 5, "arm", 4).begin(other, 0)
    other.restore([2], kept)
    rollout.restore([1], kept)
    for into, row in ((other, 2), (rollout, 1)):
        assert all(torch.equal(into.step(c, rows=[row]), frame) for c, frame in zip(chunks, made))
    advance(rollout, sessions)
    expected = alone(model, sessions[0], {"temperature": 0.7})
    assert torch.equal(torch.stack(sessions[0].made), torch.stack(expected))
    with pytest.raises(HMAError, match="is of cache=True"):
        Rollout(model, "hand.v1", 1, cache=False).restore([0], kept)


def test_a_fork_of_some_rows_copies_these_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    model = small_model()
    rollout, sessions = Rollout(model, "arm", 4), {row: Session(model, row, "arm", 2) for row in range(4)}
    for row, session in sessions.items():
        session.begin(rollout, row)
    advance(rollout, sessions)
    take, copied = Carried.take, list[int]()
    monkeypatch.setattr(Carried, "take", lambda own, rows: copied.append(len(rows)) or take(own, rows))
    fork = rollout.fork(2, [1])
    assert copied == [2]
    chunk, known = sessions[1].chunks[1], sessions[1].known[1]
    own = rollout.step(chunk, known=known, rows=[1])
    assert torch.equal(fork.step(chunk.expand(2, -1), known=known.expand(2)), own.expand(2, -1, -1))


def test_forks_part_with_their_chunks_and_leave_the_rollout_as_it_is() -> None:
    model = small_model()
    rollout, sessions = Rollout(model, "arm", 2, temperature=0.7), {}
    for row, name in enumerate(("arm", "hand.v1")):
        sessions[row] = Session(model, row, name, 3)
        sessions[row].begin(rollout, row)
    advance(rollout, sessions)
    fork = rollout.fork(2)
    chunks = torch.randn(4, WIDEST, generator=torch.Generator().manual_seed(7))
    forked = torch.stack([fork.step(chunks * scale) for scale in (1, 3, 3)])
    for part in (0, 1):
        steps = Rollout(model, ["arm", "hand.v1"], 2, temperature=0.7)
        steps.restore([0, 1], rollout.snapshot())
        mine = torch.stack([steps.step(chunks[part::2] * scale) for scale in (1, 3, 3)])
        assert torch.equal(mine, forked[:, part::2])
    assert not torch.equal(forked[:, 0], forked[:, 1])


def test_the_cache_stays_in_place_over_prompts_and_resets() -> None:
    model = small_model()
    rollout = Rollout(model, "arm", 3)
    play(model, rollout)
    before = [memory.data_ptr() for memory in rollout.state.carried.memory]
    rollout.prompt(torch.zeros(3, 2, 4, 4, dtype=torch.long), None)
    rollout.step(torch.zeros(3, WIDEST))
    assert [memory.data_ptr() for memory in rollout.state.carried.memory] == before


@pytest.mark.parametrize(
    ("rows", "message"), [([1], "row 1 has no prompt"), ([0, 0], "are not rows"), ([2], "are not rows")]
)
def test_rows_that_cannot_step_are_refused(rows: list[int], message: str) -> None:
    model = small_model()
    rollout = Rollout(model, "arm", 2)
    Session(model, 1, "arm", 2).begin(rollout, 0)
    with pytest.raises(HMAError, match=message):
        rollout.step(torch.zeros(len(rows), WIDEST), rows=rows)
