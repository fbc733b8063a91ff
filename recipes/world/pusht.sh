#!/usr/bin/env bash
# Record a pusher and a T, choose their colours, train a world model of them, and measure whether the T holds.
#
#     recipes/world/pusht.sh OUT [key=value …]       # 2 CPU hours of training on each of two processes
#
# Everything continues where it was. EPISODES (750) are recorded, each kept in the eight mirrors of the table.
set -euo pipefail
out=$1
shift
here=$(cd "$(dirname "$0")/../.." && pwd)
mkdir -p "$out"
python "$here/recipes/lab/pushes.py" "$out" --planned 0 --noisy 0 --contact "${EPISODES:-750}" --mirrored --seed 900
recording=$out/contact/pusht_fast.hdf5
[ -e "$out/colors.safetensors" ] ||
    hma tokenizer fit "$recording" -e pusht_fast --colors 16 --out "$out/colors.safetensors"
hma convert "$recording" -e pusht_fast --tokenizer palette-64 --weights "$out/colors.safetensors" \
    --frames strided --val-fraction 0.02 --out "$out/shards"
train() {
    OMP_NUM_THREADS=1 torchrun --nproc-per-node "${PROCESSES:-2}" --no-python hma train "$1" "data=$out/shards" "${@:2}"
}
train world_pusht "$@" --out "$out/squares"
train world_whole "$@" "start=$out/squares" --out "$out/run"
hma bench holds checkpoint="$out/run" robots=pusht_fast driver=contact frames=45 prompt=5 seed=5012 rollouts=48 \
    sheet="$out/holds.png" | tee "$out/holds.txt"
