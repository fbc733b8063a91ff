"""Record pushes of a T by good and by bad drivers, for a world model in which policies are scored.

    python recipes/lab/pushes.py build/pushes
    for part in planned noisy; do hma convert build/pushes/$part/pusht_fast.hdf5 -e pusht_fast \\
        --tokenizer fsq-lab --frames strided --val-fraction 0.05 --out build/pushes/shards/$part; done
    hma shards merge build/pushes/shards/planned build/pushes/shards/noisy --out build/pushes/shards/all
    hma finetune build/pushes/shards/all --from embedded --out runs/pushes \\
        batch_size=4 cpu_seconds=3250 steps=100000 ema=0.995 self_forward=0.15 self_forward_from=0
    hma policy-eval pusht_fast scripted scripted:noise=0.1 scripted:noise=0.25 scripted:noise=0.5 random \\
        still --checkpoint runs/pushes --judge placed --frames 40 --out policies

The noisy part has episodes in which 10 to 100 % of the commands are random: a model that has seen good
pushes alone is kind to bad policies. `--play N` records a third part, in pictures of 96 px, in which most
episodes wander: gym-pusht as people record it themselves. docs/results.md has the figures, and how
ours was trained.
"""

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.console import run_script
from hma_data.errors import UsageError
from hma_data.lab import pusht
from hma_data.lab.pusher import Planned, Wandering
from hma_data.lab.tee_table import SIDE, TICK_S
from hma_data.lab.truth import TrueEpisode
from hma_data.lab.writers import Demo
from hma_data.storage.files import part_of

NOISE = (0.1, 0.25, 0.5, 0.75, 1.0)  # shares of random targets
PLAY_LOOK = pusht.FAST_LOOK._replace(size=96)
PLAY_STARTS = ("random", "near", "random", "far", "random")


def record_noisy(part: Path, episodes: Iterable[int], seed: int) -> None:
    """Record each group of episodes with another share of random targets.

    So a world model also sees what bad policies do.
    """

    def share(episode: int) -> float:
        return NOISE[episode // len(pusht.STARTS) % len(NOISE)]

    pusht.write_fast(part, (pusht.fast_demo(seed, episode, share(episode)) for episode in episodes))


def record_play(part: Path, episodes: Iterable[int], seed: int) -> None:
    """Record at 96 px, as gym-pusht's own recordings are; most episodes wander."""
    demos = (pusht.fast_demo(seed, episode, look=PLAY_LOOK, starts=PLAY_STARTS) for episode in episodes)
    pusht.write_fast(part, demos, PLAY_LOOK)


CONTACT_STEPS = 100
AIM_STEPS = (25, 60)  # between two goals


def contact_demo(seed: int, episode: int) -> Demo:
    """Simulate pushes towards goals that are drawn anew all the time: contact of every kind, everywhere.

    Of five episodes three aim, one of these with random targets in between, and one wanders.
    """
    rng = np.random.default_rng((seed, 3, episode))
    arena = pusht.PushArena(pusht.FAST_LOOK, ("near", "far", "far")[episode % 3], rng)
    wanders, strays = episode % 5 == 4, episode % 5 == 3

    def aimed() -> pusht.Targets:
        if wanders:
            return pusht.Targets(Wandering(arena.agent, False, rng), arena.agent)
        goal = np.array([*rng.uniform(110, 400, 2), rng.uniform(-np.pi, np.pi)])
        speed = pusht.SPEED * rng.uniform(0.7, 1.3)
        return pusht.Targets(Planned(arena.tee, goal, arena.agent, speed, False, rng), arena.agent)

    targets, until, stray = aimed(), 0, None
    rows: list[tuple[Any, ...]] = []
    for step in range(CONTACT_STEPS):
        if step == until:
            targets, until = aimed(), step + int(rng.integers(*AIM_STEPS))
        if strays and step % pusht.STEPS_HELD == 0:
            stray = rng.uniform(15, 497, 2).astype(np.float32) if rng.random() < 0.3 else None
        action = targets.next(arena.pose, arena.agent)
        action = action if stray is None else stray
        seen = arena.picture(), arena.agent, arena.state
        arena.advance(action.astype(np.float64), round(pusht.FAST_PERIOD_S / TICK_S))
        rows.append((*seen, action, arena.reward))
    images, positions, states, actions, rewards = map(np.stack, zip(*rows, strict=True))
    observations = {"image": images, "agent_pos": positions}
    return Demo(actions, observations, states, rewards, arena.success, {"start": "contact", "seed": seed})


def contact_episode(frames: int, stride: int, seed: int, episode: int) -> TrueEpisode:
    """Return a recorded episode of contact with the places of its parts; `seed` is that of its recording.

    Raises:
        UsageError: an episode has fewer frames.
    """
    if frames * stride > CONTACT_STEPS:
        most = CONTACT_STEPS // stride
        raise UsageError("driver=contact", f"has {most} frames an episode, not {frames}", "give fewer frames")
    demo = contact_demo(seed, episode)
    rows = slice(0, frames * stride, stride)
    tees = [pusht.tee_places(state[2:5]) for state in demo.states[rows]]
    disc = demo.observations["agent_pos"][rows, None] * pusht.PX
    parts = np.concatenate([disc, np.stack(tees)], axis=1)
    chunks = demo.actions[: frames * stride].reshape(frames, -1).astype(np.float32)
    return TrueEpisode(demo.observations["image"][rows], chunks, parts, demo.states[rows], driven=1)


MIRRORS = tuple(product((False, True), repeat=3))


def mirrored(demo: Demo, transposed: bool, across: bool, down: bool) -> Demo:
    """Return an episode of contact as a mirror shows it; the table, the T and friction are symmetric."""
    images = demo.observations["image"]

    def places(values: Any) -> Any:
        values = values[:, ::-1] if transposed else values
        ends = np.array([SIDE if across else 0, SIDE if down else 0], values.dtype)
        return np.abs(ends - values)

    images = images.swapaxes(1, 2) if transposed else images
    images = images[:, :: -1 if down else 1, :: -1 if across else 1]
    observations = {
        "image": np.ascontiguousarray(images),
        "agent_pos": places(demo.observations["agent_pos"]),
    }
    return replace(demo, actions=places(demo.actions), observations=observations)


def record_contact(part: Path, episodes: Iterable[int], seed: int, ways: Sequence[Any] = MIRRORS[:1]) -> None:
    """Record `contact_demo` in each of the mirrors."""
    demos = (contact_demo(seed, episode) for episode in episodes)
    pusht.write_fast(part, (mirrored(demo, *way) for demo in demos for way in ways))


def main() -> None:
    """Record the parts; a part that is there is kept."""
    parser = argparse.ArgumentParser(description="Record pushes of good and of bad drivers")
    parser.add_argument("out", type=Path)
    parser.add_argument("--planned", type=int, default=1200, help="episodes of the recorder's own driver")
    parser.add_argument("--noisy", type=int, default=900, help="episodes with random commands among its own")
    parser.add_argument("--play", type=int, default=0, help="episodes at 96 px, most of which wander")
    parser.add_argument(
        "--contact", type=int, default=0, help="episodes that push towards one goal after another"
    )
    parser.add_argument("--mirrored", action="store_true", help="these in all eight mirrors of the table")
    parser.add_argument("--seed", type=int, default=7)
    given = parser.parse_args()
    planned = partial(pusht.record, robot="pusht_fast")
    contact = partial(record_contact, ways=MIRRORS if given.mirrored else MIRRORS[:1])
    for name, record, count, seed in (
        ("planned", planned, given.planned, given.seed),
        ("noisy", record_noisy, given.noisy, given.seed + 4),
        ("play", record_play, given.play, given.seed + 8),
        ("contact", contact, given.contact, given.seed + 12),
    ):
        file = given.out / name / "pusht_fast.hdf5"
        if count and not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            part = part_of(file)
            record(part, episodes=range(count), seed=seed)
            part.replace(file)
        if file.exists():
            print(file)


if __name__ == "__main__":
    run_script(main)
