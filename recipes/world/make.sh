#!/usr/bin/env bash
# Record the robots of `embedded-lab`, train a world model of them, and measure whether robots and objects hold.
#
#     recipes/world/make.sh OUT [key=value …]        # 60 CPU minutes of training on each of two processes
#
# Everything continues where it was. EPISODES (1200) of each robot are recorded, by WORKERS (2) processes;
# PROCESSES (2) train. On a GPU:
#     WORKERS=16 PROCESSES=1 recipes/world/make.sh OUT cpu_seconds=480 batch_size=256 lr=3e-3 compile=true
set -euo pipefail
out=$1
shift
here=$(cd "$(dirname "$0")/../.." && pwd)
robots="arm2_02 arm2_07 arm3_04 arm4_01 crane_04 mover_10 planar_arm pusht_slow"
mkdir -p "$out"
# shellcheck disable=SC2086
OMP_NUM_THREADS=1 python "$here/recipes/world/record.py" "$out" --episodes "${EPISODES:-1200}" --seed 40 --pushing \
    --workers "${WORKERS:-2}" --tokenizer palette-64 --robots $robots
# shellcheck disable=SC2086
data=$(printf "$out/shards/%s," $robots)
train() {
    OMP_NUM_THREADS=1 torchrun --nproc-per-node "${PROCESSES:-2}" --no-python \
        hma train "$1" "data=[${data%,}]" "${@:2}"
}
train world_unet "$@" --out "$out/squares"
train world_whole "$@" "start=$out/squares" --out "$out/run"
hma bench holds checkpoint="$out/run" robots=arm3_04,mover_10,planar_arm frames=300 sheet="$out/holds.png" |
    tee "$out/holds.txt"
