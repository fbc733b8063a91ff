#!/usr/bin/env bash
# Record the arms of `embedded-arms` in their simulators, and train a world model of them.
#
#     recipes/world/arms.sh OUT [key=value …]        # 60 CPU minutes of training on each of two processes
#
# Everything continues where it was. The simulators' packages are installed by uv, each for itself; PROCESSES
# (2) train.
set -euo pipefail
out=$1
shift
here=$(cd "$(dirname "$0")/../.." && pwd)
mkdir -p "$out/shards"
data=""
for robot in fetch:480 panda:100 sawyer:80; do # robot and episodes
    name=${robot%:*}
    [ -e "$out/shards/$name/manifest.json" ] || {
        uv run "$here/recipes/lab/$name.py" "$out" --episodes "${robot#*:}" --seed 7
        hma convert "$out/$name"* -e "$name" --tokenizer palette-64 --frames strided --val-fraction 0.08 \
            --out "$out/shards/$name"
    }
    data="$data,$out/shards/$name"
done
OMP_NUM_THREADS=1 torchrun --nproc-per-node "${PROCESSES:-2}" --no-python \
    hma train world_unet "data=[${data#,}]" start=embedded-lab2 self_forward_from=1500 "$@" --out "$out/run"
