#!/usr/bin/env bash
# Record a Fetch arm that carries a block, train a world model of it, measure and film it.
#
#     recipes/world/fetch.sh OUT [key=value …]        # 70 CPU minutes of training on each of two processes
#
# Everything continues where it was. EPISODES (800) are recorded in four parts; `uv` installs the simulator.
set -euo pipefail
out=$1
shift
here=$(cd "$(dirname "$0")/../.." && pwd)
mkdir -p "$out/recordings"
for part in 7 8 9 10; do
    [ -e "$out/recordings/$part.hdf5" ] && continue
    [ -e "$out/part/fetch.hdf5" ] ||
        uv run "$here/recipes/lab/fetch.py" "$out/part" --episodes $((${EPISODES:-800} / 4)) --seed "$part"
    mv "$out/part/fetch.hdf5" "$out/recordings/$part.hdf5"
done
hma convert "$out/recordings" -e fetch --tokenizer palette-64 --frames strided --out "$out/shards"
OMP_NUM_THREADS=1 torchrun --nproc-per-node "${PROCESSES:-2}" --no-python \
    hma train world_fetch "data=$out/shards" "$@" --out "$out/run"
hma evaluate "$out/run" "$out/shards" --windows 24 | tee "$out/evaluation.txt"
python "$here/recipes/world/film.py" fetch --checkpoint "$out/run" --shards "$out/shards" --scenes 2 5 10 \
    --out "$out/film.webp"
