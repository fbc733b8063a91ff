#!/usr/bin/env bash
# Everything that wants a GPU, the most valuable first, in 37 minutes at most; each part writes its figures at once.
#
#     recipes/gpu/all.sh OUT        # OUT: what is to be kept, figures and the trained models
#
# A part that fails leaves its log and does not stop the others. A second call with the same WORLD (/tmp/world) goes
# on with the trainings. START names a checkpoint of the pusher to begin from (the state of an earlier call).
set -uo pipefail
gpu=$(nvidia-smi --query-gpu=name,memory.total --format=csv,noheader) ||
    { echo "error: there is no GPU here — run this where nvidia-smi lists one" >&2 && exit 1; }
mkdir -p "${1:?error: name the folder for the figures: recipes/gpu/all.sh OUT}"
out=$(cd "$1" && pwd) here=$(cd "$(dirname "$0")/../.." && pwd)
cd "$here" || exit 1
if ! command -v hma > /dev/null; then # a bare machine; the installation is not part of that time
    pip install -q uv && uv sync -q --group dev || exit 1
    export PATH="$here/.venv/bin:$PATH"
fi
part() { # name, seconds at most, command …
    local name=$1 most=$2 begun=$SECONDS
    shift 2
    timeout "$most" "$@" > "$out/$name.log" 2>&1
    echo "$name: exit $?, $((SECONDS - begun)) s" | tee -a "$out/parts.txt"
    tail -n 12 "$out/$name.log"
}
echo "$gpu" | tee "$out/gpu.txt"
export WORKERS=${WORKERS:-$(nproc)} PROCESSES=1
push=${WORLD:-/tmp/world}/push lab=${WORLD:-/tmp/world}/lab
part push 600 recipes/world/pusht.sh "$push" cpu_seconds=150 batch_size=256 lr=3e-3 compile=true ${START:+start=$START}
part lab 420 recipes/world/make.sh "$lab" cpu_seconds=240 batch_size=256 lr=3e-3 compile=true
for name in push lab; do
    mkdir -p "$out/$name"
    last=$(ls -d "${!name}"/run/checkpoints/step-* 2> /dev/null | tail -n 1)
    [ -z "$last" ] || cp -r "$last"/{config.json,trunk.safetensors,embodiments} "$out/$name/"
    cp "${!name}"/holds.* "$out/$name/" 2> /dev/null
done
for compile in false true; do
    for batch in 1 4 16; do
        part "generate-$compile-$batch" 120 hma bench generate device=cuda compile=$compile batch=$batch precision=bf16
    done
done
part train 180 hma bench train device=cuda precision=bf16
part tests 300 python -m pytest -m gpu -q tests/test_gpu.py
