#!/usr/bin/env bash
# Record a Fetch arm in its simulator, train a world model of it, and film a held-out episode.
#
#     recipes/world/fetch.sh OUT [key=value …]        # 56 CPU minutes of training on one process
#
# Everything continues where it was. EPISODES (480) are recorded; uv installs the simulator's packages.
set -euo pipefail
out=$1
shift
here=$(cd "$(dirname "$0")/../.." && pwd)
mkdir -p "$out"
uv run "$here/recipes/lab/fetch.py" "$out" --episodes "${EPISODES:-480}" --seed 7
hma convert "$out/fetch.hdf5" -e fetch --tokenizer palette-64 --frames strided --out "$out/shards"
OMP_NUM_THREADS=1 hma train world_unet "data=$out/shards" start=embedded-lab2 batch_size=16 \
    self_forward=0.7 self_forward_from=1500 cpu_seconds=3350 "$@" --out "$out/run"
python "$here/recipes/world/film.py" fetch --checkpoint "$out/run" --shards "$out/shards" --out "$out/film.webp"
