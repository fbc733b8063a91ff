"""Record pushes of a T by good and by bad drivers, for a world model in which policies are scored.

    python recipes/lab/pushes.py build/pushes
    for part in planned noisy; do hma convert -e pusht_fast --source build/pushes/$part/pusht_fast.hdf5 \\
        --tokenizer fsq-lab --frames strided --val-fraction 0.05 --out build/pushes/shards/$part; done
    hma shards merge build/pushes/shards/planned build/pushes/shards/noisy --out build/pushes/shards/all
    hma finetune --from embedded --data build/pushes/shards/all --out runs/pushes \\
        batch_size=4 cpu_seconds=3250 steps=100000 ema=0.995 self_forward=0.15 self_forward_from=0
    hma policy-eval pusht_fast scripted scripted:noise=0.1 scripted:noise=0.25 scripted:noise=0.5 random \\
        still --checkpoint runs/pushes --judge placed --frames 20 --out policies

The noisy half has episodes in which 10 to 100 % of the commands are random: a model that has seen good
pushes alone is kind to bad policies. docs/results-log.md has the figures, and how ours was trained.
"""

import argparse
from pathlib import Path

from hma_data.lab import pusht, record
from hma_data.storage.files import part_of

NAME = "pusht_fast.hdf5"


def main() -> None:
    """Record both halves; a half that is there is kept."""
    parser = argparse.ArgumentParser(description="Record pushes of good and of bad drivers")
    parser.add_argument("out", type=Path)
    parser.add_argument("--planned", type=int, default=1200, help="episodes of the recorder's own driver")
    parser.add_argument("--noisy", type=int, default=900, help="episodes with random commands among its own")
    parser.add_argument("--seed", type=int, default=7)
    given = parser.parse_args()
    planned, noisy = given.out / "planned", given.out / "noisy" / NAME
    if not (planned / NAME).exists():
        record("pusht_fast", planned, given.planned, given.seed)
    if not noisy.exists():
        noisy.parent.mkdir(parents=True, exist_ok=True)
        part = part_of(noisy)
        pusht.record_noisy(part, range(given.noisy), given.seed + 4)
        part.replace(noisy)
    print(f"{planned / NAME}: {given.planned} episodes; {noisy}: {given.noisy}")


if __name__ == "__main__":
    main()
