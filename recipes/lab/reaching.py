"""Record a task that a policy can learn, and let a world model make more of it: the paper's Table 6, small.

    python recipes/lab/reaching.py build/reach             # mover_04 goes to the nearest block; and it plays
    for n in 100 500 1000; do hma convert -e build/reach/mover_04.yaml --source build/reach/reach.hdf5 \\
        --limit $n --tokenizer fsq-lab --frames strided --val-fraction 0.01 \\
        --out build/reach/shards/real_$n; done
    hma convert -e build/reach/mover_04.yaml --source build/reach/mover_04.hdf5 --tokenizer fsq-lab \\
        --frames strided --out build/reach/shards/play
    hma augment mover_04 build/reach/shards/made --from build/reach/shards/play --episodes 400 \\
        --commands reach --judge reached --keep 1 --frames 20
    hma shards merge build/reach/shards/real_100 build/reach/shards/made --out build/reach/shards/both
    for data in real_100 both real_500 real_1000; do hma finetune --from embedded \\
        --data build/reach/shards/$data "objectives={policy: 1.0}" frames=2 batch_size=32 lr=1e-3 \\
        muon_lr=0.01 steps=100000 cpu_seconds=180 eval_every=0 pictures=0 --out runs/reach/$data; done
    hma policy-eval mover_04 hma:runs/reach/{real_100,both,real_500,real_1000},memory=1 reach still \\
        --judge reached --frames 20 --episodes 64 --out policies

What is made begins at real frames of the robot at play, and the driver acts in the model, by what its
pictures show. docs/results-log.md has the figures.
"""

import argparse
from pathlib import Path

from hma_data.lab import family, record, whole

ROBOT, SEED = "mover_04", 51


def main() -> None:
    """Record what is not there yet."""
    parser = argparse.ArgumentParser(description="Record reaches for the nearest block, and play")
    parser.add_argument("out", type=Path)
    parser.add_argument("--reaches", type=int, default=1000)
    parser.add_argument("--play", type=int, default=90, help="episodes of random manoeuvres")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / f"{ROBOT}.yaml").write_text(family.embodiment(ROBOT).to_yaml(), encoding="utf-8")
    final = given.out / "reach.hdf5"
    if not final.exists():
        with whole(final) as part:
            family.record_reaching(part, ROBOT, range(given.reaches), SEED)
    print(f"{final}: {given.reaches} episodes")
    final = given.out / f"{ROBOT}.hdf5"
    if not final.exists():
        record(ROBOT, given.out, given.play, SEED + 10)
    print(f"{final}: {given.play} episodes")


if __name__ == "__main__":
    main()
