#!/usr/bin/env bash
# Record the robots of the world model, train it, let the rate fall, and measure whether objects hold.
#
#     recipes/world/make.sh OUT [SECONDS] [key=value …]        # SECONDS of the training, 86,400 by default
#
# Everything continues where it was: recordings and shards that are complete are kept, the training resumes.
# EPISODES (400) and CONTACT (4,000) say how much is recorded, WORKERS (2) by how many processes. On a GPU:
#     WORKERS=16 recipes/world/make.sh OUT 900 batch_size=256 lr=3e-3 compile=true
set -euo pipefail
out=$1 seconds=${2:-86400}
shift $(($# < 2 ? $# : 2))
here=$(cd "$(dirname "$0")/../.." && pwd)
episodes=${EPISODES:-400} contact=${CONTACT:-4000} workers=${WORKERS:-2}
robots="arm1_02 arm1_03 arm2_02 arm2_07 arm3_04 arm4_01 crane_04 gantry_04 mover_04 mover_10 rails_03 rails_09
    pendulum planar_arm pusht_slow"
mkdir -p "$out"

# shellcheck disable=SC2086
python "$here/recipes/world/record.py" "$out" --episodes "$episodes" --workers "$workers" --tokenizer palette-64 \
    --seed 300 --robots $robots
parts=$(((contact + 999) / 1000))
push() { # a thousand episodes; the recording goes when its shards are complete
    [ -e "$out/push/$1/manifest.json" ] && return
    python "$here/recipes/lab/pushes.py" "$out/record/$1" --planned 0 --noisy 0 \
        --contact $((contact / parts)) --seed $((200 + $1))
    hma convert "$out/record/$1/contact/pusht_fast.hdf5" -e pusht_fast --tokenizer palette-64 \
        --frames strided --out "$out/push/$1"
    rm -r "$out/record/$1"
}
export -f push
export out here contact parts
seq 0 $((parts - 1)) | xargs -P "$workers" -I{} bash -euc 'push {}'
[ -e "$out/shards/pusht_fast/manifest.json" ] ||
    hma shards merge $(seq -f "$out/push/%g" 0 $((parts - 1))) --out "$out/shards/pusht_fast"

data=$(printf "$out/shards/%s," $robots pusht_fast)
hma train world_unet "data=[${data%,}]" cpu_seconds="$seconds" "$@" --out "$out/run"
hma train world_unet "data=[${data%,}]" start="$out/run" schedule=cosine lr_end=0.02 \
    cpu_seconds=$((seconds / 5)) self_forward_from=0 "$@" --out "$out/final"
hma bench holds checkpoint="$out/final" robots=pusht_fast,arm3_04,planar_arm frames=300 sheet="$out/holds.png" |
    tee "$out/holds.txt"
sha256sum "$out"/final/checkpoints/*/trunk.safetensors
